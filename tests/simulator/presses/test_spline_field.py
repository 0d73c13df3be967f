"""Spline fields: exact cubics, slopes, faces, and frames that are turned."""

import numpy as np
import pytest

from eitskin.simulator.mechanics.cubic_splines import CubicSplines
from eitskin.simulator.presses.fields.spline_field import SplineField, spline_sum
from eitskin.simulator.presses.fields.turned_field import TurnedField

HEIGHT = 0.004
NODES = (0.03 * np.array([-1.0, -0.4, -0.1, 0.05, 0.3, 1.0]), 0.02 * np.linspace(-1.0, 1.0, 5) ** 3)


def cubic(points: np.ndarray) -> np.ndarray:
    """Four components, cubic in the plane and quadratic over the height."""
    x, y, z = np.moveaxis(points / 0.01, -1, 0)
    parts = (x**3 - y * z, x * y**2 + z**2, x**2 * y + 0.3, y**3 * z**2)
    return np.stack([np.broadcast_to(part, points.shape[:-1]) for part in parts], axis=-1)


def columns(count: int, low: float = -0.015, high: float = 0.015) -> np.ndarray:
    rng = np.random.default_rng(0)
    plane = np.repeat(rng.uniform(low, high, (count, 1, 2)), 3, axis=1)
    return np.concatenate([plane, rng.uniform(0.0, HEIGHT, (count, 3, 1))], axis=-1)


def test_cubics_are_reproduced_with_their_slopes() -> None:
    field, at = SplineField.of(cubic, NODES, HEIGHT, 2), columns(40)
    assert field.values(at).transpose(2, 1, 0) == pytest.approx(cubic(at), abs=1e-9)
    moved = field.moved(at)
    assert moved[:3].transpose(2, 1, 0) == pytest.approx(cubic(at)[..., :3], abs=1e-9)
    for axis in range(3):
        step = 1e-6 * np.eye(3)[axis]
        slope = (cubic(at + step) - cubic(at - step))[..., :3] / 2e-6
        found = moved[3:].reshape(3, 3, 3, 40)[:, axis].transpose(2, 1, 0)
        assert found == pytest.approx(slope, rel=1e-6, abs=1e-4)


def test_splines_take_their_values_at_the_nodes_and_add_up_to_one() -> None:
    nodes = np.array([0.0, 0.1, 0.15, 0.4, 0.7, 1.0])
    splines, values = CubicSplines(nodes), np.random.default_rng(1).normal(size=6)
    assert splines.at(nodes) @ splines.fit @ values == pytest.approx(values)
    within = splines.at(np.linspace(0.0, 1.0, 31))
    assert within.sum(axis=1) == pytest.approx(np.ones(31))
    assert ((within != 0.0).sum(axis=1) <= 4).all()
    outside = splines.at(np.array([-0.1, 1.2]))
    assert outside == pytest.approx(splines.at(np.array([0.0, 1.0])))


def test_points_beyond_the_box_have_the_values_of_its_faces() -> None:
    field = SplineField.of(cubic, NODES, HEIGHT, 2)
    at = np.array([[[0.05, 0.001, 0.002]], [[0.002, -0.09, 0.001]], [[0.0, 0.0, 0.006]]])
    nearest = np.clip(at, field.box.low, field.box.high)
    assert field.values(at) == pytest.approx(field.values(nearest))


@pytest.mark.parametrize(("cos", "sin"), [(1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0)])
def test_a_field_turned_by_right_angles_is_one_in_the_frame_of_the_sensor(cos, sin) -> None:
    turned = TurnedField(SplineField.of(cubic, NODES, HEIGHT, 2), 0.05, 0.02, cos, sin)
    at = columns(60, -0.01, 0.01) + np.array([0.05, 0.02, 0.0])
    assert turned.straightened().values(at) == pytest.approx(turned.values(at), abs=1e-9)


def test_sums_of_splines_take_the_values_of_all_fields_at_the_nodes() -> None:
    rng = np.random.default_rng(3)
    one, other = (
        SplineField(NODES, HEIGHT, rng.normal(size=(6, 5, degree, 4))) for degree in (2, 3)
    )
    moved = TurnedField(other, 0.004, 0.002, 0.0, 1.0).straightened()
    nodes = np.linspace(-0.012, 0.012, 7), np.linspace(-0.008, 0.008, 9)
    at = np.stack(np.meshgrid(*nodes, [0.001, 0.003], indexing="ij"), axis=-1).reshape(-1, 2, 3)
    expected = one.values(at) + moved.values(at)
    assert spline_sum([one, moved], nodes).values(at) == pytest.approx(expected, abs=1e-9)


def test_a_turned_field_turns_displacements_and_slopes() -> None:
    field = SplineField.of(cubic, NODES, HEIGHT, 2)
    turned = TurnedField(field, 0.05, 0.02, 0.6, 0.8)
    at = columns(10, -0.008, 0.008) + np.array([0.05, 0.02, 0.0])
    moved = turned.moved(at)
    assert moved[:3] == pytest.approx(turned.values(at)[:3])
    for axis in range(3):
        step = 1e-6 * np.eye(3)[axis]
        slope = (turned.values(at + step) - turned.values(at - step))[:3] / 2e-6
        found = moved[3:].reshape(3, 3, *slope.shape[1:])[:, axis]
        assert found == pytest.approx(slope, rel=1e-5, abs=1e-3)

    def along(points: np.ndarray) -> np.ndarray:
        """Vector along the frame's x axis, and a scalar."""
        return np.ones((*points.shape[:-1], 1)) * [1.0, 0.0, 0.0, 2.0]

    values = TurnedField(SplineField.of(along, NODES, HEIGHT, 1), 0.05, 0.02, 0.6, 0.8).values(at)
    assert values[:, 0, 0] == pytest.approx([0.6, 0.8, 0.0, 2.0])
