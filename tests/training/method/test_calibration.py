"""Calibration of a pipeline to one sensor: inputs, effect, and the command."""

from contextlib import nullcontext

import numpy as np
import pytest

from eitskin.datasets import State
from eitskin.errors import ConfigurationError, DataError
from eitskin.simulator import Frame
from eitskin.training import Pipeline
from eitskin.training.method.interface import Calibration

from linear_sensor import linear_sensor, trained_pipeline

GAIN = 1.2  # of the sensor at hand, over that of the one trained with
ANGLES = (0.0, 0.0, -20.0, 15.0, 30.0, 42.5, 50.0)


@pytest.fixture(scope="module")
def sensor():
    return linear_sensor()


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    """A pipeline trained on the sensor, on disk."""
    return trained_pipeline(tmp_path_factory)[0]


def frames(sensor, angles, gain=GAIN):
    """Frames of a sensor that bends `gain` times as much."""
    rng = np.random.default_rng(3)
    return [
        Frame(sensor.impedance(gain * angle, None, rng), sensor.protocol, 0.3 * i, i)
        for i, angle in enumerate(angles)
    ]


def rmse(pipeline, sensor, angles=(-15.0, 10.0, 25.0, 40.0)):
    pipeline.reset()
    first, *rest = (pipeline.process(frame) for frame in frames(sensor, (0.0, *angles)))
    assert first.state is State.IDLE
    return float(np.sqrt(np.mean((np.array([e.bend_angle_deg for e in rest]) - angles) ** 2)))


@pytest.mark.slow
def test_a_sensor_of_another_gain_is_calibrated(saved, sensor, tmp_path):
    pipeline = Pipeline.load(saved)
    before = rmse(pipeline, sensor)
    said = pipeline.calibrate(frames(sensor, ANGLES), ANGLES)
    assert before > 3.0
    assert rmse(pipeline, sensor) < 0.5
    assert said.error_after_deg[0] < 0.2 * said.error_before_deg[0]
    again = Pipeline.load(pipeline.save(tmp_path / "mine.eitmodel"))
    assert again.calibration == pipeline.calibration
    assert rmse(again, sensor) == pytest.approx(rmse(pipeline, sensor), abs=1e-6)


@pytest.mark.slow
def test_angles_that_cannot_be_are_refused(saved, sensor):
    pipeline = Pipeline.load(saved)
    method = pipeline.method
    for angles, error, message in (
        ((0.0, 0.0, 0.0), ConfigurationError, r"bent.*3 flat"),
        ((0.0, 50.0, -20.0), DataError, r"do not fit.* for angles of"),
    ):
        with pytest.raises(error, match=message):
            pipeline.calibrate(frames(sensor, (0.0, -20.0, 50.0)), angles)
    assert pipeline.method is method
    assert not pipeline.calibration


@pytest.mark.parametrize(
    ("scale", "residual", "fits"),
    [(1.0, 8.0, True), (1.0, 9.0, False), (np.pi / 180, 0.9, True), (np.pi / 180, 1.1, False)],
)
def test_the_residual_is_judged_by_the_size_of_the_angles(scale, residual, fits):
    known = np.multiply(ANGLES[2:], scale)
    outcome = nullcontext() if fits else pytest.raises(DataError, match="do not fit")
    with outcome:
        Calibration((10.0,), (1.0,), (1.0,), residual).require_fit(known)
