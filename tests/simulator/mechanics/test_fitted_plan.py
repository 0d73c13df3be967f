"""Plans that follow the rim of an outline, and presses on outlines that are turned."""

import dataclasses
import math

import numpy as np
import pytest

from eitskin.errors import ConfigurationError
from eitskin.geometry import Disc, Polygon, Rectangle, SensorDesign
from eitskin.geometry.design.regular_layouts import uniform
from eitskin.simulator import Touch
from eitskin.simulator.deformation.pressed_sensor import solved_presses
from eitskin.simulator.mechanics.fitted_plan import Contact, fit_plan, unfit
from eitskin.simulator.mechanics.layer_stack import Mechanics

MARGIN, CELL = 0.005, 0.0045
TURN = math.radians(30.0)
ROTATION = np.array([[math.cos(TURN), -math.sin(TURN)], [math.sin(TURN), math.cos(TURN)]])


def turned(length, width):
    """A rectangle turned by 30 degrees, and where its first corner is [m]."""
    points = np.array([[0.0, 0.0], [length, 0.0], [length, width], [0.0, width]]) @ ROTATION.T
    first = -points.min(axis=0)
    return Polygon(tuple(map(tuple, (points + first).tolist()))), first


def plan_of(outline, margin=MARGIN):
    lines = [
        np.linspace(-margin, extent + margin, round((extent + 2 * margin) / CELL))
        for extent in (outline.length, outline.width)
    ]
    return fit_plan(outline, tuple(lines), margin, 0.012, [Contact(0.02, 0.02, 0.002)])


def areas(points, quads):
    x, y = points[quads].transpose(2, 0, 1)
    return 0.5 * (x * np.roll(y, -1, axis=1) - np.roll(x, -1, axis=1) * y).sum(axis=1)


SHAPES = {
    "turned": (turned(0.06, 0.04)[0], 0.06 * 0.04, MARGIN * 0.2 + 4 * MARGIN**2),
    "triangle": (Polygon(((0.0, 0.0), (0.06, 0.0), (0.03, 0.05))), 1.5e-3, None),
    "arrow": (Polygon(((0.0, 0.0), (0.04, 0.02), (0.08, 0.0), (0.04, 0.06))), 1.6e-3, None),
    "disc": (Disc(0.03), math.pi * 9e-4, math.pi * (0.035**2 - 9e-4)),
}


@pytest.mark.parametrize(("outline", "gel", "ring"), SHAPES.values(), ids=SHAPES)
def test_cells_of_gel_and_margin_cover_both(outline, gel, ring) -> None:
    plan = plan_of(outline)
    size = areas(plan.points, plan.quads)
    assert size.min() > 0.0
    # Chords of the disc between nodes leave out a little.
    assert size[: plan.gel_quads].sum() == pytest.approx(
        gel, rel=5e-3 if ring and gel > 2.5e-3 else 1e-9
    )
    if ring:
        assert size[plan.gel_quads :].sum() == pytest.approx(ring, rel=1e-2)


def test_places_on_the_grid_are_found_again() -> None:
    outline, first = turned(0.06, 0.04)
    plan = plan_of(outline)
    points = np.random.default_rng(0).uniform((0.0, 0.0, 0.0), (0.06, 0.04, 0.01), (500, 3))
    points[:, :2] = points[:, :2] @ ROTATION.T + first
    places, slope = unfit(plan.shift, points)
    assert places[:, :2] + plan.shift(places) == pytest.approx(points[:, :2], abs=1e-9)
    step = np.array([1e-8, 0.0, 0.0])
    change = (unfit(plan.shift, points + step)[0] - unfit(plan.shift, points - step)[0]) / 2e-8
    assert np.median(np.abs(change - slope[..., 0])) < 1e-6  # but for points at edges of cells


def test_parts_narrower_than_cells_are_refused() -> None:
    hourglass = Polygon(
        ((0.0, 0.0), (0.06, 0.0), (0.0284, 0.03), (0.06, 0.06), (0.0, 0.06), (0.028, 0.03))
    )
    with pytest.raises(ConfigurationError, match="narrower than the cells"):
        plan_of(hourglass)


@pytest.mark.slow
def test_a_press_does_not_depend_on_how_the_sensor_lies() -> None:
    # Stairs in place of the sides were 30 % off.
    reference = SensorDesign.reference()
    straight, (outline, first) = Rectangle(0.06, 0.04), turned(0.06, 0.04)
    place = np.array([0.025, 0.015])
    fields = []
    for shape, rotation, origin in ((straight, np.eye(2), np.zeros(2)), (outline, ROTATION, first)):
        design = dataclasses.replace(reference, outline=shape, electrodes=uniform(shape, 8))
        x, y = (rotation @ place + origin).tolist()
        correction = solved_presses(design, Mechanics(), (Touch(x, y, depth=0.002),))
        grid = np.stack(
            np.meshgrid([0.001, 0.02, 0.04, 0.059], [0.001, 0.02, 0.039], [0.001, 0.004]), -1
        )
        points = grid.reshape(-1, 3)
        points[:, :2] = points[:, :2] @ rotation.T + origin
        moved = correction.in_gel(points)[:, :3]
        fields.append(np.column_stack([moved[:, :2] @ rotation, moved[:, 2]]))
    error = np.linalg.norm(fields[1] - fields[0]) / np.linalg.norm(fields[0])
    assert error < 0.08
