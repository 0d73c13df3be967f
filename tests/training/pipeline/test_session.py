"""References of a session, and the order of its frames."""

import math

import numpy as np
import pytest

from eitskin.simulator import Frame, Protocol
from eitskin.training.method.observations import relative_difference
from eitskin.training.pipeline.references import LONGEST_MEAN
from eitskin.training.pipeline.session import LONGEST_ELAPSED, LONGEST_GAP, Session, SessionOrder

NOISE = 3e-4  # of the difference of two frames
FLAT = np.linspace(400.0, 820.0, 28) * np.exp(-0.02j)
BENT = FLAT * np.linspace(1.01, 1.05, 28)


def frames(truth, count, seed=0):
    """Noisy frames of a still sensor; each has 1 / sqrt(2) of the noise of a difference."""
    rng = np.random.default_rng(seed)
    noise = rng.normal(size=(2, count, len(truth))) * NOISE / np.sqrt(2)
    return truth * (1 + noise[0] + 1j * noise[1])


def error(reference, truth):
    return np.sqrt(np.mean(relative_difference(reference, truth) ** 2))


def followed(*stills):
    references = Session(NOISE)
    for still in stills:
        for frame in still:
            references.average(frame)
    return references


def test_difference_is_relative_real_and_blind_to_gain_and_phase():
    V, ref = np.array([11.0 + 1j]), np.array([10.0 + 1j])
    assert relative_difference(V, ref) == pytest.approx(((V - ref) / ref).real)
    turned = 3.0 * np.exp(0.7j)
    np.testing.assert_allclose(
        relative_difference(V * turned, ref * turned), relative_difference(V, ref)
    )
    assert relative_difference(np.array([1.02j]), np.array([1.00j])) == pytest.approx(0.02)


def test_averaging_while_still_brings_the_noise_down():
    one, many = followed(frames(FLAT, 1)), followed(frames(FLAT, 25))
    assert error(one.touch, FLAT) == pytest.approx(NOISE / np.sqrt(2), rel=0.4)
    assert error(many.touch, FLAT) == pytest.approx(NOISE / np.sqrt(2 * 25), rel=0.4)
    np.testing.assert_allclose(many.bend, many.touch)


def test_every_frame_of_a_stillness_weighs_the_same():
    still = frames(FLAT, LONGEST_MEAN)
    for count in (2, 5, LONGEST_MEAN):
        references = followed(still[:count])
        np.testing.assert_allclose(references.touch, still[:count].mean(axis=0), rtol=1e-13)
        assert references.dynamic.count == references.static.count == count


def test_mean_restarts_when_the_sensor_moves():
    references = followed(frames(FLAT, 20), frames(BENT, 20, seed=1))
    assert error(references.touch, BENT) < NOISE / 3
    assert error(references.bend, FLAT) < NOISE / 3


def test_still_noise_does_not_restart_the_mean():
    references = followed(frames(FLAT, 2000))
    assert references.dynamic.count == LONGEST_MEAN


def test_static_reference_is_the_opening_stillness_only():
    references = followed(frames(FLAT, 5), frames(BENT, 3, seed=1))
    opening = references.bend.copy()
    for frame in frames(FLAT, 20, seed=2):
        references.average(frame)
    np.testing.assert_array_equal(references.bend, opening)


def test_slow_drift_is_followed():
    drift = np.linspace(1.0, 1.01, 1000)  # a hundredth of the noise per frame at first
    references = followed(FLAT * drift[:, None])
    assert error(references.touch, FLAT * drift[-1]) < 2 * NOISE


def test_touch_freezes_and_ends_the_opening():
    references = followed(frames(FLAT, 5))
    references.renew(FLAT, touched=True)
    frozen, opening = references.touch.copy(), references.bend.copy()
    references.renew(FLAT, touched=True)
    np.testing.assert_array_equal(references.touch, frozen)
    references.average(FLAT)
    np.testing.assert_array_equal(references.bend, opening)


def test_drop_forgets_everything():
    references = followed(frames(FLAT, 5), frames(BENT, 5))
    references.begin()
    assert references.empty
    assert references.bend.size == references.touch.size == 0
    references.average(BENT)
    np.testing.assert_array_equal(references.bend, BENT)


def test_bad_channel_keeps_what_was_known_and_a_late_one_is_taken_up():
    broken = np.where(np.arange(28) == 3, np.nan, FLAT)
    references = followed([FLAT], [broken * 1.00001])
    assert references.touch[3] == FLAT[3]
    late = followed([broken], [FLAT])
    np.testing.assert_allclose(late.touch, FLAT)

    broken = np.where(np.arange(28) == 3, np.nan, BENT)
    references = followed(frames(FLAT, 10), [broken])
    assert error(np.delete(references.touch, 3), np.delete(BENT, 3)) < 1e-12


PROTOCOL = Protocol.pairwise(3)


def last_step(*frames):
    """Last step of frames given as (number, time) or (number, time, session)."""
    order = SessionOrder()
    for each in frames:
        number, time, *session = each
        step = order.follow(Frame(np.ones(3), PROTOCOL, time, number, *session))
    return order, step


STEADY = tuple((n, 0.3 * n) for n in range(5))


def test_frames_in_order_are_no_event():
    order, step = last_step(*STEADY)
    assert (step.new_session, step.gap, step.problems) == (False, False, ())
    assert order.elapsed == pytest.approx(1.2)


@pytest.mark.parametrize(
    ("last", "said"), [((5, 1.5, 1), "session 1 follows session 0"), ((2, 0.1), "2 follows 4")]
)
def test_sessions_and_numbers_begin_a_session_and_are_told(last, said):
    order, step = last_step(*STEADY, last)
    assert step.new_session
    assert said in step.problems[0]
    assert order.elapsed == 0.0


@pytest.mark.parametrize("numbers", [(4, 4), (2**32 - 1, 0), (4, 900)])
def test_equal_wrapped_and_lost_numbers_go_on(numbers):
    assert not last_step(*zip(numbers, (1.0, 1.3), strict=True))[1].new_session


def test_a_clock_that_runs_back_is_told_and_begins_nothing():
    order, step = last_step(*STEADY, (5, 0.2))
    assert not step.new_session
    assert step.problems == (
        "frame 5: the clock ran back by 1 s; the references stay as they were",
    )
    assert order.elapsed == pytest.approx(1.2)


def test_a_clock_that_jumps_ahead_is_told():
    _, step = last_step(*STEADY, (5, 3600.0))
    assert step.gap
    assert "jumped ahead" in step.problems[0]


@pytest.mark.parametrize("time", [math.nan, math.inf, -math.inf])
def test_a_time_that_is_no_number_is_told_and_forgotten(time):
    order, step = last_step(*STEADY, (5, time))
    assert not step.new_session
    assert f"its time is {time}" in step.problems[0]
    order, step = last_step(*STEADY, (5, time), (6, 1.8))
    assert step.problems == ()
    assert order.elapsed == pytest.approx(1.8)
    order, step = last_step((0, time), (1, 7000.0), (2, 7000.3))
    assert (step.problems, step.gap) == ((), False)
    assert order.elapsed == pytest.approx(0.3)


def test_a_number_alone_that_runs_back_is_told_and_begins_nothing():
    order, step = last_step(*STEADY, (2, 1.5))
    assert not step.new_session
    assert "its number follows 4" in step.problems[0]
    assert order.elapsed == pytest.approx(1.5)


@pytest.mark.parametrize("wrong", [(5_000_000, 1.5), (5, 4294.9), (5_000_000, 1e300), (2**31, 9e9)])
def test_one_frame_far_ahead_is_told_and_the_next_goes_on_where_the_frames_were(wrong):
    _, step = last_step(*STEADY, wrong)
    assert not step.new_session
    assert len(step.problems) == 1
    order, step = last_step(*STEADY, wrong, (6, 1.8))
    assert (step.new_session, step.gap, step.problems) == (False, False, ())
    assert order.elapsed == pytest.approx(1.8)


def test_a_restart_after_a_jump_ahead_begins_a_session():
    order, step = last_step(*STEADY, (5, 4294.9), (0, 0.0))
    assert step.new_session
    assert order.elapsed == 0.0


def test_an_impossible_time_is_no_age():
    order, _ = last_step((0, -1e308), (1, 1e308))
    assert order.elapsed == LONGEST_ELAPSED


@pytest.mark.parametrize("last", [(24, 7.2), (5, 4.0)])
def test_lost_frames_and_short_pauses_are_no_jump(last):
    assert last_step(*STEADY, last)[1].problems == ()


@pytest.mark.parametrize("bends", [True, False])
def test_a_gap_before_a_touch_matters_on_sensors_that_bend(bends):
    protocol, values = Protocol.pairwise(4), np.ones(6)
    session = Session(1e-4, averages=False, bends=bends)
    for number, time in enumerate((0.0, 1.0, 2.0 + LONGEST_GAP)):
        session.follow(Frame(values, protocol, number=number, time=time))
        session.average(values)
        session.renew(values, touched=number == 2)
    assert bool(session.problems(protocol.labels)) == bends
