"""Order of frames: sessions and numbers begin sessions, clocks are told."""

import math

import numpy as np
import pytest

from eitskin.simulator import Frame, Protocol
from eitskin.training.pipeline.session import Session
from eitskin.training.pipeline.session_order import LONGEST_ELAPSED, LONGEST_GAP, SessionOrder

PROTOCOL = Protocol.pairwise(3)


def followed(*frames):
    """Last step of frames given as (number, time) or (number, time, session)."""
    order = SessionOrder()
    for each in frames:
        number, time, *session = each
        step = order.follow(Frame(np.ones(3), PROTOCOL, time, number, *session))
    return order, step


STEADY = tuple((n, 0.3 * n) for n in range(5))


def test_frames_in_order_are_no_event():
    order, step = followed(*STEADY)
    assert (step.new_session, step.gap, step.problems) == (False, False, ())
    assert order.elapsed == pytest.approx(1.2)


@pytest.mark.parametrize(
    ("last", "said"), [((5, 1.5, 1), "session 1 follows session 0"), ((2, 0.1), "2 follows 4")]
)
def test_sessions_and_numbers_begin_a_session_and_are_told(last, said):
    order, step = followed(*STEADY, last)
    assert step.new_session
    assert said in step.problems[0]
    assert order.elapsed == 0.0


@pytest.mark.parametrize("numbers", [(4, 4), (2**32 - 1, 0), (4, 900)])
def test_equal_wrapped_and_lost_numbers_go_on(numbers):
    assert not followed(*zip(numbers, (1.0, 1.3), strict=True))[1].new_session


def test_a_clock_that_runs_back_is_told_and_begins_nothing():
    order, step = followed(*STEADY, (5, 0.2))
    assert not step.new_session
    assert step.problems == (
        "frame 5: the clock ran back by 1 s; the references stay as they were",
    )
    assert order.elapsed == pytest.approx(1.2)


def test_a_clock_that_jumps_ahead_is_told():
    _, step = followed(*STEADY, (5, 3600.0))
    assert step.gap
    assert "jumped ahead" in step.problems[0]


@pytest.mark.parametrize("time", [math.nan, math.inf, -math.inf])
def test_a_time_that_is_no_number_is_told_and_forgotten(time):
    order, step = followed(*STEADY, (5, time))
    assert not step.new_session
    assert f"its time is {time}" in step.problems[0]
    order, step = followed(*STEADY, (5, time), (6, 1.8))
    assert step.problems == ()
    assert order.elapsed == pytest.approx(1.8)
    order, step = followed((0, time), (1, 7000.0), (2, 7000.3))
    assert (step.problems, step.gap) == ((), False)
    assert order.elapsed == pytest.approx(0.3)


def test_a_number_alone_that_runs_back_is_told_and_begins_nothing():
    order, step = followed(*STEADY, (2, 1.5))
    assert not step.new_session
    assert "its number follows 4" in step.problems[0]
    assert order.elapsed == pytest.approx(1.5)


@pytest.mark.parametrize("wrong", [(5_000_000, 1.5), (5, 4294.9), (5_000_000, 1e300), (2**31, 9e9)])
def test_one_frame_far_ahead_is_told_and_the_next_goes_on_where_the_frames_were(wrong):
    _, step = followed(*STEADY, wrong)
    assert not step.new_session
    assert len(step.problems) == 1
    order, step = followed(*STEADY, wrong, (6, 1.8))
    assert (step.new_session, step.gap, step.problems) == (False, False, ())
    assert order.elapsed == pytest.approx(1.8)


def test_a_restart_after_a_jump_ahead_begins_a_session():
    order, step = followed(*STEADY, (5, 4294.9), (0, 0.0))
    assert step.new_session
    assert order.elapsed == 0.0


def test_an_impossible_time_is_no_age():
    order, _ = followed((0, -1e308), (1, 1e308))
    assert order.elapsed == LONGEST_ELAPSED


@pytest.mark.parametrize("last", [(24, 7.2), (5, 4.0)])
def test_lost_frames_and_short_pauses_are_no_jump(last):
    assert followed(*STEADY, last)[1].problems == ()


@pytest.mark.parametrize("bends", [True, False])
def test_a_gap_before_a_touch_matters_on_sensors_that_bend(bends):
    protocol, values = Protocol.pairwise(4), np.ones(6)
    session = Session(1e-4, averages=False, bends=bends)
    for number, time in enumerate((0.0, 1.0, 2.0 + LONGEST_GAP)):
        session.follow(Frame(values, protocol, number=number, time=time))
        session.references.follow(values)
        session.renew(values, touched=number == 2)
    assert bool(session.problems(protocol.labels)) == bends
