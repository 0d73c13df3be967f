"""A trained pipeline: estimates in a session, bad channels, refusals."""

import dataclasses

import numpy as np
import pytest

from eitskin.datasets import State
from eitskin.errors import DataError, FrameError
from eitskin.simulator import Frame, Protocol
from eitskin.training import Pipeline, evaluate

from linear_sensor import SETTINGS, linear_sensor, trained_pipeline

PLACE = (0.05, 0.03)
PAIRS = Protocol.pairwise(8)

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def sensor():
    return linear_sensor()


@pytest.fixture(scope="module")
def dataset(sensor):
    return sensor.dataset()


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    path, told = trained_pipeline(tmp_path_factory)
    assert {("state classifier", 9, 9), ("touch map", 1, 24)} <= set(map(tuple, told))
    return Pipeline.load(path)


@pytest.fixture
def pipeline(trained):
    trained.reset()
    return trained


class Session:
    """Frames of one sensor, numbered and timed as a board does."""

    def __init__(self, pipeline, sensor):
        self.pipeline, self.sensor = pipeline, sensor
        self.number, self.rng = 0, np.random.default_rng(7)

    def __call__(self, angle_deg=0.0, place=None, **changes):
        impedance = self.sensor.impedance(angle_deg, place, self.rng)
        frame = Frame(impedance, self.sensor.protocol, self.number * 0.3, self.number)
        self.number += 1
        return self.pipeline.process(dataclasses.replace(frame, **changes))


@pytest.fixture
def session(pipeline, sensor):
    return Session(pipeline, sensor)


def away(estimate, place):
    """Distance of the strongest touch from a place [m]."""
    return np.hypot(*np.subtract(estimate.touches[0][:2], place))


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


def test_a_session_of_bends_and_touches(pipeline, session):
    first = session()
    assert (first.state, first.touches, first.problems, first.number) == (State.IDLE, (), (), 0)
    assert session().bend_angle_deg == pytest.approx(0.0, abs=1.0)
    bent = session(30.0)
    assert bent.state is State.BEND
    assert bent.bend_angle_deg == pytest.approx(30.0, abs=1.0)
    assert bent.touch_map.max() == 0.0
    before = pipeline.references.touch.copy()
    for _ in range(3):
        touched = session(30.0, PLACE)
    np.testing.assert_array_equal(pipeline.references.touch, before)  # frozen
    assert touched.state is State.TOUCH
    assert touched.bend_angle_deg == pytest.approx(30.0, abs=1.0)
    assert len(touched.touches) == 1
    assert away(touched, PLACE) < 0.005
    assert 0 < touched.touches[0].strength <= 1
    assert touched.touch_map.shape == (16, 40)
    assert touched.probabilities.sum() == pytest.approx(1.0)
    assert touched.time == pytest.approx(1.5)
    session(-10.0)
    assert not np.allclose(pipeline.references.touch, before, rtol=1e-4)
    assert away(session(-10.0, (0.11, 0.02)), (0.11, 0.02)) < 0.006


@pytest.mark.parametrize("change", [{"session": 1}, {"number": 0, "time": 0.0}])
def test_a_new_session_begins_with_new_references_and_is_told(session, change):
    session()
    assert session(30.0).state is State.BEND
    assert "the clock ran back by 0.3 s" in session(30.0, time=0.0).problems[0]
    assert session(30.0).bend_angle_deg == pytest.approx(30.0, abs=1.0)  # the references stay
    again = session(30.0, **change)
    assert again.state is State.IDLE
    assert again.bend_angle_deg == pytest.approx(0.0, abs=1.0)
    assert "a new session begins" in again.problems[0]


SWAPPED = Protocol((PAIRS.table[1], PAIRS.table[0], *PAIRS.table[2:]), 8)
REFUSED = {
    "table": (lambda flat: Frame(flat, SWAPPED), "a table for 8 electrodes"),
    "electrodes": (lambda flat: Frame(flat, Protocol(PAIRS.table, 16)), r"pairwise:8.*16 elec"),
    "frequency": (lambda flat: Frame(flat, PAIRS, frequency=50e3), r"40000 Hz.*50000"),
    "units": (lambda flat: Frame(flat * 40.0, PAIRS), "40 times"),
    "order": (lambda flat: Frame(flat[np.arange(28)[::-1]], PAIRS), "scatter|another order"),
}


@pytest.mark.parametrize(("frame", "message"), REFUSED.values(), ids=REFUSED)
def test_frames_of_other_sensors_and_measurements_are_refused(pipeline, sensor, frame, message):
    with pytest.raises(FrameError, match=message):
        pipeline.process(frame(sensor.flat))
    assert pipeline.process(Frame(sensor.flat, PAIRS, frequency=40.1e3)).state is State.IDLE


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
