"""Corrections on outlines of straight sides: symmetry, corners, range, files, solved presses."""

import dataclasses
import itertools
import math
from functools import partial

import numpy as np
import pytest

from eitskin.geometry import Polygon, Rectangle, SensorDesign
from eitskin.protocol import Protocol
from eitskin.simulator import Cylinder, Mechanics, Scene, Simulator, Touch
from eitskin.simulator.deformation import pressed_sensor
from eitskin.simulator.deformation.field import CubicSplines, Field
from eitskin.simulator.deformation.node_sums import _resample_splines
from eitskin.simulator.deformation.pressed_sensor import PressedSensor
from eitskin.simulator.deformation.solution_store import missing
from eitskin.simulator.deformation.solution_table import SolutionTable
from eitskin.simulator.deformation.tabled_corrections import (
    Corrections,
    correction_problems,
    corrections,
)
from eitskin.simulator.deformation.touches import pressed_touches
from eitskin.simulator.mechanics.stack_mesh import Fineness

from pressed_stacks import L_SHAPE, THICKNESS, corrected, design_on, places_in, total

DEPTH, MECHANICS, PUNCH = 0.002, Mechanics(), Cylinder()
DESIGN, POINTS = design_on(L_SHAPE), places_in(L_SHAPE)


@pytest.fixture(scope="module")
def table() -> SolutionTable:
    assert not missing(correction_problems(DESIGN, MECHANICS, PUNCH))
    base = corrections(DESIGN, MECHANICS, PUNCH).base
    assert base is not None
    return base


def correct(outline, table, x, y, depth=DEPTH):
    """Correction of a press by sums over sides."""
    return corrected(Corrections(design_on(outline), (), table, ((table, 1.0),)), (x, y, depth))


def test_corrections_turn_with_the_outline_and_no_straight_corner_changes_them(table):
    plain, place = Rectangle(0.15, 0.06), (0.06, 0.01)
    divided = Polygon(((0, 0), (0.07, 0), (0.15, 0), (0.15, 0.06), (0.08, 0.06), (0, 0.06)))
    expected, found = (
        total(correct(each, table, *place), places_in(plain)) for each in (plain, divided)
    )
    scale = np.abs(expected).max(axis=0)
    assert found / scale == pytest.approx(expected / scale, abs=1e-9)
    cos, sin = math.cos(0.5), math.sin(0.5)
    turn = np.array([[cos, -sin], [sin, cos]])
    corners = L_SHAPE.vertices @ turn.T
    shift = -corners.min(axis=0)
    turned = Polygon(tuple(map(tuple, (corners + shift).tolist())))
    place = np.array([0.06, 0.035])
    moved = np.concatenate([POINTS[:, :2] @ turn.T + shift, POINTS[:, 2:]], axis=1)
    expected = total(correct(L_SHAPE, table, *place), POINTS)
    expected[:, :2] = expected[:, :2] @ turn.T
    found = total(correct(turned, table, *(turn @ place + shift)), moved)
    assert found == pytest.approx(expected, rel=1e-6, abs=1e-12)


def test_corrections_are_continuous_with_slopes_also_near_re_entrant_corners(table):
    fields, _ = correct(L_SHAPE, table, 0.043, 0.057)
    points = np.array([[0.047, 0.051, 0.002], [0.045, 0.045, 0.004], [0.055, 0.047, 0.001]])
    for field, axis in itertools.product(fields, (0, 1)):
        step = 1e-6 * np.eye(3)[axis]
        ahead, here, behind = (
            field.displacement_and_gradient((points + way * step)[:, None])
            for way in (1.0, 0.0, -1.0)
        )
        slopes = here[3:].reshape(3, 3, 1, -1)[:, axis]
        assert (ahead - behind)[:3] / 2e-6 == pytest.approx(slopes, rel=1e-4, abs=1e-7)
    before, after = (total(correct(L_SHAPE, table, 0.03, 0.05 + y), POINTS) for y in (-1e-7, 1e-7))
    assert np.abs(after - before).max() < 1e-4 * np.abs(before).max()
    far, near = (
        pressed_touches((Touch(x, y, 4.0),), PressedSensor(DESIGN, MECHANICS))[0]
        for x, y in ((0.025, 0.025), (0.043, 0.043))
    )
    assert far.signal_error is not None
    assert not far.caution
    assert near.signal_error is None
    assert "re-entrant" in near.caution


def test_a_table_on_the_nodes_of_another_is_the_same_field(table) -> None:
    counts = {"along": 161, "inward": 121}
    sizes = {n: np.linspace(*table.sizes[n][[0, -1]], count) for n, count in counts.items()}
    finer = dataclasses.replace(table, sizes={**table.sizes, **sizes})
    points = np.random.default_rng(1).uniform((-0.05, -0.05, 0), (0.05, 0.02, THICKNESS), (50, 3))
    coefficients, _ = table.evaluate(distance_to_side=0.02, depth=DEPTH)
    expected, found = (
        Field(
            (CubicSplines(each.sizes["along"]), CubicSplines(each.sizes["inward"])),
            THICKNESS,
            _resample_splines(coefficients, table, each)[0],
        ).values(points[:, None])
        for each in (table, finer)
    )
    assert np.abs(found - expected).max() < 0.01 * np.abs(expected).max()


@pytest.mark.slow
def test_a_rectangle_given_as_a_polygon_is_pressed_as_the_rectangle() -> None:
    rectangle = Rectangle(0.15, 0.06)
    polygon = Polygon(((0.15, 0.06), (0.15, 0.0), (0.08, 0.0), (0.0, 0.0), (0.0, 0.06)))
    touch = Scene(touches=(Touch(0.03, 0.03, 8.0),))
    plain, given = (
        Simulator(design_on(rim), "coarse", touch_model="tabulated") for rim in (rectangle, polygon)
    )
    inner = places_in(rectangle, 40)
    expected, found = (each.deformation(touch).gradient(inner) for each in (plain, given))
    assert found == pytest.approx(expected, abs=1e-12)
    assert plain.presses(touch)[0] == given.presses(touch)[0]


@pytest.mark.parametrize("place", [(0.03, 0.03), (0.012, 0.012)])
def test_sums_beside_a_right_corner_give_the_signal_of_tables_of_rectangles(place, table) -> None:
    simulator = Simulator(SensorDesign.reference(), "coarse", touch_model="tabulated")
    touched = simulator.deformation(Scene(touches=(Touch(*place, 10.0),)))
    depth = touched.presses[0].dent.depth
    fields, _ = correct(Rectangle(0.15, 0.06), table, *place, depth)
    summed = dataclasses.replace(touched, corrections=tuple(fields))
    expected, found = (
        simulator.simulate_deformation(each).impedance.real for each in (touched, summed)
    )
    flat = simulator.measure(Scene()).impedance.real
    assert np.linalg.norm(found - expected) < 0.03 * np.linalg.norm(expected - flat)


@pytest.mark.slow
def test_the_signal_is_that_of_a_press_solved_in_the_whole_stack(monkeypatch) -> None:
    # Cells that grow fast away from the press, also at the ends, change 1 % of the signals.
    coarser = partial(pressed_sensor.stack_mesh, fineness=Fineness(0.0, 0.0, layers=1, growth=2.0))
    monkeypatch.setattr(pressed_sensor, "stack_mesh", coarser)
    small = Polygon(
        ((0, 0), (0.064, 0), (0.064, 0.036), (0.036, 0.036), (0.036, 0.064), (0, 0.064))
    )
    touched = Scene(touches=(Touch(0.020, 0.014, 6.0),))
    changes = []
    for model in ("solved", "tabulated"):
        sim = Simulator(design_on(small), "coarse", None, Protocol.adjacent(8), touch_model=model)
        flat, pressed = sim.measure_all([Scene(), touched]).real
        changes.append(pressed / flat - 1.0)
    solved, tabulated = changes
    assert np.linalg.norm(tabulated - solved) < 0.03 * np.linalg.norm(solved)
