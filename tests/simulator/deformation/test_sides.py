"""Corrections on outlines of straight sides: symmetry, corners, range, files, solved presses."""

import dataclasses
import math
from functools import partial

import numpy as np
import pytest

from eitskin.geometry import Polygon, Rectangle, SensorDesign
from eitskin.geometry.design.regular_layouts import uniform
from eitskin.protocol import Protocol
from eitskin.simulator import Cylinder, Mechanics, Scene, Simulator, Touch
from eitskin.simulator.deformation import finite_stack
from eitskin.simulator.deformation.corrections import (
    Corrections,
    correction_problems,
    corrections,
)
from eitskin.simulator.deformation.field import CubicSplines, Field
from eitskin.simulator.deformation.node_sums import _resample_splines
from eitskin.simulator.deformation.outline_sides import re_entrant_distance, sides_in_reach
from eitskin.simulator.deformation.pressed_sensor import PressedSensor
from eitskin.simulator.deformation.solution_store import missing
from eitskin.simulator.deformation.solution_table import SolutionTable
from eitskin.simulator.deformation.stack_mesh import Fineness
from eitskin.simulator.deformation.touches import pressed_touches

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


def on(outline, table) -> Corrections:
    """Corrections by sums over sides."""
    design = SensorDesign(outline, HEIGHT, uniform(outline, 8))
    return Corrections(design, (), table, ((table, 1.0),))


def total(found, points):
    """Displacement and mean stress of all fields at points (n, 3), (n, 4)."""
    fields, _ = found
    return sum(field.values(points[:, None])[:, 0].T for field in fields)


def inside(outline, count=60):
    rng = np.random.default_rng(3)
    points = rng.uniform((0, 0, 0), (outline.length, outline.width, HEIGHT), (4 * count, 3))
    return points[outline.contains(points[:, :2], 1e-3)][:count]


@pytest.mark.parametrize("place", [(0.03, 0.02), (0.06, 0.01), (0.075, 0.05)])
def test_a_corner_at_which_a_side_goes_straight_on_changes_nothing(table, place) -> None:
    plain = Rectangle(0.15, 0.06)
    divided = Polygon(((0, 0), (0.07, 0), (0.15, 0), (0.15, 0.06), (0.08, 0.06), (0, 0.06)))
    points = inside(plain)
    expected = total(on(plain, table).correct_press(*place, DEPTH), points)
    found = total(on(divided, table).correct_press(*place, DEPTH), points)
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
    expected = total(on(L_SHAPE, table).correct_press(*place, DEPTH), points)
    expected[:, :2] = expected[:, :2] @ turn.T
    found = total(on(turned, table).correct_press(*(turn @ place + shift), DEPTH), moved)
    assert found == pytest.approx(expected, rel=1e-6, abs=1e-12)


@pytest.mark.parametrize("axis", [0, 1])
def test_slopes_near_a_re_entrant_corner_are_those_of_the_displacement(table, axis) -> None:
    fields, _ = on(L_SHAPE, table).correct_press(0.043, 0.057, DEPTH)
    points = np.array([[0.047, 0.051, 0.002], [0.045, 0.045, 0.004], [0.055, 0.047, 0.001]])
    step = np.zeros(3)
    step[axis] = 1e-6
    for field in fields:
        ahead, behind = (
            field.displacement_and_gradient((points + way * step)[:, None])[:3]
            for way in (1.0, -1.0)
        )
        slopes = field.displacement_and_gradient(points[:, None])[3:].reshape(3, 3, 1, -1)[:, axis]
        assert (ahead - behind) / 2e-6 == pytest.approx(slopes, rel=1e-4, abs=1e-7)


def test_the_correction_is_continuous_where_a_press_passes_the_line_of_a_side(table) -> None:
    points = inside(L_SHAPE)
    before, after = (
        total(on(L_SHAPE, table).correct_press(0.03, 0.05 + y, DEPTH), points)
        for y in (-1e-7, 1e-7)
    )
    assert np.abs(after - before).max() < 1e-4 * np.abs(before).max()


def test_sides_are_seen_within_reach_and_from_the_front() -> None:
    seen = list(sides_in_reach(L_SHAPE, 0.09, 0.02, 0.045))
    assert [round(side.aside, 6) for side in seen] == [0.02, 0.01, 0.03]
    assert re_entrant_distance(L_SHAPE, 0.05, 0.03) == pytest.approx(0.02)
    assert re_entrant_distance(Rectangle(0.1, 0.05), 0.05, 0.03) == math.inf


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
            _resample_splines(coefficients, table, each)[0],
        ).values(points[:, None])
        for each in (table, finer)
    )
    assert np.abs(found - expected).max() < 0.01 * np.abs(expected).max()


def test_presses_near_a_re_entrant_corner_come_with_a_caution() -> None:
    far, near = (
        pressed_touches((Touch(x, y, 4.0),), PressedSensor(DESIGN, MECHANICS))[0]
        for x, y in ((0.025, 0.025), (0.043, 0.043))
    )
    assert far.signal_error is not None
    assert not far.caution
    assert near.signal_error is None
    assert "re-entrant" in near.caution


def test_a_rectangle_given_as_a_polygon_is_pressed_as_the_rectangle() -> None:
    points = ((0.15, 0.06), (0.15, 0.0), (0.08, 0.0), (0.0, 0.0), (0.0, 0.06))
    rims = Rectangle(0.15, 0.06), Polygon(points)
    touch = Scene(touches=(Touch(0.03, 0.03, 8.0),))
    plain, given = (
        Simulator(SensorDesign(rim, HEIGHT, uniform(rim, 8)), "coarse", touch_model="tabulated")
        for rim in rims
    )
    inner = np.random.default_rng(0).uniform((0, 0, 0), (0.15, 0.06, HEIGHT), (40, 3))
    expected, found = (each.deformation(touch).gradient(inner) for each in (plain, given))
    assert found == pytest.approx(expected, abs=1e-12)
    assert plain.presses(touch)[0] == given.presses(touch)[0]


@pytest.mark.parametrize("place", [(0.03, 0.03), (0.025, 0.02), (0.012, 0.012)])
def test_sums_beside_a_right_corner_give_the_signal_of_tables_of_rectangles(place, table) -> None:
    simulator = Simulator(SensorDesign.reference(), "coarse", touch_model="tabulated")
    touched = simulator.deformation(Scene(touches=(Touch(*place, 10.0),)))
    fields, _ = on(Rectangle(0.15, 0.06), table).correct_press(
        *place, touched.presses[0].dent.depth
    )
    summed = dataclasses.replace(touched, corrections=tuple(fields))
    expected, found = (
        simulator.simulate_deformation(each).impedance.real for each in (touched, summed)
    )
    flat = simulator.measure(Scene()).impedance.real
    assert np.linalg.norm(found - expected) < 0.03 * np.linalg.norm(expected - flat)


@pytest.mark.slow
def test_the_signal_is_that_of_a_press_solved_in_the_whole_stack(monkeypatch) -> None:
    # Cells that grow fast away from the press, also at the ends, change 1 % of the signals.
    coarser = partial(finite_stack.stack_mesh, fineness=Fineness(0.0, 0.0, layers=1, growth=2.0))
    monkeypatch.setattr(finite_stack, "stack_mesh", coarser)
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
