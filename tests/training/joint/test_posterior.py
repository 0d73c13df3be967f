"""Posterior of the bend angle of frames by a curve that is little known and flattens."""

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import multivariate_normal

from eitskin.training.joint.bend_curve import MEAN_POWERS, RANDOM_POWERS, BendCurve
from eitskin.training.joint.combinations import Combinations
from eitskin.training.joint.specimen_model import (
    NORMAL_DEG,
    AngleEstimate,
    estimate_angle,
    posterior_angle,
)

CHANNELS, NOISE = 6, 2e-4
COMBINATIONS = Combinations(np.full(CHANNELS, NOISE))
LOW, HIGH = -20.0, 50.0


def flattening(unknown=2e-3):
    """Curve that rises to a few percent and hardly any further from 35 deg on."""
    shape = np.linspace(0.02, 0.05, CHANNELS) * np.where(np.arange(CHANNELS) % 3, 1.0, -0.7)
    mean = np.zeros((MEAN_POWERS, CHANNELS))
    mean[:3] = np.outer([1.0, -0.25, -0.3], shape)
    covariance = unknown**2 * np.eye(RANDOM_POWERS * CHANNELS)
    return BendCurve(mean, np.zeros((RANDOM_POWERS, CHANNELS)), covariance, (LOW, HIGH))


def seen(change):
    return COMBINATIONS.combined(change, 1.0, 0.0)


def frames(curve, count, rng):
    """Angles, and frames of as many sensors whose curves are drawn."""
    angles = rng.uniform(LOW, HIGH, count)
    for angle in angles:
        spread = curve.uncertainty(angle) + NOISE**2 * np.eye(CHANNELS)
        yield angle, seen(curve.value(angle) + rng.multivariate_normal(np.zeros(CHANNELS), spread))


def likeliest(curve, combined, sigma=0.0):
    return AngleEstimate(*estimate_angle(curve, combined.change, combined.noise), sigma)


def test_uncertainties_are_those_of_single_angles():
    curve, angles = flattening(), np.array([-12.0, 0.0, 41.0])
    expected = [curve.uncertainty(float(angle)) for angle in angles]
    np.testing.assert_allclose(curve.uncertainties(angles), expected, rtol=1e-12)


def test_moments_are_those_of_the_integral_over_all_angles():
    curve, wide = flattening(5e-3), 0
    for _, combined in frames(curve, 8, np.random.default_rng(3)):

        def density(angle, power, combined=combined):
            spread = combined.noise + curve.uncertainty(angle)
            beyond = max(LOW - angle, angle - HIGH, 0.0)
            likelihood = multivariate_normal(curve.value(angle), spread).pdf(combined.change)
            return likelihood * np.exp(-beyond) * angle**power

        total, first, second = (
            quad(density, LOW - 5.0, HIGH + 5.0, (k,), limit=200, points=(LOW, HIGH))[0]
            for k in range(3)
        )
        mean = first / total
        found = posterior_angle(curve, combined, likeliest(curve, combined))
        expected = np.sqrt(second / total - mean**2)
        if expected < NORMAL_DEG:
            continue
        wide += 1
        assert found.angle_deg == pytest.approx(mean, abs=0.1 * expected)
        assert found.deviation_deg == pytest.approx(expected, rel=0.1)
    assert wide > 2


def test_the_mean_errs_less_than_the_likeliest_angle_and_by_as_much_as_it_says():
    curve, errors, ratios = flattening(4e-3), [], []
    for angle, combined in frames(curve, 400, np.random.default_rng(4)):
        first = likeliest(curve, combined)
        found = posterior_angle(curve, combined, first)
        errors.append((first.angle_deg - angle, found.angle_deg - angle))
        ratios.append((errors[-1][1]) / found.deviation_deg)
    before, after = np.sqrt(np.mean(np.square(errors), axis=0))
    assert after < 0.95 * before
    assert np.sqrt(np.mean(np.square(ratios))) == pytest.approx(1.0, abs=0.1)


def test_an_angle_that_is_well_known_stays():
    curve = flattening(1e-5)
    combined = seen(curve.value(10.0))
    first = likeliest(curve, combined)
    assert first.deviation_deg < NORMAL_DEG
    found = posterior_angle(curve, combined, first)
    assert found.angle_deg == first.angle_deg
    assert found.deviation_deg == pytest.approx(first.deviation_deg)


def test_a_frame_that_the_curve_does_not_explain_tells_less():
    """A misfit of five standard deviations, of six measurements: (5 + 5 sqrt 10) / 5."""
    curve = flattening(1e-5)
    combined = seen(curve.value(10.0))
    first = likeliest(curve, combined, 5.0)
    found = posterior_angle(curve, combined, first)
    excess = 1.0 + np.sqrt(10.0)
    assert found.deviation_deg == pytest.approx(first.deviation_deg * np.sqrt(excess))
    wide = flattening(4e-3)
    combined = seen(wide.value(45.0))
    plain, doubtful = (
        posterior_angle(wide, combined, likeliest(wide, combined, sigma)) for sigma in (0.0, 5.0)
    )
    assert doubtful.deviation_deg > 1.2 * plain.deviation_deg
