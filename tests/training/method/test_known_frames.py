"""Frames of known angles and touches, and calibration by them."""

from contextlib import nullcontext

import numpy as np
import pytest
from known_frames import known_by_levels

from eitskin.errors import DataError
from eitskin.simulator import Frame
from eitskin.training import FrameLabel, Pipeline, TouchLabel
from eitskin.training.method.interface import Calibration

from smooth_sensor import FLAT

REST, BENT, UNKNOWN = FrameLabel(), FrameLabel(20.0), FrameLabel(None, ())
PRESS = (TouchLabel(0.05, 0.03, 8.0),)
PRESSED = FrameLabel(20.0, PRESS)


@pytest.mark.slow
def test_changes_are_from_the_mean_of_flat_frames_which_alone_change_no_estimate():
    found = known_by_levels([REST, REST, BENT], [0.001, 0.003, 0.012])
    seen = found.observations
    np.testing.assert_allclose(seen.flat, np.tile(FLAT * np.exp(0.002), (3, 1)))
    np.testing.assert_allclose(np.log1p(seen.static[2]), 0.010)
    np.testing.assert_allclose(seen.age, [0.0, 0.5, 1.0])
    assert seen.static_frames.tolist() == [2, 2, 2]
    assert found.is_bent.tolist() == [False, False, True]
    assert found.flat.tolist() == [True, True, False]
    pipeline = Pipeline.load("reference.eitmodel")
    reference, protocol = pipeline.layout.reference, pipeline.layout.protocol
    before = pipeline.method.outputs(pipeline.examples)
    still = [Frame(reference + 0j, protocol, float(i)) for i in range(3)]
    said = pipeline.adapt(still, [REST] * 3)
    assert (said.flat, said.bends, said.touches, said.left_out) == (3, 0, 0, 0)
    for name, array in pipeline.method.outputs(pipeline.examples).items():
        np.testing.assert_array_equal(array, before[name])


@pytest.mark.parametrize(
    ("labels", "levels", "row", "change", "reference_deg", "frames"),
    [
        # The latest untouched frames of its angle, in succession; then the next ones.
        ([REST, BENT, REST, BENT, BENT, PRESSED, BENT], [0, 0.5, 0, 0.010, 0.012, 0.031, 0.7], 5,
         0.020, 20.0, 2),
        ([REST, PRESSED, BENT, REST, BENT], [0, 0.03, 0.01, 0, 0.5], 1, 0.02, 20.0, 1),
        # At an unknown angle the frame before; at one that no frame has the flat sensor.
        ([REST, UNKNOWN, FrameLabel(None, PRESS)], [0, 0.01, 0.04], 2, 0.03, np.nan, 1),
        ([REST, FrameLabel(30.0, PRESS)], [0, 0.04], 1, 0.04, 0.0, 1),
    ],
)  # fmt: skip
def test_frames_that_a_touch_is_compared_with(labels, levels, row, change, reference_deg, frames):
    found = known_by_levels(labels, levels)
    np.testing.assert_allclose(np.log1p(found.observations.dynamic[row]), change)
    assert found.reference_deg[row] == pytest.approx(reference_deg, nan_ok=True)
    assert found.observations.dynamic_frames[row] == frames
    assert np.flatnonzero(found.has_touches).tolist() == [row]
    np.testing.assert_allclose(found.touches[row, 0], [0.05, 0.03, 8.0])


def test_touches_may_be_a_millimetre_beside_the_sensor():
    touch = TouchLabel(-0.0005, 0.0605, 8.0)
    table = known_by_levels([REST, FrameLabel(0.0, (touch,))], [0.0, 0.04]).touches
    assert table[1, 0, :2].tolist() == [touch.x, touch.y]


# Calibration by known angles


ANGLES = (-20.0, 15.0, 30.0, 42.5, 50.0)


@pytest.mark.parametrize(
    ("scale", "residual", "fits"),
    [(1.0, 8.0, True), (1.0, 9.0, False), (np.pi / 180, 0.9, True), (np.pi / 180, 1.1, False)],
)
def test_the_residual_is_judged_by_the_size_of_the_angles(scale, residual, fits):
    known = np.multiply(ANGLES, scale)
    outcome = nullcontext() if fits else pytest.raises(DataError, match="do not fit")
    with outcome:
        Calibration((10.0,), (1.0,), (1.0,), residual).require_fit(known)
