"""Plane triangulations: they fill any outline, keep their angles and follow the size wanted."""

import numpy as np
import pytest

from eitskin.geometry import Disc, Polygon, Rectangle
from eitskin.geometry.meshing.delaunay import triangulate

SLAB = Rectangle(0.15, 0.06)
BENT = Polygon(((0, 0), (0.1, 0), (0.1, 0.03), (0.03, 0.03), (0.03, 0.1), (0, 0.1)))
NOTCHED = Polygon(
    ((0, 0), (0.1, 0), (0.1, 0.05), (0.0505, 0.05), (0.05, 0.01), (0.0495, 0.05), (0, 0.05))
)
SPLINTER = Polygon(((0, 0), (0.1, 0), (0.1, 0.01)))  # its corner is 5.7 degrees


def sized(outline, ends, finest, growth=0.5, coarsest=5e-3):
    """Triangles refined around arc lengths `ends`; the size function beside them."""
    places = outline.rim_points(np.asarray(ends))

    def size(x):
        distance = np.linalg.norm(x[:, None] - places, axis=2).min(axis=1)
        return np.minimum(coarsest, finest + growth * distance)

    return *triangulate(outline, np.asarray(ends), size), size


def angles(points, triangles):
    corners = points[triangles]
    to_next = np.roll(corners, -1, axis=1) - corners
    to_last = np.roll(corners, 1, axis=1) - corners
    lengths = np.linalg.norm(to_next, axis=2) * np.linalg.norm(to_last, axis=2)
    return np.degrees(np.arccos((to_next * to_last).sum(axis=2) / lengths))


def areas(points, triangles):
    a, b, c = np.moveaxis(points[triangles], 1, 0)
    return 0.5 * ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])


def polygon_area(vertices):
    x, y = vertices.T
    return 0.5 * (x @ np.roll(y, -1) - y @ np.roll(x, -1))


def rim_of(triangles):
    """Edges of one triangle only; inner edges are shared by two where no points hang."""
    sides = np.sort(np.stack([triangles, np.roll(triangles, 1, axis=1)], axis=-1), axis=-1)
    sides, counts = np.unique(sides.reshape(-1, 2), axis=0, return_counts=True)
    return sides[counts == 1]


@pytest.mark.parametrize("outline", [SLAB, BENT, NOTCHED, SPLINTER])
@pytest.mark.parametrize("finest", [1e-3, 1e-5])
def test_triangles_fill_the_outline_no_larger_than_wanted(outline, finest):
    points, triangles, size = sized(outline, [0.052, 0.057, 0.06], finest)
    covered = areas(points, triangles)
    assert covered.min() > 0
    assert covered.sum() == pytest.approx(polygon_area(outline.vertices), rel=1e-12)
    corners = points[triangles]
    edges = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)
    assert (edges.max(axis=1) <= size(corners.mean(axis=1)) * (1 + 1e-8)).all()
    rim = points[rim_of(triangles)]
    assert np.abs(outline.nearest(rim.mean(axis=1))[1]).max() < 1e-12
    length = np.linalg.norm(rim[:, 1] - rim[:, 0], axis=1).sum()
    assert length == pytest.approx(outline.perimeter, rel=1e-12)


@pytest.mark.parametrize("outline", [SLAB, BENT, NOTCHED])
def test_angles_stay_large_where_corners_are(outline):
    points, triangles, _ = sized(outline, [0.052, 0.057, 0.057001], 1e-5)
    assert angles(points, triangles).min() > 28


def test_a_splinter_keeps_its_sharp_corner_and_good_angles_elsewhere():
    points, triangles, _ = sized(SPLINTER, [0.052, 0.057], 1e-3)
    smallest = angles(points, triangles).min(axis=1)
    assert smallest.min() > 0.95 * np.degrees(np.arctan(0.1))
    beyond = points[triangles][:, :, 0].min(axis=1) > 0.02
    assert smallest[beyond].min() > 28


def test_rims_of_discs_are_on_the_circle_with_points_at_the_ends_wanted():
    disc = Disc(0.05)
    ends = np.array([-1e-17, 0.0123, 0.0123001, 0.05, disc.perimeter - 1e-6])
    points, triangles, _ = sized(disc, ends, 1e-3)
    apart = np.linalg.norm(points[:, None] - disc.rim_points(ends), axis=2)
    assert apart.min(axis=0).max() < 1e-12
    distance = np.linalg.norm(points - disc.radius, axis=1)
    assert np.abs(distance[rim_of(triangles)] - disc.radius).max() < 1e-15
    assert angles(points, triangles).min() > 20


def test_local_refinement_is_cheap_ordered_and_the_same_each_time():
    counts = [len(sized(SLAB, [0.052, 0.057], finest)[0]) for finest in (1e-3, 1e-4, 1e-5)]
    # Each tenth of the finest size adds a few rings of triangles.
    assert 50 < np.diff(counts).min() <= np.diff(counts).max() < 500
    points, triangles, _ = sized(BENT, [0.052, 0.057], 1e-4)
    assert (np.diff(points[:, 0]) >= 0).all()
    again, same, _ = sized(BENT, [0.052, 0.057], 1e-4)
    assert np.array_equal(points, again)
    assert np.array_equal(triangles, same)
