"""The live loop: every frame with its estimate, or with the reason why there is none."""

import itertools

import numpy as np
import pytest

from eitskin.errors import FrameError, UnusableFrameError
from eitskin.hardware import open_board, run_live

from live_fakes import FakeBoard, FakePipeline, FakeSimulator, frame


class DamagedFrames(FakePipeline):
    """Cannot use the frames with these numbers."""

    def __init__(self, damaged):
        super().__init__()
        self.damaged = damaged

    def process(self, frame):
        if frame.number in self.damaged:
            raise UnusableFrameError("all channels are open; check the cable")
        return super().process(frame)


def test_damaged_frames_are_counted_and_come_with_the_reason():
    board = FakeBoard([frame(number) for number in range(40)])
    readings = list(run_live(board, DamagedFrames({1, 2, *range(5, 39)}), newest=False))
    assert not board.newest
    assert [reading.unusable for reading in readings[:6]] == [0, 1, 2, 2, 2, 3]
    for reading in readings:
        damaged = reading.frame.number in {1, 2, *range(5, 39)}
        assert (reading.estimate is None) == damaged == ("check the cable" in reading.problem)


class Foreign(FakePipeline):
    """Refuses frames from a number on, as of another sensor."""

    def __init__(self, first):
        super().__init__()
        self.first = first

    def process(self, frame):
        if frame.number >= self.first:
            raise FrameError("another sensor")
        return super().process(frame)


def test_another_sensor_ends_the_loop_unless_it_was_the_right_one_before():
    board = FakeBoard([frame(number) for number in range(4)])
    with pytest.raises(FrameError, match="another sensor"):
        list(run_live(board, Foreign(0)))
    assert [reading.problem for reading in run_live(board, Foreign(2))] == ["", ""] + [
        "another sensor"
    ] * 2


def test_every_frame_comes_with_its_estimate_latency_and_rate():
    ticks = itertools.count(0.0, 0.25)
    board, pipeline = FakeBoard([frame(0), frame(1), frame(2)]), FakePipeline()
    readings = list(run_live(board, pipeline, clock=lambda: next(ticks)))
    assert [reading.frame.number for reading in readings] == pipeline.seen == [0, 1, 2]
    assert all(reading.estimate is pipeline.estimate for reading in readings)
    assert [reading.latency for reading in readings] == [0.25] * 3
    assert np.isnan(readings[0].rate)
    assert readings[2].rate == pytest.approx(2.0)
    assert board.newest


def test_a_slow_pipeline_sees_new_frames_and_the_rest_is_counted():
    # The board fills the terminal's queue while the pipeline works; what is then waiting goes.
    with open_board("virtual:?speed=max", simulator=FakeSimulator()) as board:
        numbers = []
        for reading in run_live(board, FakePipeline()):
            numbers.append(reading.frame.number)
            if board.counts.skipped:
                break
        assert board.counts.skipped + len(numbers) == numbers[-1] + 1
        assert board.lost == 0
