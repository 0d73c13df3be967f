"""Interpolated fields, their images at sides, and those of presses on discs."""

import dataclasses
import math
from typing import ClassVar

import numpy as np
import pytest

from eitskin.geometry import Disc
from eitskin.simulator.deformation.field import CubicSplines, Field, Frame, Polynomials
from eitskin.simulator.deformation.node_sums import NodeSums, basis_values
from eitskin.simulator.deformation.solution_table import Axis, SolutionTable
from eitskin.simulator.deformation.tabled_corrections import (
    Corrections,
)

from pressed_stacks import THICKNESS, corrected, design_on

HEIGHT = 0.004
X, Y = (
    0.03 * np.array([-1.0, -0.4, -0.1, 0.05, 0.3, 1.0]),
    0.02 * np.linspace(-1.0, 1.0, 5) ** 3,
)


class Ramp:
    """Fade that is bilinear, with its slopes."""

    slopes: ClassVar = (20.0, -10.0)

    def weight(self, x, y):
        a, b = self.slopes
        return 1.0 + a * x + b * y + 100.0 * x * y, np.stack([a + 100.0 * y, b + 100.0 * x])


def splines():
    return CubicSplines(X), CubicSplines(Y)


def polynomials(stretch=0.0, vanish=False):
    return Polynomials(-0.03, 0.03, 9, stretch, vanish), Polynomials(-0.02, 0.02, 4)


def cubic(points: np.ndarray) -> np.ndarray:
    """Four components, cubic in the plane and quadratic over the height."""
    x, y, z = np.moveaxis(points / 0.01, -1, 0)
    parts = (x**3 - y * z, x * y**2 + z**2, x**2 * y + 0.3, y**3 * z**2)
    return np.stack([np.broadcast_to(part, points.shape[:-1]) for part in parts], axis=-1)


def columns(count: int, low: float = -0.015, high: float = 0.015) -> np.ndarray:
    rng = np.random.default_rng(0)
    plane = np.repeat(rng.uniform(low, high, (count, 1, 2)), 3, axis=1)
    return np.concatenate([plane, rng.uniform(0.0, HEIGHT, (count, 3, 1))], axis=-1)


def made(bases) -> Field:
    return Field.from_function(cubic, bases, HEIGHT, 2)


@pytest.mark.parametrize("bases", [splines(), polynomials()], ids=["splines", "polynomials"])
def test_cubics_are_reproduced(bases) -> None:
    field, at = made(bases), columns(40)
    assert field.values(at).transpose(2, 1, 0) == pytest.approx(cubic(at), abs=1e-9)
    assert field.on_grid(*(np.array([a, b]) for a, b in ((0, 0.01), (0.003, 0), (0, 0.002)))).shape


def test_cubics_have_their_slopes_and_points_beyond_the_values_of_faces():
    field, at = made(splines()), columns(40)
    moved = field.displacement_and_gradient(at)
    assert moved[:3].transpose(2, 1, 0) == pytest.approx(cubic(at)[..., :3], abs=1e-9)
    for axis in range(3):
        step = 1e-6 * np.eye(3)[axis]
        slope = (cubic(at + step) - cubic(at - step))[..., :3] / 2e-6
        found = moved[3:].reshape(3, 3, 3, 40)[:, axis].transpose(2, 1, 0)
        assert found == pytest.approx(slope, rel=1e-6, abs=1e-4)
    field = made(splines())
    at = np.array([[[0.05, 0.001, 0.002]], [[0.002, -0.09, 0.001]], [[0.0, 0.0, 0.006]]])
    nearest = np.clip(at, (X[0], Y[0], 0.0), (X[-1], Y[-1], HEIGHT))
    assert field.values(at) == pytest.approx(field.values(nearest))
    for ending in (made(polynomials(vanish=True)), framed(field, 1.0, 0.0)):
        beyond = at[:1] + np.array([0.05, 0.02, 0.0]) * (ending.frame is not None)
        assert np.all(ending.values(beyond) == 0.0)
    assert np.all(ending.displacement_and_gradient(beyond) == 0.0)


@pytest.mark.parametrize("stretch", [0.0, 2.0])
def test_smooth_functions_converge_geometrically(stretch) -> None:
    def wave(points):
        return np.exp(np.sin(60.0 * points[..., :1] + 40.0 * points[..., 1:2]))

    at, errors = columns(200), []
    exact = np.moveaxis(wave(at), -1, 0).swapaxes(1, 2)
    for degree in (8, 16, 24):
        bases = Polynomials(-0.03, 0.03, degree, stretch), Polynomials(-0.02, 0.02, degree)
        errors.append(np.abs(Field.from_function(wave, bases, HEIGHT, 1).values(at) - exact).max())
    assert errors[1] < 0.1 * errors[0]
    assert errors[2] < 0.1 * errors[1]


def framed(field: Field, cos: float, sin: float, fade=None) -> Field:
    frame = Frame(0.05, 0.02, cos, sin)
    return Field(field.bases, field.height, field.coefficients, frame, fade)


@pytest.mark.parametrize("fade", [None, Ramp()], ids=["whole", "faded"])
def test_a_turned_field_turns_displacements_and_slopes(fade) -> None:
    turned = framed(made(splines()), 0.6, 0.8, fade)
    at = columns(10, -0.008, 0.008) + np.array([0.05, 0.02, 0.0])
    moved = turned.displacement_and_gradient(at)
    assert moved[:3] == pytest.approx(turned.values(at)[:3])
    for axis in range(3):
        step = 1e-6 * np.eye(3)[axis]
        slope = (turned.values(at + step) - turned.values(at - step))[:3] / 2e-6
        found = moved[3:].reshape(3, 3, *slope.shape[1:])[:, axis]
        assert found == pytest.approx(slope, rel=1e-5, abs=1e-3)

    def along(points: np.ndarray) -> np.ndarray:
        """Vector along the frame's x axis, and a scalar."""
        return np.ones((*points.shape[:-1], 1)) * [1.0, 0.0, 0.0, 2.0]

    values = framed(Field.from_function(along, splines(), HEIGHT, 1), 0.6, 0.8).values(at)
    assert values[:, 0, 0] == pytest.approx([0.6, 0.8, 0.0, 2.0])


LENGTH, WIDTH, GEL = 0.15, 0.06, 0.005


def points(count: int = 60) -> np.ndarray:
    rng = np.random.default_rng(0)
    return rng.uniform((0.0, 0.0, 0.0), (0.9 * LENGTH, WIDTH, GEL), (count, 3))


def values(field: Field, at: np.ndarray) -> np.ndarray:
    return field.values(at[:, None])[:, 0].T


def test_sums_are_the_fields_and_their_images_one_by_one() -> None:
    """Half the size of the cells leaves a sixteenth of the error."""
    rng, at = np.random.default_rng(1), points()
    along, across = Polynomials(-0.2, 0.2, 5), Polynomials(0.0, WIDTH, 4)
    coefficients, origins = rng.normal(size=(3, 5, 4, 3, 4)), np.array([0.04, 0.09, 0.04])
    images, turns = np.array([(0, 0), (1, 1), (0, 1)]), np.tile(np.eye(4), (3, 1, 1))
    turns[:, :3, :3] = rng.normal(size=(3, 3, 3))
    scenes, expected = np.array([0, 1, 1]), np.zeros((2, len(at), 4))
    for field, x, image, turn, scene in zip(
        coefficients, origins, images, turns, scenes, strict=True
    ):
        there, signs = at.copy(), np.ones(4)
        for axis, size in enumerate((LENGTH, WIDTH)):
            if image[axis]:
                there[:, axis], signs[axis] = size - at[:, axis], -1.0
        there[:, 0] -= x
        expected[scene] += signs * values(Field((along, across), GEL, field), there) @ turn.T
    errors = []
    for cells in (12, 24):
        nodes = np.linspace(0.0, LENGTH, 2 * cells + 1), np.linspace(0.0, WIDTH, cells + 1)
        sums, fields = NodeSums(nodes, 2, 4, 4), coefficients.transpose(0, 1, 3, 4, 2)
        own = basis_values(along, nodes[0], origins)
        beside = across.dense(nodes[1])
        sums.add(fields, np.eye(3), own, beside, scenes, images, turns[:, :3, :3])
        found = sums.fields(GEL, np.ones(4))
        errors.append(
            max(
                np.abs(values(one, at) - each).max()
                for one, each in zip(found, expected, strict=True)
            )
        )
    assert errors[0] > 10.0 * errors[1]
    assert errors[1] < 1e-3 * np.abs(expected).max()


@pytest.mark.parametrize("upright", [False, True], ids=["below", "left"])
def test_a_table_beside_a_side_lies_along_each_of_them(upright) -> None:
    """As the same field in the frame of the side: inwards is y below, and x at the left."""
    rng = np.random.default_rng(2)
    nodes = np.linspace(0.0, LENGTH, 121), np.linspace(0.0, WIDTH, 61)
    s, t = (CubicSplines(half * np.linspace(-1.0, 1.0, 9)) for half in (0.2, 0.1))
    coefficients, foot, middle = rng.normal(size=(9, 9, 4, 4)), 0.035, 0.04
    frame = Frame(middle, foot, 0.0, -1.0) if upright else Frame(foot, middle, 1.0, 0.0)
    expected = values(Field((s, t), GEL, coefficients, frame), points())
    sums, field = NodeSums(nodes, 1, 4, 4), coefficients.transpose(0, 2, 3, 1)[None]
    inward = CubicSplines(t.nodes + middle).dense(nodes[1 - upright])
    if upright:
        turned = field.swapaxes(1, 4)[:, :, :, [1, 0, 2, 3]]
        own = basis_values(s, nodes[1], np.array([WIDTH - foot]))
        sums.add(turned, np.eye(1), inward, own, np.zeros(1, int), (0, 1))
    else:
        own = basis_values(s, nodes[0], np.array([foot]))
        sums.add(field, np.eye(1), own, inward, np.zeros(1, int), (0, 0))
    (found,) = sums.fields(GEL, np.ones(4))
    assert values(found, points()) == pytest.approx(expected, abs=2e-3 * np.abs(expected).max())


# Presses on discs


RADIUS, DISC_HEIGHT, DEEPEST = 0.05, THICKNESS, 0.003
OUTLINE = Disc(RADIUS)
DESIGN = design_on(OUTLINE)


def correction(points, aside, depth):
    """Correction, symmetric as any is, of a press on the x axis of a disc about the origin."""
    x, y, z = np.moveaxis(points, -1, 0) / np.array([RADIUS, RADIUS, DISC_HEIGHT])[:, None]
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
        return Field.from_function(there, bases, DISC_HEIGHT, 2).coefficients

    fields = [[solved(a, d) for d in depths] for a in aside]
    return SolutionTable.from_solutions(
        [Axis("distance_to_side", "mirrored", aside), Axis("depth", "from-zero", depths)],
        fields,
        {"extra_depth": np.outer((1.0 - aside / RADIUS) ** 2, depths)},
        {"thickness": 0.012, "height": DISC_HEIGHT, "modulus": 20e3, "nodes": nodes},
        tolerance=1e-12,
    )


def at(table, x, y, depth, height=DISC_HEIGHT):
    """Field and extra depth of a press on the disc by one table."""
    design = dataclasses.replace(DESIGN, thickness=height)
    (field,), extra = corrected(Corrections(design, (), table, ((table, 1.0),)), (x, y, depth))
    return field, extra


def disc_points(count=40):
    """Points about the middle of the disc (count, 3) [m]."""
    r, angle, z = np.random.default_rng(4).uniform(size=(3, count))
    r, angle = RADIUS * np.sqrt(r), 2.0 * math.pi * angle
    return np.stack([r * np.cos(angle), r * np.sin(angle), DISC_HEIGHT * z], axis=-1)


POINTS = disc_points()


def disc_values(field, points=POINTS):
    """Displacement and mean stress at points from the middle of the disc, (n, 4)."""
    return field.values(points[:, None] + np.array([RADIUS, RADIUS, 0.0]))[:, 0].T


@pytest.mark.parametrize(
    ("aside", "depth"), [(0.004, 0.001), (0.019, 0.0015), (0.04, DEEPEST), (RADIUS, 0.0015)]
)
def test_presses_are_the_solved_ones_and_interpolated_between(table, aside, depth) -> None:
    field, sunk = at(table, 2.0 * RADIUS - aside, RADIUS, depth)
    expected = correction(POINTS, aside, depth)
    scale = np.abs(expected).max(axis=0)
    assert disc_values(field) / scale == pytest.approx(expected / scale, abs=1e-6)
    assert sunk == pytest.approx(depth * (1.0 - aside / RADIUS) ** 2, abs=1e-9)


@pytest.mark.parametrize("angle", [0.4, 5.0])
def test_a_press_at_an_azimuth_is_one_on_the_axis_turned(table, angle) -> None:
    distance, (cos, sin) = 0.034, (math.cos(angle), math.sin(angle))
    Q = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    there, sunk = at(table, RADIUS + distance, RADIUS, 0.002)
    turned, below = at(table, RADIUS + distance * cos, RADIUS + distance * sin, 0.002)
    expected = disc_values(there)
    expected[:, :3] = expected[:, :3] @ Q.T
    assert disc_values(turned, POINTS @ Q.T) == pytest.approx(expected, rel=1e-6, abs=1e-12)
    assert below == pytest.approx(sunk)


def test_fields_go_with_the_thickness_of_the_gel_and_add_up(table):
    field, sunk = at(table, 0.07, 0.06, 1.1 * 0.002, 1.1 * DISC_HEIGHT)
    own, below = at(table, 0.07, 0.06, 0.002)
    taller = np.array([1.0, 1.0, 1.1])
    assert disc_values(field, POINTS * taller) == pytest.approx(
        disc_values(own) * np.append(taller, 1.0)
    )
    assert sunk == pytest.approx(1.1 * below)
    field, extra = at(table, 0.07, 0.06, 0.002)
    both = Corrections(DESIGN, (), table, ((table, 1.3), (table, -0.3)))
    fields, deeper = corrected(both, (0.07, 0.06, 0.002))
    expected = disc_values(field)
    scale = np.abs(expected).max(axis=0)  # fields are summed in single precision
    found = sum(map(disc_values, fields))
    assert found / scale == pytest.approx(expected / scale, abs=1e-6)
    assert deeper == pytest.approx(extra)


def test_modes_by_a_measure_hold_what_it_sees_of_small_fields():
    """Shapes are from a thousandth to 1 on a shift of ten, which has no differences."""
    rng, places = np.random.default_rng(2), np.linspace(0.0, 1.0, 8)
    sizes = np.geomspace(1e-3, 1.0, 8)[:, None, None, None, None]
    shapes = sizes * rng.standard_normal((8, 5, 4, 3, 4)) * np.eye(4)[2]
    fields = shapes + 10.0 * rng.standard_normal(sizes.shape) * np.eye(4)[2]

    def differences(each):
        return np.diff(each[..., :3], axis=1).reshape(len(each), -1)

    wanted, lost = differences(shapes), []
    for measure in (None, differences):
        axes = [Axis("place", "spline", places)]
        solved = SolutionTable.from_solutions(axes, fields, {}, {}, 1e-3, measure)
        stored = SolutionTable.from_arrays(solved.arrays(), np.float64)
        missing = differences(stored.evaluate(place=places)[0]) - wanted
        lost.append(np.linalg.norm(missing, axis=1) / np.linalg.norm(wanted, axis=1))
    assert lost[0].max() > 0.5
    assert lost[1].max() < 0.02
