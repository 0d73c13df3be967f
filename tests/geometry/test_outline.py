"""Plane outlines: arc length, inside and outside, and polygons that cannot be."""

import math

import numpy as np
import pytest

from eitskin.errors import ConfigurationError
from eitskin.geometry import Disc, Polygon, Rectangle

L_SHAPE = Polygon(((0, 0), (0.09, 0), (0.09, 0.03), (0.04, 0.03), (0.04, 0.06), (0, 0.06)))
TRIANGLE = Polygon(((0.02, 0.0), (0.06, 0.03), (0.0, 0.04)))
OUTLINES = [Rectangle(0.15, 0.06), Disc(0.05), L_SHAPE, TRIANGLE]


@pytest.mark.parametrize(
    ("outline", "perimeter", "extent"),
    [
        (Rectangle(0.15, 0.06), 0.42, (0.15, 0.06)),
        (Disc(0.05), 0.1 * math.pi, (0.1, 0.1)),
        (L_SHAPE, 0.3, (0.09, 0.06)),
        (TRIANGLE, 0.05 + math.hypot(0.06, 0.01) + math.hypot(0.02, 0.04), (0.06, 0.04)),
    ],
)
def test_extents_and_perimeter(outline, perimeter, extent):
    assert outline.perimeter == pytest.approx(perimeter, rel=1e-14)
    assert (outline.length, outline.width) == pytest.approx(extent, rel=1e-14)


def test_arc_length_runs_counter_clockwise_from_where_it_is_said_to():
    s = [0.0, 0.15, 0.18, 0.21, 0.36, 0.39, 0.42]
    x, y = Rectangle(0.15, 0.06).at(s).T
    assert x == pytest.approx([0, 0.15, 0.15, 0.15, 0, 0, 0])
    assert y == pytest.approx([0, 0, 0.03, 0.06, 0.06, 0.03, 0])
    assert Rectangle(0.15, 0.06).corners == pytest.approx([0, 0.15, 0.21, 0.36])
    assert Disc(0.05).at(0.0) == pytest.approx([0.1, 0.05])
    assert Disc(0.05).at(0.025 * math.pi) == pytest.approx([0.05, 0.1])
    assert Disc(0.05).corners.shape == (0,)
    assert L_SHAPE.at(L_SHAPE.corners) == pytest.approx(np.array(L_SHAPE.points))


@pytest.mark.parametrize("outline", OUTLINES)
def test_places_are_unit_speed_and_found_again(outline):
    s = np.linspace(0.0, outline.perimeter, 1201)[:-1] + 1e-6
    places = outline.at(s)
    turns = np.searchsorted(outline.corners, s)
    straight = turns[1:] == turns[:-1]
    speed = np.linalg.norm(np.diff(places, axis=0), axis=1) / np.diff(s)
    assert speed[straight] == pytest.approx(np.ones(straight.sum()), rel=1e-4)
    assert [outline.locate(x, y) for x, y in places] == pytest.approx(s.tolist(), abs=1e-12)
    assert outline.at(s + 2 * outline.perimeter) == pytest.approx(places, abs=1e-12)


@pytest.mark.parametrize("outline", OUTLINES)
def test_green_theorem_gives_a_positive_area_that_the_inside_fills(outline):
    x, y = outline.at(np.linspace(0.0, outline.perimeter, 40001)).T
    area = 0.5 * np.sum(x[:-1] * y[1:] - x[1:] * y[:-1])
    n = 400
    grid_x, grid_y = (np.arange(n) + 0.5) / n * outline.length, (np.arange(n) + 0.5) / n
    points = np.stack(np.meshgrid(grid_x, grid_y * outline.width, indexing="ij"), axis=-1)
    share = outline.contains(points).mean()
    assert share * outline.length * outline.width == pytest.approx(area, rel=5e-3)


@pytest.mark.parametrize("outline", OUTLINES)
@pytest.mark.parametrize("margin", [0.004, -0.004])
def test_margin_is_the_distance_from_the_rim(outline, margin):
    rng = np.random.default_rng(0)
    points = rng.uniform(-0.01, 0.01 + max(outline.length, outline.width), size=(300, 2))
    rim = outline.at(np.linspace(0.0, outline.perimeter, 4001))
    distance = np.linalg.norm(points[:, None] - rim, axis=-1).min(axis=1)
    inside = outline.contains(points)
    clear = np.abs(distance - abs(margin)) > 1e-5
    expected = inside & (distance > margin) if margin > 0 else inside | (distance < -margin)
    assert 10 < expected.sum() < 290
    assert (outline.contains(points, margin) == expected)[clear].all()
    assert outline.contains(rim).all()


def test_clockwise_points_are_turned_around_their_first():
    turned = Polygon(L_SHAPE.points[:1] + L_SHAPE.points[:0:-1])
    assert turned == L_SHAPE
    assert hash(turned) == hash(L_SHAPE)
    assert Polygon(np.array(L_SHAPE.points)) == L_SHAPE


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Rectangle(0.0, 0.1), r"outline.length.*got 0.0"),
        (lambda: Rectangle(0.1, math.inf), r"outline.width.*got inf"),
        (lambda: Rectangle(150, 60), r"outline.length.*1 um and 10 m.*150 m"),
        (lambda: Disc(math.nan), r"outline.radius.*positive"),
        (lambda: Disc(1e-7), "5 mm is 0.005"),
        (lambda: Rectangle(0.1, 0.05).locate(0.02, 0.01), r"0\.01 m off .* is \(0\.02, 0\) m"),
        (lambda: Disc(0.05).locate(0.11, 0.05), r"0\.01 m off .* is \(0\.1, 0\.05\) m"),
        (lambda: Disc(0.05).locate(0.1002, 0.05), r"0\.0002 m off"),
        (lambda: Rectangle(0.1, 0.05).locate(math.nan, 0.0), "off the outline"),
    ],
)
def test_sizes_that_cannot_be_and_places_off_the_outline_are_refused(make, message):
    with pytest.raises(ConfigurationError, match=message):
        make()


@pytest.mark.parametrize("decimals", [4, 5, 6])
@pytest.mark.parametrize("outline", [Disc(0.05), L_SHAPE], ids=["disc", "polygon"])
def test_rounded_positions_are_those_of_the_nearest_point(outline, decimals):
    s = outline.perimeter * np.arange(16) / 16
    located = [outline.locate(x, y) for x, y in np.round(outline.at(s), decimals)]
    assert located == pytest.approx(s, abs=10.0**-decimals)


@pytest.mark.parametrize(
    ("points", "message"),
    [
        (((0, 0), (1, 0)), r"outline.points.*3 to 4096.*2"),
        (((0, 0), (1, 0, 0), (0, 1)), "must be pairs"),
        (((0, 0), (1, 0), (0, math.nan)), "must be finite"),
        (((0.1, -0.2), (1, 0), (0.5, 1)), r"\(-0\.1, 0\.2\)"),
        (((0, 0), (1, 1), (1, 0), (0, 1)), r"point 0 .*point 2"),
        (((0, 0), (1, 0), (0.5, 0), (0.5, 1)), "crosses itself"),
        (((0, 0), (2, 0), (2, 1), (1, 0), (0, 1)), r"crosses itself.*point 3"),
        (((0, 0), (1, 0), (2, 0), (2, 1e-8)), "along y"),
        (((0, 0), (1, 0), (1, 0), (0, 1)), r"1 and 2 .*same"),
        (((0, 0), (1, 0), (0, 1), (0, 0)), r"3 and 0 .*same"),
        (((0, 0), (150, 0), (150, 60)), "metres"),
    ],
)
def test_polygons_that_cannot_be_say_what_to_change(points, message):
    with pytest.raises(ConfigurationError, match=message):
        Polygon(points)
