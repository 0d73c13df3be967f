"""Corrections on outlines of straight sides: symmetry, corners, range, files, solved presses."""

import dataclasses
import math

import numpy as np
import pytest

from eitskin.errors import ConfigurationError
from eitskin.geometry import Polygon, Rectangle, SensorDesign
from eitskin.geometry.design.regular_layouts import uniform
from eitskin.geometry.design.sensor import Rigid
from eitskin.protocol import Protocol
from eitskin.simulator import Cylinder, Mechanics, Scene, Simulator, Touch
from eitskin.simulator.deformation.corrections import (
    Corrections,
    _resampled,
    correction_problems,
    corrections,
)
from eitskin.simulator.deformation.field import CubicSplines, Field
from eitskin.simulator.deformation.indentation_tables import Indentations, solve_side
from eitskin.simulator.deformation.outline_sides import re_entrant_distance, sides_of
from eitskin.simulator.deformation.sensor_grid import SensorGrid
from eitskin.simulator.deformation.solution_store import missing
from eitskin.simulator.deformation.solution_table import SolutionTable
from eitskin.simulator.deformation.touches import PressedSensor, pressed_touches

HEIGHT, THICKNESS, DEPTH = 0.005, 0.012, 0.002
MECHANICS, PUNCH = Mechanics(), Cylinder()
L_SHAPE = Polygon(((0, 0), (0.1, 0), (0.1, 0.05), (0.05, 0.05), (0.05, 0.1), (0, 0.1)))
DESIGN = SensorDesign(L_SHAPE, HEIGHT, uniform(L_SHAPE, 12))


@pytest.fixture(scope="module")
def table() -> SolutionTable:
    assert not missing(correction_problems(DESIGN, MECHANICS, PUNCH))
    base = corrections(DESIGN, MECHANICS, PUNCH).base
    assert base is not None
    return base


def on(outline, table, *weights) -> Corrections:
    """Corrections by sums over sides, with weights of the same table."""
    design = SensorDesign(outline, HEIGHT, uniform(outline, 8))
    return Corrections(design, (), table, tuple((table, weight) for weight in weights or (1.0,)))


def total(found, points):
    """Displacement and mean stress of all fields at points (n, 3), (n, 4)."""
    fields, _ = found
    return sum(field.values(points[:, None])[:, 0].T for field in fields)


def inside(outline, count=60):
    rng = np.random.default_rng(3)
    points = rng.uniform((0, 0, 0), (outline.length, outline.width, HEIGHT), (4 * count, 3))
    return points[outline.contains(points[:, :2], 1e-3)][:count]


# Sides and corners


@pytest.mark.parametrize("place", [(0.03, 0.02), (0.06, 0.01), (0.075, 0.05)])
def test_a_corner_at_which_a_side_goes_straight_on_changes_nothing(table, place) -> None:
    plain = Rectangle(0.15, 0.06)
    divided = Polygon(((0, 0), (0.07, 0), (0.15, 0), (0.15, 0.06), (0.08, 0.06), (0, 0.06)))
    points = inside(plain)
    expected = total(on(plain, table).at(*place, DEPTH), points)
    found = total(on(divided, table).at(*place, DEPTH), points)
    scale = np.abs(expected).max(axis=0)
    assert found / scale == pytest.approx(expected / scale, abs=1e-9)


def test_a_turned_outline_has_the_turned_correction(table) -> None:
    cos, sin = math.cos(0.5), math.sin(0.5)
    turn = np.array([[cos, -sin], [sin, cos]])
    corners = L_SHAPE.vertices @ turn.T
    shift = -corners.min(axis=0)
    turned = Polygon(tuple(map(tuple, (corners + shift).tolist())))
    points, place = inside(L_SHAPE), np.array([0.06, 0.035])
    moved = np.concatenate([points[:, :2] @ turn.T + shift, points[:, 2:]], axis=1)
    expected = total(on(L_SHAPE, table).at(*place, DEPTH), points)
    expected[:, :2] = expected[:, :2] @ turn.T
    found = total(on(turned, table).at(*(turn @ place + shift), DEPTH), moved)
    assert found == pytest.approx(expected, rel=1e-6, abs=1e-12)


def test_the_correction_is_the_same_in_a_mirror(table) -> None:
    points = inside(L_SHAPE)
    here = total(on(L_SHAPE, table).at(0.07, 0.03, DEPTH), points)
    there = total(on(L_SHAPE, table).at(0.03, 0.07, DEPTH), points[:, [1, 0, 2]])
    # The mesh of the table is not quite symmetric about its presses.
    assert np.abs(there[:, [1, 0, 2, 3]] - here).max() < 0.02 * np.abs(here).max()


@pytest.mark.parametrize("axis", [0, 1])
def test_slopes_near_a_re_entrant_corner_are_those_of_the_displacement(table, axis) -> None:
    fields, _ = on(L_SHAPE, table).at(0.043, 0.057, DEPTH)
    points = np.array([[0.047, 0.051, 0.002], [0.045, 0.045, 0.004], [0.055, 0.047, 0.001]])
    step = np.zeros(3)
    step[axis] = 1e-6
    for field in fields:
        ahead, behind = (field.moved((points + way * step)[:, None])[:3] for way in (1.0, -1.0))
        slopes = field.moved(points[:, None])[3:].reshape(3, 3, 1, -1)[:, axis]
        assert (ahead - behind) / 2e-6 == pytest.approx(slopes, rel=1e-4, abs=1e-7)


def test_the_correction_is_continuous_where_a_press_passes_the_line_of_a_side(table) -> None:
    points = inside(L_SHAPE)
    before, after = (
        total(on(L_SHAPE, table).at(0.03, 0.05 + y, DEPTH), points) for y in (-1e-7, 1e-7)
    )
    assert np.abs(after - before).max() < 1e-4 * np.abs(before).max()


def test_sides_are_seen_within_reach_and_from_the_front() -> None:
    seen = list(sides_of(L_SHAPE, 0.09, 0.02, 0.045))
    assert [round(side.aside, 6) for side in seen] == [0.02, 0.01, 0.03]
    assert re_entrant_distance(L_SHAPE, 0.05, 0.03) == pytest.approx(0.02)
    assert re_entrant_distance(Rectangle(0.1, 0.05), 0.05, 0.03) == math.inf


# The table


def test_far_from_the_side_there_is_no_correction(table) -> None:
    far = float(table.nodes("distance_to_side")[-1])
    (field,), numbers = table.evaluate(distance_to_side=far, depth=DEPTH)
    assert np.abs(field).max() < 1e-12
    assert numbers["extra_depth"] == pytest.approx(0.0, abs=1e-12)


def test_a_table_on_the_nodes_of_another_is_the_same_field(table) -> None:
    sizes = {
        "along": np.linspace(table.sizes["along"][0], table.sizes["along"][-1], 161),
        "inward": np.linspace(table.sizes["inward"][0], table.sizes["inward"][-1], 121),
    }
    finer = dataclasses.replace(table, sizes={**table.sizes, **sizes})
    points = np.random.default_rng(1).uniform((-0.05, -0.05, 0), (0.05, 0.02, HEIGHT), (50, 3))
    coefficients, _ = table.evaluate(distance_to_side=0.02, depth=DEPTH)
    expected, found = (
        Field(
            (CubicSplines(each.sizes["along"]), CubicSplines(each.sizes["inward"])),
            HEIGHT,
            _resampled(coefficients, table, each)[0],
        ).values(points[:, None])
        for each in (table, finer)
    )
    assert np.abs(found - expected).max() < 0.01 * np.abs(expected).max()


def test_weighted_tables_add_up(table) -> None:
    points = inside(L_SHAPE)
    expected = on(L_SHAPE, table).at(0.03, 0.02, DEPTH)
    found = on(L_SHAPE, table, 1.3, -0.3).at(0.03, 0.02, DEPTH)
    assert total(found, points) == pytest.approx(total(expected, points))
    assert found[1] == pytest.approx(expected[1])


def test_presses_beyond_the_table_are_refused(table) -> None:
    found, deepest = on(L_SHAPE, table), float(table.nodes("depth")[-1])
    with pytest.raises(ConfigurationError, match=r"tabulated to a depth .* touch_model='solved'"):
        found.at(0.03, 0.03, 1.05 * deepest)
    with pytest.raises(ConfigurationError, match=r"keep 3.5 mm from the edge"):
        found.at(0.098, 0.03, 0.001)


def test_presses_are_solved_at_rising_distances_from_the_side(monkeypatch) -> None:
    seen, reports = [], []

    @dataclasses.dataclass
    class Found:
        depth: float
        middle: float

        @property
        def sunk(self):
            return np.array([0.1 * self.depth])

        def in_gel(self, points):
            away = points - np.array([self.middle, 0.0, 0.0])
            bell = np.exp(-((away[..., :2] / 0.05) ** 2).sum(axis=-1))
            return self.depth * bell[..., None] * np.ones(4)

    def solve(about, _outline, x, y, _fineness):
        seen.append(y)
        return [Found(dent.depth, x) for dent in about.dents]

    dents = Dent(1e-3), Dent(2e-3)
    monkeypatch.setattr(Indentations, "solve", solve)
    monkeypatch.setattr(
        Indentations, "to_depths", lambda about, _: dataclasses.replace(about, dents=dents)
    )
    about = Indentations(MECHANICS.stack(DESIGN), MECHANICS, Rigid(), PUNCH)
    found = solve_side(about, lambda *done: reports.append(done))
    assert seen == sorted(seen)
    assert found.nodes("distance_to_side")[:-1] == pytest.approx(seen)
    assert reports[-1] == (len(seen), len(seen))
    (coefficients,), numbers = found.evaluate(distance_to_side=seen[2], depth=1e-3)
    bases = CubicSplines(found.sizes["along"]), CubicSplines(found.sizes["inward"])
    at = np.array([[[0.004, 0.01 - found.size("middle"), 0.002]]])
    bell = math.exp(-((0.004 / 0.05) ** 2) - (0.01 / 0.05) ** 2)
    values = Field(bases, found.size("height"), coefficients).values(at).ravel()
    assert values == pytest.approx(1e-3 * bell * np.ones(4), rel=1e-3)
    assert numbers["extra_depth"] == pytest.approx(1e-4)


@dataclasses.dataclass
class Dent:
    depth: float


# Which sensors, and which tables


def test_one_table_serves_all_outlines_of_straight_sides() -> None:
    triangle = Polygon(((0.0, 0.0), (0.12, 0.0), (0.06, 0.09)))
    short = Rectangle(0.08, 0.05)

    def names(design, *grid):
        return {p.name for p in correction_problems(design, MECHANICS, PUNCH, *grid, pairs=False)}

    (own,) = names(DESIGN)
    for outline in (triangle, short):
        assert names(SensorDesign(outline, HEIGHT, uniform(outline, 8))) == {own}
    thicker = dataclasses.replace(DESIGN, thickness=0.0052, encapsulated_thickness=0.01248)
    assert len(names(thicker, SensorGrid(thickness=HEIGHT))) == 3


def test_presses_near_a_re_entrant_corner_come_with_a_caution() -> None:
    far, near = (
        pressed_touches((Touch(x, y, 4.0),), PressedSensor(DESIGN, MECHANICS))[0]
        for x, y in ((0.025, 0.025), (0.043, 0.043))
    )
    assert far.signal_error is not None
    assert not far.caution
    assert near.signal_error is None
    assert "re-entrant" in near.caution


# Solved presses


@pytest.mark.slow
def test_the_signal_is_that_of_a_press_solved_in_the_whole_stack() -> None:
    small = Polygon(
        ((0, 0), (0.064, 0), (0.064, 0.036), (0.036, 0.036), (0.036, 0.064), (0, 0.064))
    )
    design = SensorDesign(small, HEIGHT, uniform(small, 8))
    touched = Scene(touches=(Touch(0.020, 0.014, 6.0),))
    signals = []
    for model in ("solved", "tabulated"):
        simulator = Simulator(design, "coarse", None, Protocol.adjacent(8), touch_model=model)
        flat, pressed = simulator.measure_all([Scene(), touched]).real
        signals.append(pressed / flat - 1.0)
    solved, tabulated = signals
    assert np.linalg.norm(tabulated - solved) < 0.03 * np.linalg.norm(solved)
