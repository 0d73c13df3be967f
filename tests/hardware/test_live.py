"""The live loop: every frame with its estimate, or with the reason why there is none."""

import dataclasses
import itertools
import json
import math
import re
import threading
from pathlib import Path

import numpy as np
import pytest
from command_line import run

from eitskin.errors import DeviceError, FrameError, UnusableFrameError
from eitskin.hardware import LiveReadings, open_board, run_live
from eitskin.hardware.live import DRIFT, AcquisitionClock
from eitskin.simulator import Frame, Protocol

from live_fakes import FakeBoard, FakePipeline, FakeSimulator, Info, frame

SINGULAR = np.linalg.LinAlgError("the matrix\nis singular \x1b[31m" + 1000 * "!")


@pytest.mark.parametrize(
    ("error", "refused", "said"),
    [
        (UnusableFrameError("all channels are open; check the cable"), {1, 3}, "check the cable"),
        (FrameError("another sensor"), {2, 3}, "another sensor"),  # it was the right one before
        (SINGULAR, {0}, "LinAlgError: the matrix is singular"),
        (SINGULAR, {0, 1, 2, 3}, "LinAlgError: the matrix is singular"),
    ],
)
def test_frames_that_a_pipeline_refuses_are_counted_and_come_with_the_reason(error, refused, said):
    board = FakeBoard([frame(number) for number in range(4)])
    pipeline = FakePipeline(errors=dict.fromkeys(refused, error))
    readings = list(run_live(board, pipeline, newest=False))
    assert not board.newest
    count = 0
    for reading in readings:
        damaged = reading.frame.number in refused
        count += damaged
        assert (reading.estimate is None) == damaged == (said in reading.problem)
        assert reading.unusable == count
        assert not reading.problem or reading.problem.isprintable()
        assert len(reading.problem) < 300


def test_every_frame_has_estimate_latency_and_rate_and_another_sensor_ends_the_loop():
    ticks = itertools.count(0.0, 0.25)
    board, pipeline = FakeBoard([frame(0), frame(1), frame(2)]), FakePipeline()
    readings = list(run_live(board, pipeline, clock=lambda: next(ticks)))
    assert [reading.frame.number for reading in readings] == pipeline.seen == [0, 1, 2]
    assert all(reading.estimate is pipeline.estimate for reading in readings)
    assert [reading.latency for reading in readings] == [0.25] * 3
    assert np.isnan(readings[0].rate)
    assert readings[2].rate == pytest.approx(2.0)
    assert board.newest
    refusing = FakePipeline(errors={0: FrameError("another sensor")})
    with pytest.raises(FrameError, match="another sensor"):
        list(run_live(FakeBoard([frame(0)]), refusing))


# ---- live readings ----


PAGE = Path(__file__).parents[2] / "docs" / "how-to" / "robot.md"


def silent(*steps):
    """Board that says nothing after these steps, for as long as it is open."""
    return FakeBoard(steps, silent=True, info=Info(period=1e6))


class Slow(FakePipeline):
    """Pipeline that waits for permission before each frame but the first."""

    def __init__(self):
        super().__init__()
        self.may = threading.Semaphore(1)

    def process(self, frame):
        self.may.acquire()
        return super().process(frame)


def test_lines_of_the_page_move_something_and_closing_ends_every_thread(monkeypatch):
    (lines,) = re.findall(r"```python\n(.*?LiveReadings.*?)```", PAGE.read_text(), re.DOTALL)
    assert len([line for line in lines.splitlines() if line]) <= 10
    monkeypatch.setattr("eitskin.training.open_pipeline", lambda _: FakePipeline(), raising=False)
    monkeypatch.setattr(
        "eitskin.hardware.virtual.virtual_board.Simulator", lambda *_, **__: FakeSimulator()
    )
    moved, names = [], {}

    class Arm:
        def move_away_from(self, x, y):
            moved.append((x, y))
            if len(moved) == 3:
                names["readings"].close()

    names["arm"] = Arm()
    exec(lines.replace('"serial:"', '"virtual:?speed=max"'), names)  # noqa: S102
    assert moved == [(0.05, 0.02)] * 3
    before, seen = threading.active_count(), threading.Event()
    readings = LiveReadings(open_board("virtual:?speed=max"), FakePipeline())
    readings.call(lambda _: seen.set())
    others = [threading.Thread(target=list, args=(readings,)) for _ in range(2)]
    for each in others:
        each.start()
    assert seen.wait(300.0)
    readings.close()
    for each in others:
        each.join(300.0)
    assert threading.active_count() == before


def test_a_slow_reader_gets_the_newest_and_never_a_stale_reading():
    pipeline = Slow()
    with LiveReadings(silent(*map(frame, range(6))), pipeline) as readings:
        each = iter(readings)
        assert next(each).frame.number == 0
        pipeline.may.release(5)
        last = [next(each).frame.number]
        while last[-1] != 5:
            last.append(next(each).frame.number)
        assert last == sorted(set(last))
        assert readings.newest.frame.number == 5
    with LiveReadings(silent(frame(0)), FakePipeline()) as readings:
        assert next(iter(readings)).frame.number == 0
        assert readings.newest.frame.number == 0
        readings._arrived -= 4e6  # more than three periods
        assert readings.newest is None
    assert readings.newest is None
    out = DeviceError("the cable is out")
    board = silent(frame(0), out, out, frame(1))
    with LiveReadings(board, FakePipeline()) as readings:
        for reading in readings:
            if reading.frame.number == 1:
                break
        assert (board.tries, readings.problem) == (2, "")


def test_errors_of_functions_and_sessions_end_and_are_raised_where_read():
    called, ended = [], threading.Event()

    def function(reading):
        called.append(reading.frame.number)
        ended.set()
        raise ValueError("the gripper is stuck")

    readings = LiveReadings(silent(frame(0)), FakePipeline())
    readings.call(function)
    assert ended.wait(300.0)
    with pytest.raises(ValueError, match="stuck"):
        readings.close()
    readings.close()
    assert called == [0]
    refusing = FakePipeline(errors={0: FrameError("another sensor")})
    with (
        pytest.raises(FrameError, match="another sensor"),
        LiveReadings(silent(frame(0)), refusing) as readings,
    ):
        list(readings)
    assert readings.problem == "another sensor"


# ---- acquisition clock ----


PROTOCOL = Protocol.pairwise(8)
PERIOD, DURATION = 0.3, 0.28


def timed(number, **changes):
    known = {"time": PERIOD * number, "number": number, "duration": DURATION} | changes
    return Frame(np.full(28, 600.0), PROTOCOL, **known)


@pytest.mark.slow
@pytest.mark.parametrize("drift", [0.0, -5e-5, 5e-5])
def test_begin_is_known_but_for_the_shortest_time_on_the_line_for_hours(drift):
    """Also where the two clocks drift apart, by 0.12 s in 40 minutes."""
    clock, count, shortest = AcquisitionClock(), 8_000, 0.002
    late = np.random.default_rng(0).exponential(0.004, count)
    late[0] = 0.0
    begun = 1000.0 + (1.0 + drift) * PERIOD * np.arange(count)
    came, one = begun + DURATION * (1.0 + drift) + shortest + late, timed(0)
    found = [
        clock.measurement_start(dataclasses.replace(one, time=PERIOD * k), at)
        for k, at in enumerate(came)
    ]
    assert found[0] == pytest.approx(begun[0] + shortest, abs=1e-4)
    assert np.abs(found - begun - shortest).max() < 0.003
    if not drift:
        off = np.subtract(found, begun)[:200]
        assert off == pytest.approx(shortest, abs=1e-9 + 200 * PERIOD * DRIFT)


def test_clocks_are_of_a_session_and_nothing_is_known_without_a_duration():
    clock = AcquisitionClock()
    assert clock.measurement_start(timed(0, time=100.0), 5.0) == pytest.approx(5.0 - DURATION)
    assert clock.measurement_start(timed(0, time=7000.0, session=2), 6.0) == pytest.approx(
        6.0 - DURATION
    )
    # A board that counts its time anew without saying so.
    assert clock.measurement_start(timed(0, time=1.0, session=2), 9.0) == pytest.approx(
        9.0 - DURATION
    )
    assert math.isnan(AcquisitionClock().measurement_start(timed(0, duration=math.nan), 5.0))


@pytest.mark.slow
def test_a_recording_replays_to_identical_lines(tmp_path):
    """Through the command, with lost frames, values that are none, and a restart."""
    scene = tmp_path / "script.toml"
    scene.write_text(
        "repeat = false\n[[steps]]\nframes = 4\n[steps.scene]\n"
        "[[steps]]\nframes = 3\n[steps.scene.bend]\nangle_deg = 20.0\n"
        "[[steps]]\nframes = 9\n[steps.scene]\n[[steps.scene.touches]]\nx = 0.05\ny = 0.02\n"
    )
    uri = f"virtual:?speed=max&scene={scene}&faults=lost_frame@5,inf_channel@8:4,reboot@12"

    def lines(*arguments):
        result = run("live", "reference.eitmodel", "--json", *arguments, code=0)
        found = [json.loads(line) for line in result.stdout.splitlines()]
        moment = ("wall_time", "latency_ms", "rate_hz", "dropped", "skipped", "reconnections")
        return [{k: v for k, v in line.items() if k not in moment} for line in found]

    live = lines("--board", uri, "--frames", "14", "--record", tmp_path / "run")
    assert lines("--board", f"replay:{tmp_path / 'run'}") == live
    assert {line["session"] for line in live} == {1, 2}
    assert live[-1]["lost"] == 1
    assert live[8]["bad_channels"] == {"0-5": "not finite"}
    assert {line["state"] for line in live} == {"idle", "bend", "touch"}


@pytest.mark.slow
def test_one_value_of_the_wrong_sign_is_left_out_and_many_are_no_sensor_at_rest(pipeline):
    layout = pipeline.layout
    noisy = layout.reference * (1 + 2e-4 * np.random.default_rng(0).standard_normal(28))
    good = Frame(noisy, layout.protocol, frequency=layout.frequency)
    for turned in ((numbers := np.arange(28)) == 5, numbers >= 0, numbers >= 13):
        values = np.where(turned, -noisy, noisy if turned[5] else np.nan)
        later = dataclasses.replace(good, impedance=values, number=1, time=0.3)
        pipeline.reset()
        first, second = run_live(FakeBoard([good, later]), pipeline)
        assert not first.estimate.problems
        if turned.sum() == 1:
            (told,) = second.estimate.problems
            assert "sign changed" in told
            assert layout.protocol.labels[5] in told
        else:
            assert second.estimate is None
            assert "changed their sign" in second.problem
