"""Live readings in a thread: newest first, reconnection, errors, and an end without leftovers."""

import re
import threading
from pathlib import Path

import pytest

from eitskin.errors import DeviceError, FrameError
from eitskin.hardware import Counts, LiveReadings, open_board

from live_fakes import FakePipeline, FakeSimulator, frame

PAGE = Path(__file__).parents[2] / "docs" / "robot.md"


class Cable:
    """Board whose frames the test hands out one by one; None unplugs it until it reconnects."""

    counts, uri = Counts(), "cable:"

    def __init__(self, *steps):
        self.steps, self.closed, self.reconnected = list(steps), threading.Event(), 0
        self.info = type("Info", (), {"period": 1e6})

    def frames(self, newest=False):
        assert newest
        while self.steps:
            step = self.steps.pop(0)
            if step is None:
                raise DeviceError("the cable is out")
            yield step
        self.closed.wait()  # silent, until it is closed
        raise DeviceError("closed")

    def reconnect(self):
        self.reconnected += 1

    def close(self):
        self.closed.set()


class Slow(FakePipeline):
    """Pipeline that waits for permission before each frame but the first."""

    def __init__(self):
        super().__init__()
        self.may = threading.Semaphore(1)

    def process(self, frame):
        self.may.acquire()
        return super().process(frame)


def test_the_lines_of_the_page_move_something(monkeypatch):
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


def test_a_slow_reader_gets_the_newest_reading_and_no_queue():
    pipeline = Slow()
    with LiveReadings(Cable(*(frame(number) for number in range(6))), pipeline) as readings:
        each = iter(readings)
        assert next(each).frame.number == 0
        pipeline.may.release(5)
        last = [next(each).frame.number]
        while last[-1] != 5:
            last.append(next(each).frame.number)
        assert last == sorted(set(last))
        assert readings.newest.frame.number == 5


def test_a_stale_reading_is_never_given_as_the_newest():
    with LiveReadings(Cable(frame(0)), FakePipeline()) as readings:
        assert next(iter(readings)).frame.number == 0
        assert readings.newest.frame.number == 0
        readings._arrived -= 4e6  # more than three periods
        assert readings.newest is None
    assert readings.newest is None


def test_a_board_that_goes_away_is_connected_to_again():
    board = Cable(frame(0), None, None, frame(1))
    with LiveReadings(board, FakePipeline()) as readings:
        for reading in readings:
            if reading.frame.number == 1:
                break
        assert (board.reconnected, readings.problem) == (2, "")


def test_a_function_is_called_with_readings_and_its_error_ends_the_session():
    called, ended = [], threading.Event()

    def function(reading):
        called.append(reading.frame.number)
        ended.set()
        raise ValueError("the gripper is stuck")

    readings = LiveReadings(Cable(frame(0)), FakePipeline())
    readings.call(function)
    assert ended.wait(20.0)
    with pytest.raises(ValueError, match="stuck"):
        readings.close()
    readings.close()
    assert called == [0]


def test_an_error_of_the_session_is_raised_where_it_is_read():
    class Refusing(FakePipeline):
        def process(self, frame):  # noqa: ARG002
            raise FrameError("another sensor")

    with (
        pytest.raises(FrameError, match="another sensor"),
        LiveReadings(Cable(frame(0)), Refusing()) as readings,
    ):
        list(readings)
    assert readings.problem == "another sensor"


def test_closing_ends_every_thread_and_iteration(monkeypatch):
    monkeypatch.setattr(
        "eitskin.hardware.virtual.virtual_board.Simulator", lambda *_, **__: FakeSimulator()
    )
    before, seen = threading.active_count(), threading.Event()
    readings = LiveReadings(open_board("virtual:?speed=max"), FakePipeline())
    readings.call(lambda _: seen.set())
    others = [threading.Thread(target=list, args=(readings,)) for _ in range(2)]
    for each in others:
        each.start()
    assert seen.wait(20.0)
    readings.close()
    for each in others:
        each.join(20.0)
    assert threading.active_count() == before
