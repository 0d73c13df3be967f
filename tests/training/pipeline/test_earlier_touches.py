"""Touches of an earlier frame, where later ones show none on their own."""

import numpy as np
import pytest

from eitskin.training.pipeline.held_touch import MAX_HELD_FRAMES, EarlierTouches, Phases

RNG = np.random.default_rng(0)
FLAT = RNG.uniform(10.0, 90.0, 28).astype(complex)
FORCE, ALONG, BEND = RNG.standard_normal((3, 28)) * [[1e-3], [1e-2], [1e-2]]
DEVIATION = 2e-4


@pytest.fixture
def touches():
    """One touch of the flat sensor, whose change is `FORCE`."""
    earlier = EarlierTouches()
    directions = np.array([ALONG, ALONG, FORCE, BEND])
    assert len(earlier.renew(frame(FORCE), directions)) == 3
    return earlier


def frame(change):
    return FLAT * (1.0 + change + DEVIATION * np.random.default_rng(1).standard_normal(28))


@pytest.mark.parametrize(
    ("share", "lingers"), [(1.0, True), (0.3, True), (0.1, False), (0.0, False)]
)
def test_a_weaker_touch_lingers_until_noise_hides_it(touches, share, lingers):
    said = [touches.linger(frame(share * FORCE), FLAT, DEVIATION**2) for _ in range(3)]
    assert said == [lingers] * 3


@pytest.mark.parametrize(
    ("share", "other", "lingers"),
    [(1.0, 0.0, True), (1.0, 0.3, True), (1.0, 2.0, False), (0.0, 0.0, False), (0.0, 0.3, False)],
)
def test_a_touch_lingers_where_the_sensor_has_bent_since(touches, share, other, lingers):
    """Whatever else the frame shows, unless that is more than the touch."""
    unexplained = other * np.roll(FORCE, 1)
    bent = frame(share * FORCE + 2.0 * BEND + unexplained)
    assert touches.linger(bent, FLAT, DEVIATION**2) == lingers


def test_a_bend_hides_a_touch_until_it_is_released(touches):
    for turn in (1.0, 2.0):
        bent = touches.bent_reference(frame(FORCE + turn * BEND), turn == 1.0, DEVIATION**2)
        assert np.abs(bent / FLAT - 1.0 - turn * BEND).max() < 1e-3
        assert touches.hidden
    assert touches.bent_reference(frame(3.0 * BEND), False, DEVIATION**2) is None
    assert not touches.hidden
    assert not touches.undecided


def test_what_is_undecided_waits_for_a_while(touches):
    for count in range(1, MAX_HELD_FRAMES + 2):
        half = frame(0.5 * FORCE + 1.0 * BEND)
        assert touches.bent_reference(half, count == 1, DEVIATION**2) is None
        assert touches.undecided == (count if count <= MAX_HELD_FRAMES else 0)


def test_phases_are_told_once_three_steps_have_shown_their_noise():
    phases = Phases()
    counts = [len(phases.phase_change(frame(1j * ALONG), FLAT)) for _ in range(5)]
    assert counts == [0, 0, 0, 28, 28]
