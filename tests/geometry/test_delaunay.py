"""Triangles and tetrahedra: what they fill, their angles and their quality."""

import numpy as np
import pytest

from eitskin.geometry import Disc, Polygon, Rectangle
from eitskin.geometry.meshing.delaunay import triangulate
from eitskin.geometry.meshing.grading import Grading
from eitskin.geometry.meshing.mesh import volumes
from eitskin.geometry.meshing.tetrahedra import TriangleSurface, _sizing, snap_boundary

from cut_blocks import block
from on_demand import OnDemand

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


def rim_of(triangles):
    """Edges of one triangle only; inner edges are shared by two where no points hang."""
    sides = np.sort(np.stack([triangles, np.roll(triangles, 1, axis=1)], axis=-1), axis=-1)
    sides, counts = np.unique(sides.reshape(-1, 2), axis=0, return_counts=True)
    return sides[counts == 1]


@pytest.mark.slow
@pytest.mark.parametrize("outline", [SLAB, BENT, NOTCHED, SPLINTER])
@pytest.mark.parametrize("finest", [1e-3, 1e-5])
def test_triangles_fill_the_outline_no_larger_than_wanted(outline, finest):
    points, triangles, size = sized(outline, [0.052, 0.057, 0.06], finest)
    a, b, c = np.moveaxis(points[triangles], 1, 0)
    covered = 0.5 * ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])
    assert covered.min() > 0
    x, y = outline.vertices.T
    area = 0.5 * (x @ np.roll(y, -1) - y @ np.roll(x, -1))
    assert covered.sum() == pytest.approx(area, rel=1e-12)
    corners = points[triangles]
    edges = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)
    assert (edges.max(axis=1) <= size(corners.mean(axis=1)) * (1 + 1e-8)).all()
    rim = points[rim_of(triangles)]
    assert np.abs(outline.nearest(rim.mean(axis=1))[1]).max() < 1e-12
    length = np.linalg.norm(rim[:, 1] - rim[:, 0], axis=1).sum()
    assert length == pytest.approx(outline.perimeter, rel=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("outline", [SLAB, BENT, NOTCHED])
def test_angles_stay_large_where_corners_are(outline):
    points, triangles, _ = sized(outline, [0.052, 0.057, 0.057001], 1e-5)
    assert angles(points, triangles).min() > 28


@pytest.mark.slow
def test_refinement_is_cheap_discs_end_on_circles_and_splinters_keep_corners():
    counts = [len(sized(SLAB, [0.052, 0.057], finest)[0]) for finest in (1e-3, 1e-4, 1e-5)]
    # Each tenth of the finest size adds a few rings of triangles.
    assert 50 < np.diff(counts).min() <= np.diff(counts).max() < 500
    points, triangles, _ = sized(BENT, [0.052, 0.057], 1e-4)
    assert (np.diff(points[:, 0]) >= 0).all()
    again, same, _ = sized(BENT, [0.052, 0.057], 1e-4)
    assert np.array_equal(points, again)
    assert np.array_equal(triangles, same)
    disc = Disc(0.05)
    ends = np.array([-1e-17, 0.0123, 0.0123001, 0.05, disc.perimeter - 1e-6])
    points, triangles, _ = sized(disc, ends, 1e-3)
    apart = np.linalg.norm(points[:, None] - disc.rim_points(ends), axis=2)
    assert apart.min(axis=0).max() < 1e-12
    distance = np.linalg.norm(points - disc.radius, axis=1)
    assert np.abs(distance[rim_of(triangles)] - disc.radius).max() < 1e-15
    assert angles(points, triangles).min() > 20
    points, triangles, _ = sized(SPLINTER, [0.052, 0.057], 1e-3)
    smallest = angles(points, triangles).min(axis=1)
    assert smallest.min() > 0.95 * np.degrees(np.arctan(0.1))
    beyond = points[triangles][:, :, 0].min(axis=1) > 0.02
    assert smallest[beyond].min() > 28


# Tetrahedra that follow edges and corners


trimesh = OnDemand("trimesh")

BOX = np.array([[x, y, z] for x in (0.0, 3.0) for y in (0.0, 2.0) for z in (0.0, 1.0)])
BOX_FACES = np.array(
    [
        *([0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1]),
        *([2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]),
    ]
)


@pytest.fixture(scope="module")
def surface():
    return TriangleSurface.from_triangles(BOX, BOX_FACES)


def test_features_are_sharp_edges_and_sizes_those_wanted_near_them(surface):
    assert len(surface.edges) == 12
    assert np.array_equal(np.sort(surface.corners), np.arange(8))
    assert (np.count_nonzero(np.ptp(BOX[surface.edges], axis=1), axis=1) == 1).all()
    for sides, edges, corners in ((48, 96, 0), (6, 18, 12)):  # at 7.5 degrees: the rims alone
        mesh = trimesh.creation.cylinder(1.0, 1.0, sections=sides)
        found = TriangleSurface.from_triangles(mesh.vertices, mesh.faces)
        assert (len(found.edges), len(found.corners)) == (edges, corners)
    grading, edges = (
        Grading(0.1, 0.2, 0.5),
        np.random.default_rng(5).uniform(0, [3, 2, 1], (300, 3)),
    )
    places, cells, sizes = _sizing(edges, grading, BOX)
    distance = np.linalg.norm(places[:, None] - edges, axis=2).min(axis=1)
    assert np.count_nonzero(distance < 1e-11) == len(edges)
    assert distance[distance > 1e-11].min() > 2.0 * grading.finest
    assert sizes == pytest.approx(np.minimum(0.2, sizes[distance < 1e-11].max() + 0.5 * distance))
    assert sizes.min() == pytest.approx(grading.finest, rel=0.5)
    assert np.abs(volumes(places, cells)).sum() == pytest.approx(3.6 * 2.6 * 1.6, rel=0.01)


@pytest.mark.parametrize(
    ("place", "goal"),
    [
        ((1.3, 0.7, 1.04), (1.3, 0.7, 1.0)),  # above a face
        ((1.3, 0.7, 0.96), (1.3, 0.7, 1.0)),  # below it
        ((1.3, 0.03, 0.96), (1.3, 0.0, 1.0)),  # near an edge
        ((2.97, 0.03, 0.96), (3.0, 0.0, 1.0)),  # near a corner
        ((3.07, 0.05, 0.05), (3.0, 0.05, 0.05)),  # nearer to the line of an edge than to the edge
        ((1.3, 0.7, 0.5), (1.3, 0.7, 0.5)),  # far from everything
    ],
)
def test_places_go_to_the_sharpest_feature_within_reach(surface, place, goal):
    *_, found = surface.targets(np.array([place, (0.1, 0.1, 0.5)]), 0.08)
    assert found[0] == pytest.approx(goal, abs=1e-12)


def test_dented_boxes_become_plane_and_no_cell_is_flattened(surface):
    points, cells = block(4, (12, 8, 4), (3, 2, 1))
    inside = ((points > 0) & (points < [3, 2, 1])).all(axis=1)
    assert volumes(points, cells).sum() == pytest.approx(6.0, rel=1e-9)
    rough = points.copy()
    rng = np.random.default_rng(3)
    away = rng.normal(size=points.shape) * (np.isclose(points, 0) | np.isclose(points, [3, 2, 1]))
    rough += 0.02 * away / np.maximum(np.linalg.norm(away, axis=1), 1e-9)[:, None]
    assert abs(volumes(rough, cells).sum() / 6 - 1) > 1e-4
    smooth = snap_boundary(rough, cells, surface, 0.03)
    assert np.array_equal(smooth[inside], points[inside])
    assert smooth == pytest.approx(points, abs=1e-12)
    # The apex of the first is within reach of the face that its base lies in.
    flat = [[1.0, 1.0, 1.0], [1.5, 1.0, 1.0], [1.0, 1.5, 1.0], [1.2, 1.2, 0.95]]
    tall = [[2.0, 1.0, 0.97], [2.2, 1.0, 0.6], [2.0, 1.3, 0.6], [2.1, 1.1, 0.2]]
    # The first corner of these is within reach of the top, and of its edge in the plane y = 0.
    free, held = (
        [[1.0, 0.06, 0.97], [0.8, 0.0, 0.6], [1.2, 0.0, 0.6], [1.0, y, 0.3]] for y in (0.4, 0.0)
    )
    points = np.array([*flat, *tall, *free, *held])
    cells = np.array([[0, 2, 1, 3]]) + 4 * np.arange(4)[:, None]
    assert volumes(points, cells).min() > 0
    found = snap_boundary(points, cells, surface, 0.08)
    assert np.array_equal(found[:4], points[:4])
    assert found[[4, 8, 12]] == pytest.approx(
        np.array([[2.0, 1.0, 1.0], [1.0, 0.0, 1.0], [1.0, 0.06, 1.0]])
    )
