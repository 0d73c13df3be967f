"""A pipeline trained by the paper's method: its errors, calibration, sets that teach nothing."""

import dataclasses

import numpy as np
import pytest

from eitskin.datasets import State
from eitskin.errors import ConfigurationError, DataError
from eitskin.simulator import Frame
from eitskin.training import NetworkSettings, Pipeline, TrainingSettings, evaluate
from eitskin.training.method import input_spec

from linear_sensor import linear_sensor

pytestmark = pytest.mark.slow

SETTINGS = TrainingSettings(
    classifier=NetworkSettings(2e-3, epochs=9, batch=16),
    postprocessor=NetworkSettings(5e-3, epochs=24, batch=16),
)


@pytest.fixture(scope="module")
def sensor():
    return linear_sensor()


@pytest.fixture(scope="module")
def dataset(sensor):
    return sensor.dataset()


@pytest.fixture(scope="module")
def trained(dataset):
    told = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(input_spec, "PIXELS", 640)  # a quarter of the usual, for speed
        made = Pipeline.fit(dataset, SETTINGS, lambda *progress: told.append(progress))
    assert {("state classifier", 9, 9), ("touch map", 1, 24)} <= set(told)
    return made


@pytest.fixture(scope="module")
def saved(trained, tmp_path_factory):
    return trained.save(tmp_path_factory.mktemp("paper") / "trained.eitmodel")


def test_states_angles_and_touches_of_frames_never_seen(trained, dataset):
    unseen = trained.held_out(dataset)
    assert set(unseen).isdisjoint(dataset.split((0.6, 0.2, 0.2), SETTINGS.seed)[0])
    assert len(trained.held_out(dataset.select(slice(10)))) == 10
    held_out = dataset.select(unseen)
    report = evaluate(trained, held_out)
    assert report.frames == 48
    assert np.trace(report.states.confusion) >= 46
    assert report.bend.r2 > 0.999
    assert report.bend.touched_rmse_deg < 1.0
    one = report.touches["1"]
    assert one.frames == np.sum(held_out.state == State.TOUCH)
    assert one.found > 0.85
    assert one.mean_error_mm < 5.0
    assert one.ssim["touch_map"] > one.ssim["dynamic"] > one.ssim["static"]
    assert 0 < report.latency.p50_ms <= report.latency.p99_ms


def test_datasets_that_cannot_be_learned_from_or_judged_are_refused(trained, dataset):
    touched = (dataset.state == State.TOUCH) & (dataset.touch_count > 0)
    for data, message in (
        (dataclasses.replace(dataset, design=None), r"design and table.*touch positions"),
        (dataset.select(dataset.state == State.IDLE), "0 touch"),
        (dataset.select(touched), "positions of touches alone"),
    ):
        with pytest.raises(DataError, match=message):
            Pipeline.fit(data)
    with pytest.raises(DataError, match="no frames"):
        evaluate(trained, dataset.select(slice(0)))
    with pytest.raises(DataError, match="names its protocol"):
        evaluate(trained, dataclasses.replace(dataset, protocol=None))


# Calibration by known angles


ANGLES = (0.0, 0.0, -20.0, 15.0, 30.0, 42.5, 50.0)


def frames(sensor, angles, gain=1.2):
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


def test_sensors_of_another_gain_are_calibrated_by_angles_that_can_be(saved, sensor, tmp_path):
    pipeline = Pipeline.load(saved)
    before = rmse(pipeline, sensor)
    said = pipeline.calibrate(frames(sensor, ANGLES), ANGLES)
    assert before > 3.0
    assert rmse(pipeline, sensor) < 0.5
    assert said.error_after_deg[0] < 0.2 * said.error_before_deg[0]
    again = Pipeline.load(pipeline.save(tmp_path / "mine.eitmodel"))
    assert again.calibration == pipeline.calibration
    assert rmse(again, sensor) == pytest.approx(rmse(pipeline, sensor), abs=1e-6)
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
