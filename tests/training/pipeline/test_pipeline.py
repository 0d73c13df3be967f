"""The pipeline as a whole: training, the state machine of references, refusals."""

import dataclasses
import os
from pathlib import Path

import numpy as np
import pytest
import torch

from eitskin.datasets import State, read_recording
from eitskin.errors import DataError, FrameError
from eitskin.simulator import Frame, Protocol, Status
from eitskin.training import Pipeline, PositionScore, TrainingSettings, evaluate
from eitskin.training.method.input_spec import LARGEST_SCALE
from eitskin.training.method.observations import Observations
from eitskin.training.pipeline.session import LONGEST_GAP

from linear_sensor import SETTINGS, linear_sensor, trained_pipeline

DATA = Path(os.environ.get("EITSKIN_DATA", Path(__file__).parents[4] / "shared" / "data"))


@pytest.fixture(scope="module")
def sensor():
    return linear_sensor()


@pytest.fixture(scope="module")
def dataset(sensor):
    return sensor.dataset()


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    path, said = trained_pipeline(tmp_path_factory)
    pipeline = Pipeline.load(path)
    pipeline.said = said
    return pipeline


@pytest.fixture
def pipeline(trained):
    trained.reset()
    return trained


class Session:
    """Frames of one sensor, numbered and timed as a board does."""

    def __init__(self, pipeline, sensor, period=0.3):
        self.pipeline, self.sensor, self.period = pipeline, sensor, period
        self.number, self.rng = 0, np.random.default_rng(7)

    def __call__(self, angle_deg=0.0, place=None, **changes):
        impedance = self.sensor.impedance(angle_deg, place, self.rng)
        frame = Frame(impedance, self.sensor.protocol, self.number * self.period, self.number)
        self.number += 1
        return self.pipeline.process(dataclasses.replace(frame, **changes))


@pytest.fixture
def session(pipeline, sensor):
    return Session(pipeline, sensor)


@pytest.mark.slow
def test_states_angles_and_touches_of_frames_never_seen(trained, dataset):
    unseen = trained.held_out(dataset)
    assert set(unseen).isdisjoint(dataset.split((0.6, 0.2, 0.2), SETTINGS.seed)[0])
    assert len(trained.held_out(dataset.select(slice(10)))) == 10
    assert {("state classifier", 9, 9), ("touch map", 1, 9)} <= set(map(tuple, trained.said))
    held_out = dataset.select(unseen)
    report = evaluate(trained, held_out)
    assert report.frames == 48
    assert min(report.states.accuracy.values()) > 0.85
    assert np.trace(report.states.confusion) >= 46
    assert report.bend.r2 > 0.999
    assert report.bend.touched_rmse_deg < 1.0
    one = report.touches["1"]
    assert one.frames == np.sum(held_out.state == State.TOUCH)
    assert one.found > 0.85
    assert one.mean_error_mm < 5.0
    assert one.ssim["touch_map"] > one.ssim["dynamic"] > one.ssim["static"]
    assert 0 < report.latency.p50_ms <= report.latency.p99_ms


@pytest.mark.slow
def test_session_of_bends_and_touches(session):
    first = session()
    assert first.state is State.IDLE
    assert (first.touches, first.problems, first.number) == ((), (), 0)
    assert session().bend_angle_deg == pytest.approx(0.0, abs=1.0)
    bent = session(30.0)
    assert bent.state is State.BEND
    assert bent.bend_angle_deg == pytest.approx(30.0, abs=1.0)
    assert bent.touch_map.max() == 0.0
    touched = session(30.0, (0.05, 0.03))
    assert touched.state is State.TOUCH
    assert touched.bend_angle_deg == pytest.approx(30.0, abs=1.0)
    (x, y, strength), *others = touched.touches
    assert np.hypot(x - 0.05, y - 0.03) < 0.005
    assert 0 < strength <= 1
    assert not others
    assert touched.touch_map.shape == (32, 80)
    assert touched.probabilities.sum() == pytest.approx(1.0)
    assert touched.time == pytest.approx(0.9)


@pytest.mark.slow
def test_touch_freezes_the_dynamic_reference_and_release_frees_it(pipeline, session):
    session()
    session(20.0)
    before = pipeline.references.touch.copy()
    for _ in range(3):
        assert session(20.0, (0.05, 0.03)).state is State.TOUCH
    np.testing.assert_array_equal(pipeline.references.touch, before)
    session(-10.0)
    assert not np.allclose(pipeline.references.touch, before, rtol=1e-4)
    moved = session(-10.0, (0.11, 0.02))
    assert np.hypot(moved.touches[0][0] - 0.11, moved.touches[0][1] - 0.02) < 0.006


@pytest.mark.slow
def test_stages_alone_say_what_the_session_says(pipeline, session, sensor):
    session()
    session(20.0)
    V = sensor.impedance(20.0, (0.05, 0.03))
    references = pipeline.references
    static, dynamic = (np.real(V / ref - 1)[None] for ref in (references.bend, references.touch))
    flat, one = np.abs(references.bend)[None], np.ones(1)
    alone = pipeline.method.predict(Observations(static, dynamic, flat, one, one, one, one, one))
    said = pipeline.process(Frame(V, sensor.protocol, 9.0, 9))
    np.testing.assert_allclose(said.touch_map, alone.touch_map[0], atol=1e-6)
    assert said.bend_angle_deg == pytest.approx(alone.bend_angle_deg[0])


@pytest.mark.slow
@pytest.mark.parametrize("change", [{"session": 1}, {"number": 0, "time": 0.0}])
def test_new_session_begins_with_new_references_and_is_told(session, change):
    session()
    assert session(30.0).state is State.BEND
    again = session(30.0, **change)
    assert again.state is State.IDLE
    assert again.bend_angle_deg == pytest.approx(0.0, abs=1.0)
    assert "a new session begins" in again.problems[0]


@pytest.mark.slow
def test_clock_that_runs_back_changes_no_reference(session):
    session()
    assert session(30.0).state is State.BEND
    again = session(30.0, time=0.0)
    assert again.state is State.BEND
    assert again.bend_angle_deg == pytest.approx(30.0, abs=1.0)
    (problem,) = again.problems
    assert "the clock ran back by 0.3 s" in problem


@pytest.mark.slow
def test_gap_before_a_touch_is_told(session):
    session()
    session(20.0)
    later = session.number * session.period + LONGEST_GAP
    session.number = int(later / session.period) + 2
    touched = session(20.0, (0.05, 0.03))
    assert touched.state is State.TOUCH
    assert "5 s" in touched.problems[0]
    session(20.0)
    assert session(20.0, (0.05, 0.03)).problems == ()


@pytest.mark.slow
def test_process_leaves_torchs_threads_alone(session):
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        session()
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)


# Bad channels


def with_bad(sensor, angle_deg=0.0, place=None):
    """Changes that make channel 0-2 flagged and 0-4 not finite."""
    impedance = sensor.impedance(angle_deg, place)
    impedance[3] = np.nan
    impedance[1] *= 2.0
    status = np.zeros(28, np.uint8)
    status[1] = Status.OPEN
    return {"impedance": impedance, "status": status}


@pytest.mark.slow
def test_bad_channels_are_left_out_and_named(session, sensor):
    session()
    estimate = session(**with_bad(sensor))
    assert estimate.state is State.IDLE
    assert estimate.problems == (
        "channel 0-2 is left out: board status 8",
        "channel 0-4 is left out: (nan+0j)",
    )
    bent = session(**with_bad(sensor, 30.0))
    assert bent.state is State.BEND
    assert bent.bend_angle_deg == pytest.approx(30.0, abs=1.0)
    touched = session(**with_bad(sensor, 30.0, (0.05, 0.03)))
    assert touched.state is State.TOUCH
    assert np.hypot(touched.touches[0][0] - 0.05, touched.touches[0][1] - 0.03) < 0.008


@pytest.mark.slow
def test_channel_that_was_bad_at_the_beginning_stays_out(session, sensor):
    session(**with_bad(sensor))
    later = "channel 0-2 is left out: it was bad when the session began"
    assert session(30.0).state is State.BEND
    touched = session(30.0, (0.05, 0.03))
    assert touched.state is State.TOUCH
    assert later in touched.problems


@pytest.mark.slow
def test_frame_of_mostly_bad_channels_is_refused_and_changes_nothing(pipeline, session):
    session()
    before = pipeline.references.bend.copy()
    status = np.full(28, Status.OPEN, np.uint8)
    status[:13] = 0
    with pytest.raises(FrameError, match="13 of 28"):
        session(status=status)
    np.testing.assert_array_equal(pipeline.references.bend, before)


# Refusals


@pytest.mark.slow
def test_frames_of_other_measurements_are_refused(pipeline, sensor):
    protocol = sensor.protocol
    swapped = Protocol((protocol.table[1], protocol.table[0], *protocol.table[2:]), 8)
    with pytest.raises(FrameError, match="a table for 8 electrodes"):
        pipeline.process(Frame(sensor.flat, swapped))
    sixteen = Protocol(protocol.table, 16)
    with pytest.raises(FrameError, match=r"pairwise:8.*16 electrodes"):
        pipeline.process(Frame(sensor.flat, sixteen))
    with pytest.raises(FrameError, match=r"40000 Hz.*50000"):
        pipeline.process(Frame(sensor.flat, protocol, frequency=50e3))
    assert pipeline.process(Frame(sensor.flat, protocol, frequency=40.1e3)).state is State.IDLE


@pytest.mark.slow
def test_gain_of_gel_or_board_is_no_reason_to_refuse(pipeline, sensor):
    for factor in (1.1 / LARGEST_SCALE, 0.9 * LARGEST_SCALE * np.exp(0.3j)):
        pipeline.reset()
        pipeline.process(Frame(sensor.flat * factor, sensor.protocol))
        bent = pipeline.process(Frame(sensor.impedance(30.0) * factor, sensor.protocol, 0.3, 1))
        assert bent.bend_angle_deg == pytest.approx(30.0, abs=1.0)


@pytest.mark.slow
def test_other_units_are_refused_and_the_ratio_named(pipeline, sensor):
    with pytest.raises(FrameError, match="40 times"):
        pipeline.process(Frame(sensor.flat * 40.0, sensor.protocol))
    assert pipeline.process(Frame(sensor.flat, sensor.protocol)).state is State.IDLE


@pytest.mark.slow
@pytest.mark.parametrize(
    "turned",
    [[(i + 1) % 8 for i in range(8)], [-i % 8 for i in range(8)], [4, 1, 2, 3, 0, 5, 6, 7]],
)
@pytest.mark.slow
def test_other_wiring_is_refused(pipeline, sensor, turned):
    """Electrodes counted from another one, the other way round, and two of them swapped."""
    index = {tuple(sorted(row[:2])): n for n, row in enumerate(sensor.protocol.table)}
    order = [index[tuple(sorted((turned[a], turned[b])))] for a, b, *_ in sensor.protocol.table]
    with pytest.raises(FrameError, match="another order"):
        pipeline.process(Frame(sensor.flat[order], sensor.protocol))


@pytest.mark.slow
def test_real_frame_of_another_board_is_refused(pipeline):
    path = DATA / "openeit_background_8.txt"
    if not path.is_file():
        pytest.skip(f"{path} is not there; set EITSKIN_DATA to the folder of real recordings")
    recording = read_recording(path, protocol=Protocol.pairwise(8))
    with pytest.raises(FrameError, match="times those"):
        pipeline.process(recording.frame(0))
    scaled = dataclasses.replace(recording.frame(0), impedance=recording.impedance[0] / 45.0)
    with pytest.raises(FrameError, match="scatter"):
        pipeline.process(scaled)


@pytest.mark.slow
def test_training_needs_geometry_and_labels(dataset):
    with pytest.raises(DataError, match=r"design and table.*touch positions"):
        Pipeline.fit(dataclasses.replace(dataset, design=None))
    with pytest.raises(DataError, match="0 touch"):
        Pipeline.fit(dataset.select(dataset.state == State.IDLE))
    with pytest.raises(DataError, match="positions of touches alone"):
        Pipeline.fit(dataset.select((dataset.state == State.TOUCH) & (dataset.touch_count > 0)))


@pytest.mark.slow
def test_evaluation_of_other_measurements_is_refused(trained, dataset):
    with pytest.raises(DataError, match="no frames"):
        evaluate(trained, dataset.select(slice(0)))
    other = dataclasses.replace(dataset, protocol=None)
    with pytest.raises(DataError, match="names its protocol"):
        evaluate(trained, other)


@pytest.mark.slow
def test_recorded_touches_are_tested_on_the_last_of_them(dataset):
    recording = dataclasses.replace(dataset, time=np.arange(240.0)[::-1])
    learned = Pipeline.fit(recording, TrainingSettings("touch position"))
    held_out = learned.held_out(recording)
    assert len(held_out) == 16
    assert held_out.max() < np.flatnonzero(recording.state == State.TOUCH)[16]
    score = PositionScore.of(learned, recording)
    assert score.mean_error_mm < 0.3 * score.guess_error_mm


def test_positions_no_better_than_a_guess_are_warned_of():
    few = PositionScore(1, 87.2, 87.2, 49.0).warnings
    assert len(few) == 2
    assert "49 mm" in few[1]
    assert not PositionScore(200, 3.0, 2.5, 49.0).warnings
