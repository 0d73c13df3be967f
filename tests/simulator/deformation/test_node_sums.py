"""Sums of fields at nodes: against the fields one by one, their images, and other scenes."""

import numpy as np
import pytest

from eitskin.geometry import SensorDesign
from eitskin.simulator import Cylinder, Mechanics, Touch
from eitskin.simulator.deformation.field import CubicSplines, Field, Frame, Polynomials
from eitskin.simulator.deformation.node_sums import NodeSums, basis_values
from eitskin.simulator.deformation.pressed_sensor import PressedSensor
from eitskin.simulator.deformation.touches import dents

LENGTH, WIDTH, HEIGHT = 0.15, 0.06, 0.005
SENSOR = PressedSensor(SensorDesign.reference(), Mechanics())


def points(count: int = 60) -> np.ndarray:
    rng = np.random.default_rng(0)
    return rng.uniform((0.0, 0.0, 0.0), (0.9 * LENGTH, WIDTH, HEIGHT), (count, 3))


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
        expected[scene] += signs * values(Field((along, across), HEIGHT, field), there)
    errors = []
    for cells in (12, 24):
        nodes = np.linspace(0.0, LENGTH, 2 * cells + 1), np.linspace(0.0, WIDTH, cells + 1)
        sums, fields = NodeSums(nodes, 2, 4, 4), coefficients.transpose(0, 1, 3, 4, 2)
        own = basis_values(along, nodes[0], origins)
        sums.add(fields, np.eye(3), own, across.dense(nodes[1]), scenes, images)
        found = sums.fields(HEIGHT, np.ones(4))
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
    expected = values(Field((s, t), HEIGHT, coefficients, frame), points())
    sums, field = NodeSums(nodes, 1, 4, 4), coefficients.transpose(0, 2, 3, 1)[None]
    inward = CubicSplines(t.nodes + middle).dense(nodes[1 - upright])
    if upright:
        turned = field.swapaxes(1, 4)[:, :, :, [1, 0, 2, 3]]
        own = basis_values(s, nodes[1], np.array([WIDTH - foot]))
        sums.add(turned, np.eye(1), inward, own, np.zeros(1, int), (0, 1))
    else:
        own = basis_values(s, nodes[0], np.array([foot]))
        sums.add(field, np.eye(1), own, inward, np.zeros(1, int), (0, 0))
    (found,) = sums.fields(HEIGHT, np.ones(4))
    assert values(found, points()) == pytest.approx(expected, abs=2e-3 * np.abs(expected).max())


def test_bits_of_a_scene_depend_on_no_other_scene() -> None:
    rng = np.random.default_rng(3)
    small = Cylinder(0.0075)
    scenes = [
        tuple(
            Touch(*place, 5.0, indenter=small)
            for place in zip(
                rng.uniform(0.02, 0.13, count), rng.uniform(0.012, 0.048, count), strict=True
            )
        )
        for count in (1, 4, 0, 2, 3, 1, 4, 2, 1, 3)
    ]
    at = points(200)

    def gradients(order: list[int]) -> dict[int, bytes]:
        found = dents([scenes[n] for n in order], SENSOR)
        return {n: one.gradient(at).tobytes() for n, one in zip(order, found, strict=True)}

    alone = {n: gradients([n])[n] for n in range(len(scenes))}
    for order in (list(range(10)), rng.permutation(10).tolist(), [7, 1, 7][:2], [9, 0, 4]):
        assert all(alone[n] == each for n, each in gradients(order).items())
