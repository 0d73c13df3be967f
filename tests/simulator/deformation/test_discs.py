"""Corrections of presses on discs: symmetry, solved positions, range, names and neighbours."""

import dataclasses
import math

import numpy as np
import pytest

from eitskin.geometry import Disc
from eitskin.simulator.deformation.corrections import (
    Corrections,
)
from eitskin.simulator.deformation.field import CubicSplines, Field
from eitskin.simulator.deformation.solution_table import Axis, SolutionTable

from pressed_stacks import THICKNESS, corrected, design_on

RADIUS, HEIGHT, DEEPEST = 0.05, THICKNESS, 0.003
OUTLINE = Disc(RADIUS)
DESIGN = design_on(OUTLINE)


def correction(points, aside, depth):
    """Correction, symmetric as any is, of a press on the x axis of a disc about the origin."""
    x, y, z = np.moveaxis(points, -1, 0) / np.array([RADIUS, RADIUS, HEIGHT])[:, None]
    r = 1.0 - aside / RADIUS
    amount = depth * (1.0 + 40.0 * depth)
    along = (x - 0.3 * r) * (1.0 + x * r) * (1.0 + z)
    across = y * (1.0 + 0.5 * x * r) * (1.0 + z)
    upward = (1.0 + r**2 + x * r - 0.2 * (x**2 + y**2)) * z**2
    return amount * np.stack([along, across, upward, 1e5 * upward], axis=-1)


@pytest.fixture(scope="module")
def table() -> SolutionTable:
    """Table whose solved presses are those of `correction`."""
    aside = np.append(0.004 + 0.012 * np.array([0.0, 0.3, 0.8, 1.4, 2.2]), RADIUS)
    depths = np.array([0.001, 0.002, DEEPEST])
    nodes = np.linspace(-1.01 * RADIUS, 1.01 * RADIUS, 13)

    def solved(a, d):
        def there(points):
            flat = correction(points.reshape(-1, 3), a, d)
            return flat.reshape(*points.shape[:-1], 4)

        bases = CubicSplines(nodes), CubicSplines(nodes)
        return Field.from_function(there, bases, HEIGHT, 2).coefficients

    fields = [[solved(a, d) for d in depths] for a in aside]
    return SolutionTable.from_solutions(
        [Axis("distance_to_side", "mirrored", aside), Axis("depth", "from-zero", depths)],
        fields,
        {"extra_depth": np.outer((1.0 - aside / RADIUS) ** 2, depths)},
        {"thickness": 0.012, "height": HEIGHT, "modulus": 20e3, "nodes": nodes},
        tolerance=1e-12,
    )


def at(table, x, y, depth, height=HEIGHT):
    """Field and extra depth of a press on the disc by one table."""
    design = dataclasses.replace(DESIGN, thickness=height)
    (field,), extra = corrected(Corrections(design, (), table, ((table, 1.0),)), (x, y, depth))
    return field, extra


def disc_points(count=40):
    """Points about the middle of the disc (count, 3) [m]."""
    r, angle, z = np.random.default_rng(4).uniform(size=(3, count))
    r, angle = RADIUS * np.sqrt(r), 2.0 * math.pi * angle
    return np.stack([r * np.cos(angle), r * np.sin(angle), HEIGHT * z], axis=-1)


POINTS = disc_points()


def values(field, points=POINTS):
    """Displacement and mean stress at points from the middle of the disc, (n, 4)."""
    return field.values(points[:, None] + np.array([RADIUS, RADIUS, 0.0]))[:, 0].T


@pytest.mark.parametrize(
    ("aside", "depth"), [(0.004, 0.001), (0.019, 0.0015), (0.04, DEEPEST), (RADIUS, 0.0015)]
)
def test_presses_are_the_solved_ones_and_interpolated_between(table, aside, depth) -> None:
    field, sunk = at(table, 2.0 * RADIUS - aside, RADIUS, depth)
    expected = correction(POINTS, aside, depth)
    scale = np.abs(expected).max(axis=0)
    assert values(field) / scale == pytest.approx(expected / scale, abs=1e-6)
    assert sunk == pytest.approx(depth * (1.0 - aside / RADIUS) ** 2, abs=1e-9)


@pytest.mark.parametrize("angle", [0.4, 5.0])
def test_a_press_at_an_azimuth_is_one_on_the_axis_turned(table, angle) -> None:
    distance, (cos, sin) = 0.034, (math.cos(angle), math.sin(angle))
    Q = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    there, sunk = at(table, RADIUS + distance, RADIUS, 0.002)
    turned, below = at(table, RADIUS + distance * cos, RADIUS + distance * sin, 0.002)
    expected = values(there)
    expected[:, :3] = expected[:, :3] @ Q.T
    assert values(turned, POINTS @ Q.T) == pytest.approx(expected, rel=1e-6, abs=1e-12)
    assert below == pytest.approx(sunk)


def test_a_thicker_gel_has_the_field_of_a_press_as_deep_in_proportion(table) -> None:
    field, sunk = at(table, 0.07, 0.06, 1.1 * 0.002, 1.1 * HEIGHT)
    own, below = at(table, 0.07, 0.06, 0.002)
    taller = np.array([1.0, 1.0, 1.1])
    assert values(field, POINTS * taller) == pytest.approx(values(own) * np.append(taller, 1.0))
    assert sunk == pytest.approx(1.1 * below)


def test_weighted_tables_add_up(table) -> None:
    field, extra = at(table, 0.07, 0.06, 0.002)
    both = Corrections(DESIGN, (), table, ((table, 1.3), (table, -0.3)))
    fields, deeper = corrected(both, (0.07, 0.06, 0.002))
    expected = values(field)
    scale = np.abs(expected).max(axis=0)  # fields are summed in single precision
    found = sum(map(values, fields))
    assert found / scale == pytest.approx(expected / scale, abs=1e-6)
    assert deeper == pytest.approx(extra)
