"""The live loop: every frame with its estimate, or with the reason why there is none."""

import itertools

import numpy as np
import pytest

from eitskin.errors import FrameError, UnusableFrameError
from eitskin.hardware import open_board, run_live
from eitskin.hardware.virtual.virtual_board import virtual_terminal

from live_fakes import FakeBoard, FakePipeline, FakeSimulator, frame


class Refusing(FakePipeline):
    """Pipeline that raises an error for frames of given numbers."""

    def __init__(self, error, refused):
        super().__init__()
        self.error, self.refused = error, refused

    def process(self, frame):
        if frame.number in self.refused:
            raise self.error
        return super().process(frame)


def test_damaged_frames_are_counted_and_come_with_the_reason():
    error = UnusableFrameError("all channels are open; check the cable")
    refused = {1, 2, *range(5, 39)}
    board = FakeBoard([frame(number) for number in range(40)])
    readings = list(run_live(board, Refusing(error, refused), newest=False))
    assert not board.newest
    assert [reading.unusable for reading in readings[:6]] == [0, 1, 2, 2, 2, 3]
    for reading in readings:
        damaged = reading.frame.number in refused
        assert (reading.estimate is None) == damaged == ("check the cable" in reading.problem)


def test_another_sensor_ends_the_loop_unless_it_was_the_right_one_before():
    error, board = FrameError("another sensor"), FakeBoard([frame(number) for number in range(4)])
    with pytest.raises(FrameError, match="another sensor"):
        list(run_live(board, Refusing(error, {0})))
    readings = run_live(board, Refusing(error, {2, 3}))
    assert [reading.problem for reading in readings] == ["", "", *["another sensor"] * 2]


@pytest.mark.parametrize("refused", [{0}, {2}, set(range(4))])
def test_a_pipeline_that_fails_on_a_frame_gives_a_reading_on_one_line(refused):
    error = np.linalg.LinAlgError("the matrix\nis singular \x1b[31m" + 1000 * "!")
    board = FakeBoard([frame(number) for number in range(4)])
    readings = list(run_live(board, Refusing(error, refused)))
    assert {reading.frame.number for reading in readings if reading.estimate is None} == refused
    for reading in readings:
        if reading.problem:
            assert "LinAlgError: the matrix is singular" in reading.problem
            assert reading.problem.isprintable()
            assert len(reading.problem) < 300
    assert readings[-1].unusable == len(refused)


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
    terminal = virtual_terminal(speed="max", simulator=FakeSimulator())
    with terminal, open_board(f"serial:{terminal.path}") as board:
        numbers = []
        for reading in run_live(board, FakePipeline()):
            numbers.append(reading.frame.number)
            if board.counts.skipped:
                break
        assert board.counts.skipped + len(numbers) == numbers[-1] + 1
        assert board.lost == 0
