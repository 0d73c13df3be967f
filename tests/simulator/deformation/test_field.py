"""Fields: exact polynomials and splines, slopes, faces, frames, and their sums at nodes."""

from typing import ClassVar

import numpy as np
import pytest

from eitskin.simulator.deformation.field import CubicSplines, Field, Frame, Polynomials
from eitskin.simulator.deformation.node_sums import NodeSums, basis_values

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


def test_cubics_have_their_slopes() -> None:
    field, at = made(splines()), columns(40)
    moved = field.displacement_and_gradient(at)
    assert moved[:3].transpose(2, 1, 0) == pytest.approx(cubic(at)[..., :3], abs=1e-9)
    for axis in range(3):
        step = 1e-6 * np.eye(3)[axis]
        slope = (cubic(at + step) - cubic(at - step))[..., :3] / 2e-6
        found = moved[3:].reshape(3, 3, 3, 40)[:, axis].transpose(2, 1, 0)
        assert found == pytest.approx(slope, rel=1e-6, abs=1e-4)


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


def test_points_beyond_the_box_have_the_values_of_its_faces_or_none() -> None:
    field = made(splines())
    at = np.array([[[0.05, 0.001, 0.002]], [[0.002, -0.09, 0.001]], [[0.0, 0.0, 0.006]]])
    nearest = np.clip(at, (X[0], Y[0], 0.0), (X[-1], Y[-1], HEIGHT))
    assert field.values(at) == pytest.approx(field.values(nearest))
    for ending in (made(polynomials(vanish=True)), framed(field, 1.0, 0.0)):
        beyond = at[:1] + np.array([0.05, 0.02, 0.0]) * (ending.frame is not None)
        assert np.all(ending.values(beyond) == 0.0)
    assert np.all(ending.displacement_and_gradient(beyond) == 0.0)


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
    images = np.array([(0, 0), (1, 1), (0, 1)])
    scenes, expected = np.array([0, 1, 1]), np.zeros((2, len(at), 4))
    for field, x, image, scene in zip(coefficients, origins, images, scenes, strict=True):
        there, signs = at.copy(), np.ones(4)
        for axis, size in enumerate((LENGTH, WIDTH)):
            if image[axis]:
                there[:, axis], signs[axis] = size - at[:, axis], -1.0
        there[:, 0] -= x
        expected[scene] += signs * values(Field((along, across), GEL, field), there)
    errors = []
    for cells in (12, 24):
        nodes = np.linspace(0.0, LENGTH, 2 * cells + 1), np.linspace(0.0, WIDTH, cells + 1)
        sums, fields = NodeSums(nodes, 2, 4, 4), coefficients.transpose(0, 1, 3, 4, 2)
        own = basis_values(along, nodes[0], origins)
        sums.add(fields, np.eye(3), own, across.dense(nodes[1]), scenes, images)
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
