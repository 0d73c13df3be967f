"""Plane outlines: arc length, inside and outside; bodies from surface files."""

import math

import numpy as np
import pytest

from eitskin.geometry import Disc, Polygon, Rectangle, Surface

from on_demand import OnDemand

trimesh = OnDemand("trimesh")

L_SHAPE = Polygon(((0, 0), (0.09, 0), (0.09, 0.03), (0.04, 0.03), (0.04, 0.06), (0, 0.06)))
TRIANGLE = Polygon(((0.02, 0.0), (0.06, 0.03), (0.0, 0.04)))
OUTLINES = [Rectangle(0.15, 0.06), Disc(0.05), L_SHAPE, TRIANGLE]


@pytest.mark.parametrize(
    ("outline", "perimeter", "extent"),
    [
        (Rectangle(0.15, 0.06), 0.42, (0.15, 0.06)),
        (Disc(0.05), 0.1 * math.pi, (0.1, 0.1)),
        (TRIANGLE, 0.05 + math.hypot(0.06, 0.01) + math.hypot(0.02, 0.04), (0.06, 0.04)),
    ],
)
def test_extents_and_perimeter(outline, perimeter, extent):
    assert outline.perimeter == pytest.approx(perimeter, rel=1e-14)
    assert (outline.length, outline.width) == pytest.approx(extent, rel=1e-14)


def test_arc_length_runs_counter_clockwise_from_where_it_is_said_to():
    x, y = Rectangle(0.15, 0.06).rim_points([0.0, 0.15, 0.18, 0.21, 0.36, 0.39, 0.42]).T
    assert x == pytest.approx([0, 0.15, 0.15, 0.15, 0, 0, 0])
    assert y == pytest.approx([0, 0, 0.03, 0.06, 0.06, 0.03, 0])
    assert Disc(0.05).rim_points([0.0, 0.025 * math.pi]) == pytest.approx(
        np.array([[0.1, 0.05], [0.05, 0.1]])
    )
    assert L_SHAPE.rim_points(L_SHAPE.corners) == pytest.approx(np.array(L_SHAPE.points))


@pytest.mark.parametrize("outline", OUTLINES)
def test_places_are_unit_speed_and_found_again_even_if_rounded(outline):
    s = np.linspace(0.0, outline.perimeter, 301)[:-1] + 1e-6
    places = outline.rim_points(s)
    turns = np.searchsorted(outline.corners, s)
    straight = turns[1:] == turns[:-1]
    speed = np.linalg.norm(np.diff(places, axis=0), axis=1) / np.diff(s)
    assert speed[straight] == pytest.approx(np.ones(straight.sum()), rel=1e-4)
    for digits in (5, 15):
        located = [outline.locate(x, y) for x, y in np.round(places, digits)]
        apart = np.abs(located - s)
        turned = outline.perimeter - apart  # rounding may go past the first corner
        assert np.minimum(apart, turned).max() < 10.0**-digits + 1e-12
    assert outline.rim_points(s + 2 * outline.perimeter) == pytest.approx(places, abs=1e-12)


@pytest.mark.parametrize("outline", OUTLINES)
@pytest.mark.parametrize("margin", [0.004, -0.004])
def test_margin_is_the_distance_from_the_rim_and_the_inside_has_greens_area(outline, margin):
    rng = np.random.default_rng(0)
    extent = 0.02 + max(outline.length, outline.width)
    points = rng.uniform(-0.01, extent - 0.01, size=(2000, 2))
    rim = outline.rim_points(np.linspace(0.0, outline.perimeter, 1001))
    distance = np.linalg.norm(points[:, None] - rim, axis=-1).min(axis=1)
    inside = outline.contains(points)
    x, y = rim.T
    area = 0.5 * np.sum(x[:-1] * y[1:] - x[1:] * y[:-1])
    assert inside.mean() * extent**2 == pytest.approx(area, rel=0.1)
    expected = inside & (distance > margin) if margin > 0 else inside | (distance < -margin)
    clear = np.abs(distance - abs(margin)) > 1e-4
    assert 10 < expected.sum() < 1900
    assert (outline.contains(points, margin) == expected)[clear].all()
    assert outline.contains(rim).all()


def surface(mesh, path, scale=1.0):
    mesh.export(path)
    return Surface(path, scale)


def volume(body):
    points, faces = body.triangles()
    return np.linalg.det(points[faces]).sum() / 6


@pytest.mark.parametrize("ending", ["stl", "obj", "ply", "off"])
def test_extents_and_volume_are_in_metres(tmp_path, ending):
    bounds = np.array([[1, 2, 3], [21, 12, 9]])
    body = surface(trimesh.creation.box(bounds=bounds), tmp_path / f"box.{ending}", 1e-3)
    assert (body.length, body.width, body.height) == pytest.approx((0.02, 0.01, 0.006))
    assert body.bounds == pytest.approx(bounds * 1e-3)
    assert volume(body) == pytest.approx(0.02 * 0.01 * 0.006, rel=1e-6)


def test_nearest_place_and_normal_on_a_box(tmp_path):
    body = surface(trimesh.creation.box(extents=[2, 2, 2]), tmp_path / "box.stl")
    for given, place, normal in (
        ((0.3, 0.2, 5.0), (0.3, 0.2, 1.0), (0, 0, 1)),
        ((0.3, 0.2, 0.9), (0.3, 0.2, 1.0), (0, 0, 1)),
        ((-1.5, 0.2, 0.1), (-1.0, 0.2, 0.1), (-1, 0, 0)),
    ):
        found = body.nearest(np.array(given))
        assert found[0] == pytest.approx(np.array(place))
        assert found[1] == pytest.approx(np.array(normal))
    assert body.nearest(np.array([3.0, 4.0, 5.0]))[0] == pytest.approx(np.ones(3))


def test_a_cavity_is_part_of_the_body_and_a_changed_file_is_read_again(tmp_path):
    box, hole = trimesh.creation.box(extents=[1, 1, 1]), trimesh.creation.icosphere(radius=0.3)
    body = surface(box, tmp_path / "box.stl")
    assert volume(body) == pytest.approx(1.0, rel=1e-6)
    hole.invert()
    surface(trimesh.util.concatenate([box, hole]), tmp_path / "box.stl")
    assert volume(body) == pytest.approx(1.0 + hole.volume, rel=1e-5)
