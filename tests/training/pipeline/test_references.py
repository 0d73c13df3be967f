"""Static and dynamic references."""

import numpy as np
import pytest

from eitskin.training.method.observations import relative_difference
from eitskin.training.pipeline.references import LONGEST_MEAN, References

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
    references = References(NOISE)
    for still in stills:
        for frame in still:
            references.follow(frame)
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
        assert references.touch_frames == references.bend_frames == count


def test_mean_restarts_when_the_sensor_moves():
    references = followed(frames(FLAT, 20), frames(BENT, 20, seed=1))
    assert error(references.touch, BENT) < NOISE / 3
    assert error(references.bend, FLAT) < NOISE / 3


def test_still_noise_does_not_restart_the_mean():
    references = followed(frames(FLAT, 2000))
    assert references.touch_frames == LONGEST_MEAN


def test_static_reference_is_the_opening_stillness_only():
    references = followed(frames(FLAT, 5), frames(BENT, 3, seed=1))
    opening = references.bend.copy()
    for frame in frames(FLAT, 20, seed=2):
        references.follow(frame)
    np.testing.assert_array_equal(references.bend, opening)


def test_slow_drift_is_followed():
    drift = np.linspace(1.0, 1.01, 1000)  # a hundredth of the noise per frame at first
    references = followed(FLAT * drift[:, None])
    assert error(references.touch, FLAT * drift[-1]) < 2 * NOISE


def test_touch_freezes_and_ends_the_opening():
    references = followed(frames(FLAT, 5))
    references.freeze()
    frozen, opening = references.touch.copy(), references.bend.copy()
    references.freeze()
    np.testing.assert_array_equal(references.touch, frozen)
    references.follow(FLAT)
    np.testing.assert_array_equal(references.bend, opening)


def test_drop_forgets_everything():
    references = followed(frames(FLAT, 5), frames(BENT, 5))
    references.drop()
    assert references.empty
    assert references.bend.size == references.touch.size == 0
    references.follow(BENT)
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
