"""The map from a nominal sensor to a specimen: electrodes, boundary, gradient, and its limits."""

import dataclasses

import numpy as np
import pytest

from eitskin.geometry import Disc, Electrode, Rectangle, SensorDesign
from eitskin.geometry.deformation.electrode_shift import electrode_shift
from eitskin.geometry.design.regular_layouts import uniform

NOMINAL = SensorDesign.reference()


def shifted(electrode: Electrode, by: float) -> Electrode:
    """Electrode moved along its side of the reference sensor."""
    if electrode.y in (0.0, 0.06):
        return dataclasses.replace(electrode, x=electrode.x + by)
    return dataclasses.replace(electrode, y=electrode.y + by)


def specimen() -> SensorDesign:
    """Reference sensor with moved electrodes and a thicker layer."""
    moves = np.random.default_rng(0).uniform(-1e-3, 1e-3, len(NOMINAL.electrodes)).tolist()
    return dataclasses.replace(
        NOMINAL,
        electrodes=tuple(map(shifted, NOMINAL.electrodes, moves)),
        thickness=1.04 * NOMINAL.thickness,
        encapsulated_thickness=1.04 * NOMINAL.encapsulated_thickness,
    )


def test_electrodes_come_to_lie_on_those_of_the_specimen() -> None:
    shift = electrode_shift(NOMINAL, specimen())
    for one, other in zip(NOMINAL.electrodes, specimen().electrodes, strict=True):
        along = np.array([1.0, 0.0] if one.y in (0.0, 0.06) else [0.0, 1.0])
        for way in (-0.5, 0.0, 0.5):
            at = np.array([*(np.array([one.x, one.y]) + way * one.width * along), 0.005])
            found = shift.positions(at)
            expected = np.array([other.x, other.y]) + way * one.width * along
            assert found[:2] == pytest.approx(expected, abs=1e-12)
            assert found[2] == pytest.approx(0.0052)


def test_the_boundary_stays_and_the_gradient_is_that_of_the_positions() -> None:
    shift = electrode_shift(NOMINAL, specimen())
    rng = np.random.default_rng(1)
    points = rng.uniform(1e-4, 1.0 - 1e-4, (200, 3)) * np.array([0.15, 0.06, 0.005])
    _, F = shift.mapped(points)
    step = 1e-8
    for k, along in enumerate(step * np.eye(3)):
        slope = (shift.positions(points + along) - shift.positions(points - along)) / (2 * step)
        assert np.abs(F[..., k] - slope).max() < 1e-6
    for axis, end in ((0, 0.0), (0, 0.15), (1, 0.0), (1, 0.06)):
        edge = points.copy()
        edge[:, axis] = end
        assert shift.positions(edge)[:, axis] == pytest.approx(end, abs=1e-15)


def test_one_set_of_points_is_mapped_once() -> None:
    shift, points = electrode_shift(NOMINAL, specimen()), np.full((3, 3), 0.002)
    assert shift.mapped(points)[0] is shift.mapped(points)[0]
    assert np.array_equal(shift.positions(points.copy()), shift.positions(points))


def test_only_sensors_that_differ_by_side_electrodes_and_thickness_are_mapped() -> None:
    first, *others = NOMINAL.electrodes
    for change in (
        {"outline": (larger := Rectangle(0.16, 0.06)), "electrodes": uniform(larger, 8)},
        {"outline": Disc(0.05), "electrodes": (Electrode(0.05, 0.0), Electrode(0.05, 0.1))},
        {"electrodes": tuple(others)},
        {"electrodes": NOMINAL.electrodes[::-1]},
        {"electrodes": (Electrode(0.05, 0.03, on="top"), *others)},
        {"electrodes": (dataclasses.replace(first, width=0.006), *others)},
    ):
        assert electrode_shift(NOMINAL, dataclasses.replace(NOMINAL, **change)) is None
    same = electrode_shift(NOMINAL, NOMINAL)
    assert same.gradient(np.full((1, 3), 0.002)) == pytest.approx(np.eye(3)[None])
