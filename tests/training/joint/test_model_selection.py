"""How many touches are there, and how large are the errors of their places?"""

from dataclasses import replace

import numpy as np
import pytest
from one_frame import (
    CURVE,
    FAULTS,
    ONE,
    RESPONSE,
    STIFF,
    TOUCHES,
    TWO_FRAMES,
    changed,
    explained,
    frame,
    residual,
)
from scipy.stats import norm

from eitskin.training import FoundTouches
from eitskin.training.joint.frame_predictions import (
    STRANGEST,
    ErrorScale,
    disc_map,
    own_error_scale,
)
from eitskin.training.joint.model_selection import fit_plain
from eitskin.training.joint.objective import Unknowns
from eitskin.training.joint.touch_search import TOUCH_THRESHOLD, TouchCandidates

from smooth_sensor import (
    RANGES,
    places,
    response,
)

pytestmark = pytest.mark.slow

# The objective


@pytest.mark.parametrize("kind", ["far apart", "too near", "one", "untouched"])
def test_gradient_is_that_of_finite_differences(kind):
    """Finite differences of the misfit, prior of motion and touches and repulsion included.

    The response is one that does not depend on the bend: its slope is left out of the angle's.
    """
    touches = {
        "far apart": TOUCHES[2],
        "too near": [[0.050, 0.030, 6.0], [0.062, 0.036, 11.0], [0.055, 0.020, 8.0]],
        "one": TOUCHES[1],
        "untouched": [],
    }[kind]
    objective = replace(frame(TOUCHES[3], 20.0, 12.0, np.random.default_rng(0)), response=STIFF)
    unknowns = Unknowns(np.array(touches, dtype=float).reshape(-1, 3), 17.0)
    at = objective.linearise(unknowns)
    whitening = objective.whitening(at)
    quadratic = objective.quadratic(at, whitening)
    assert quadratic.misfit == pytest.approx(objective.misfit(at, whitening), rel=1e-12)
    np.testing.assert_allclose(at.residual, residual(objective, unknowns), rtol=1e-12, atol=1e-16)
    for i in range(len(quadratic.products[0, 1:])):
        step = 1e-4 * np.eye(len(quadratic.products[0, 1:]))[i]
        up, down = (
            objective.misfit(
                objective.linearise(objective.apply_step(unknowns, sign * step)), whitening
            )
            for sign in (1, -1)
        )
        expected = -0.5 * (up - down) / 2e-4
        size = np.abs(quadratic.products[0, 1:]).max()
        assert quadratic.products[0, 1:][i] == pytest.approx(expected, rel=1e-4, abs=1e-6 * size)


def test_residuals_are_whitened_and_errors_as_large_as_stated():
    """Whitened residuals of many specimens are uncorrelated, with unit variance."""
    rng = np.random.default_rng(4)
    touches, angle, reference, mismatch = np.array(TOUCHES[2]), 40.0, 10.0, 0.1
    one = response(mismatch, unseen=2).for_specimen(())
    objective = replace(frame(touches, angle, reference), response=one)
    unknowns = Unknowns(touches, angle)
    whitening = objective.whitening(objective.linearise(unknowns))
    unsure = CURVE.uncertainty(angle, reference)
    size = np.sqrt(np.sum(ONE(touches, angle) ** 2, axis=0))
    wrong = rng.multivariate_normal(np.zeros(28), TWO_FRAMES + unsure, 4000)
    # The first measurement lags half of the way behind the middle of the frame, the last leads.
    late = CURVE.slope(angle) * (angle - reference) * (np.arange(28) / 28 - 0.5)
    wrong = wrong + rng.standard_normal((4000, 1)) * late
    wrong = wrong + mismatch * size * rng.standard_normal((4000, 28))
    wrong = wrong + rng.standard_normal((4000, 2)) @ one.latent_changes(touches, angle)
    change = objective.combined.change
    left = np.array([whitening @ residual(changed(objective, change + w), unknowns) for w in wrong])
    np.testing.assert_allclose(np.cov(left.T), np.eye(28), atol=0.12)
    # Standardised errors of position, force and angle in 60 frames with one touch.
    rng = np.random.default_rng(5)
    scores, missed = [], 0
    for _ in range(60):
        touch = rng.uniform([0.012, 0.012, 5.0], [0.138, 0.048, 12.0])
        found = explained(frame([touch], 10.0, 10.0, rng))
        if len(found.touches) != 1:
            missed += 1
            continue
        off = found.touches[0] - touch
        angle = (found.angle_deg - 10.0) / found.angle_deviation_deg
        scores.append([off @ np.linalg.solve(found.covariance[0], off), angle**2])
    assert missed <= 2
    place, angle = np.mean(scores, axis=0)
    assert place == pytest.approx(3.0, abs=1.0)
    assert 0.3 < angle < 1.7


# Errors, and false alarms


def faint(share):
    """Response of a sensor with reduced sensitivity, and its candidates."""
    weak = replace(RESPONSE, scale=RESPONSE.scale * share).for_specimen(())
    touches = np.column_stack([places(), np.full(len(places()), RANGES.middle_force)])
    return weak, TouchCandidates(places(), RANGES.middle_force, weak(touches, 0.0))


@pytest.mark.parametrize("share", [1.0, 0.05])
def test_noise_alone_is_no_touch(share):
    """At most one false touch in a hundred frames, at low sensitivity too."""
    rng = np.random.default_rng(7)
    weak, tried = faint(share)
    alarms = 0
    for angle in np.tile([0.0, 20.0], 100):
        objective = replace(frame((), angle, angle, rng), response=weak)
        alarms += len(fit_plain(objective, tried).without_faults(FAULTS).complete().touches) > 0
    assert alarms < 2


def test_weak_touches_are_found_and_errors_beyond_the_model_are_none():
    """A touch of growing force is kept once it lowers the misfit by the threshold."""
    weak, tried = faint(0.05)
    whole = weak(np.array(TOUCHES[1]), 0.0)[0]
    for share, count in ((0.2, 0), (1.5, 1)):
        said = fit_plain(replace(changed(frame(), share * whole), response=weak), tried).complete()
        assert len(said.touches) == count
        assert (said.evidence > TOUCH_THRESHOLD) == (count > 0)
    rng = np.random.default_rng(13)
    change = ONE(np.array(TOUCHES[1]), 0.0)[0]
    noise = rng.multivariate_normal(np.zeros(28), TWO_FRAMES, 20)
    errors = change * rng.normal(scale=0.15, size=(20, 28))
    frames = [changed(frame(), change + each) for each in noise + errors]
    counts = [len(explained(each).touches) for each in frames]
    assert counts.count(1) > 18


# Standard errors of places


def test_scales_are_the_rms_of_ratios_stored_as_their_terms():
    touches = np.array([[[0.05, 0.03, 8.0]], [[0.10, 0.03, np.nan]], [[0.02, 0.02, 5.0]]])
    found = [
        FoundTouches.from_arrays(
            [[0.053, 0.034]], [1.0], None, [0.001]
        ),  # 5 mm, five standard errors
        FoundTouches.from_arrays([[0.10, 0.028]], [1.0], None, [0.001]),  # two
        FoundTouches.from_arrays([[0.10, 0.028]], [1.0], None, [0.001]),  # another touch
    ]
    assert own_error_scale(touches, found) == pytest.approx(np.sqrt((4 + 25 + 4) / (4 + 2)))
    assert ErrorScale.from_stored(np.array([3.0, 0.5])) == ErrorScale(3.0, 0.5)
    assert ErrorScale.from_stored(np.array(2.0)).evaluate(np.array([1.5])) == 2.0


def many(scale: ErrorScale, count: int = 4000):
    """Touches with normal errors of 1 mm along each axis, times the scale of their sensors."""
    rng = np.random.default_rng(3)
    features = rng.standard_normal((count, 2)) * rng.uniform(0.2, 2.0, (count, 1))
    touches = np.tile([[0.07, 0.03]], (count, 1, 1))
    factors = np.array([scale.evaluate(p) for p in features])[:, None]
    places = touches[:, 0] + 1e-3 * factors * rng.standard_normal((count, 2))
    spread = [np.sqrt(2.0) * 1e-3]
    found = [FoundTouches.from_arrays(place[None], [1.0], None, spread) for place in places]
    return touches, found, features


@pytest.mark.parametrize(
    "scale", [ErrorScale(1.5, 0.5), ErrorScale(1.0, 0.0), ErrorScale(1.0, 3.0)]
)
def test_the_scale_of_strange_sensors_is_found_again(scale):
    learned = ErrorScale.fit(*many(scale))
    # Standard errors of both are 3 to 6 %: squares of normal errors in two dimensions scatter by
    # their mean.
    assert learned.usual == pytest.approx(scale.usual, rel=0.05, abs=0.05)
    assert learned.strange == pytest.approx(scale.strange, rel=0.2, abs=0.05)
    for features, square in (([0.5, 0.5], 0.25), ([3.0, 1.0], STRANGEST)):
        expected = np.sqrt(learned.usual + square * learned.strange)
        assert learned.evaluate(np.array(features)) == pytest.approx(expected)


def test_standard_errors_are_never_scaled_below_those_of_the_noise_of_a_frame():
    """Errors of means of several frames are small next to those of the frames to come."""
    learned = ErrorScale.fit(*many(ErrorScale(0.3, 0.0)))
    assert learned == ErrorScale(1.0, 0.0)


SIZE, RADIUS = (0.150, 0.060), 0.0075


@pytest.mark.parametrize("deviation", [0.0, 4e-4, 0.003, 0.02])
def test_map_is_that_of_the_plain_formula(deviation):
    """Skipping pixels far from a touch changes nothing, also at the sensor's rim."""
    shape = (32, 80)
    x, y = (np.arange(80) + 0.5) * SIZE[0] / 80, (np.arange(32) + 0.5) * SIZE[1] / 32
    places = [[0.002, 0.058], [0.075, 0.030], [0.090, 0.031]]
    free = np.ones(shape)
    for px, py in places:
        away = np.sqrt((x - px) ** 2 + (y[:, None] - py) ** 2)
        free *= norm.sf((RADIUS - away) / max(deviation, 1e-6))
    said = disc_map(np.array(places), np.full(3, deviation), RADIUS, SIZE, shape)
    np.testing.assert_allclose(said, 1.0 - free, atol=1e-7)
