"""Bend curves: mixed model, calibration, and estimates of the angle."""

from types import SimpleNamespace

import numpy as np
import pytest
from made_up_frames import made_up_frames
from scipy.integrate import quad

from eitskin.training.joint.bend_curve import (
    MEAN_POWERS,
    RANDOM_POWERS,
    BendCurve,
    BendCurvePrior,
)
from eitskin.training.joint.combinations import Combinations
from eitskin.training.joint.mirrored_frames import SCALE
from eitskin.training.joint.specimen_model import (
    NORMAL_DEG,
    RIVAL,
    AngleEstimate,
    SpecimenModel,
    angle_standard_error,
    estimate_angle,
    grid_log_densities,
    posterior_angle,
)

from on_demand import OnDemand

stats = OnDemand("scipy.stats")

CHANNELS = 6
SIZE = RANDOM_POWERS * CHANNELS
NOISE = 2e-4**2 * np.eye(CHANNELS)
COMBINATIONS = Combinations(np.full(CHANNELS, 2e-4))
RANGE = (-20.0, 50.0)


def powers(angle_deg, count):
    return (np.asarray(angle_deg)[..., None] / SCALE) ** np.arange(1, count + 1)


def mean_curve():
    """Monotonic, nonlinear change of a few percent."""
    shape = np.linspace(0.02, 0.05, CHANNELS) * np.where(np.arange(CHANNELS) % 3, 1.0, -0.7)
    return np.outer([1.0, 0.2, -0.1, 0.02, 0.01], shape)


def own_covariance(rng, size=1.5e-3):
    """Covariance of the random effects, of rank five plus a small diagonal."""
    ways = rng.standard_normal((5, RANDOM_POWERS * CHANNELS)) * size
    return ways.T @ ways / 5 + (0.1 * size) ** 2 * np.eye(RANDOM_POWERS * CHANNELS)


@pytest.fixture
def rng():
    return np.random.default_rng(5)


@pytest.fixture
def curve(rng):
    own = np.zeros((RANDOM_POWERS, CHANNELS))
    return BendCurve(mean_curve(), own, own_covariance(rng), RANGE)


# A curve


def test_curves_are_those_of_the_formula_conditioned_by_bayes_rule(curve, rng):
    """Value, slope and covariance equal their plain formulas."""
    own = 1e-3 * rng.standard_normal(curve.effects.shape)
    curve = BendCurve(curve.mean, own, curve.covariance, RANGE)
    np.testing.assert_array_equal(curve.value(0.0), 0.0)
    angles, values = curve.grid(8)
    np.testing.assert_allclose(angles, np.linspace(*RANGE, 8))
    for angle, on_grid in zip(angles, values, strict=True):
        expected = powers(angle, MEAN_POWERS) @ curve.mean + powers(angle, RANDOM_POWERS) @ own
        value, slope = curve.value_and_slope(angle)
        np.testing.assert_allclose(value, expected, rtol=1e-12)
        np.testing.assert_allclose(curve.value(angle), expected, rtol=1e-12)
        np.testing.assert_allclose(on_grid, expected, rtol=1e-12)
        np.testing.assert_array_equal(slope, curve.slope(angle))
        numeric = (curve.value(angle + 1e-3) - curve.value(angle - 1e-3)) / 2e-3
        np.testing.assert_allclose(slope, numeric, rtol=1e-6, atol=1e-10)
        weights = powers(angle, RANDOM_POWERS) - powers(12.0, RANDOM_POWERS)
        spread = np.kron(weights, np.eye(CHANNELS))
        np.testing.assert_allclose(
            curve.uncertainty(angle, 12.0), spread @ curve.covariance @ spread.T, atol=1e-18
        )
    # Posterior of the information form, with bad channels, jointly and sequentially.
    angles = np.array([-15.0, 20.0, 45.0])
    change = curve.value(angles) + 2e-3 * rng.standard_normal((3, CHANNELS))
    change[1, 2] = change[2, :2] = np.nan
    noise = NOISE + 1e-8
    mean, covariance = posterior(curve, angles, change, noise)
    said = curve.condition(angles, change, noise)
    size = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose((said.effects.ravel() - mean) / size, 0.0, atol=1e-6)
    np.testing.assert_allclose(
        said.covariance / np.outer(size, size), covariance / np.outer(size, size), atol=1e-6
    )
    together = curve.condition(angles, change, np.kron(np.eye(3), noise))
    np.testing.assert_allclose(together.effects, said.effects, rtol=1e-9)
    turns = curve
    for i in range(3):
        turns = turns.condition(angles[i : i + 1], change[i : i + 1], noise)
    np.testing.assert_allclose((turns.effects - said.effects).ravel() / size, 0.0, atol=1e-6)


# Given known angles


def posterior(curve, angles, change, noise):
    """Mean and covariance of w by the information form, measurement by measurement."""
    precision = np.linalg.inv(curve.covariance)
    evidence = np.zeros(len(precision))
    for angle, row in zip(angles, change, strict=True):
        good = np.isfinite(row)
        H = np.kron(powers(angle, RANDOM_POWERS)[None], np.eye(CHANNELS))[good]
        weight = H.T @ np.linalg.inv(noise[np.ix_(good, good)])
        precision = precision + weight @ H
        evidence = evidence + weight @ (row - curve.value(angle))[good]
    covariance = np.linalg.inv(precision)
    return curve.effects.ravel() + covariance @ evidence, covariance


@pytest.mark.slow
def test_stated_error_is_that_of_many_frames(curve, rng):
    """Standardised errors over specimens and noise, with a bad channel in half of the frames."""
    for angle in (-15.0, 10.0, 40.0):
        # By Cholesky: signs of singular vectors, and with them the draw, depend on the processor.
        own = rng.multivariate_normal(np.zeros(SIZE), curve.covariance, 600, method="cholesky")
        change = curve.value(angle) + np.tensordot(
            own.reshape(-1, RANDOM_POWERS, CHANNELS), powers(angle, RANDOM_POWERS), axes=(1, 0)
        )
        change += 2e-4 * rng.standard_normal(change.shape)
        change[::2, 4] = np.nan
        seen = [COMBINATIONS.combine(frame, 1.0, 0.0) for frame in change]
        said = np.array([estimate_angle(curve, each.change, each.noise) for each in seen])
        z = (said[:, 0] - angle) / said[:, 1]
        assert np.sqrt(np.mean(z**2)) == pytest.approx(1.0, abs=0.06)
        whole = angle_standard_error(curve, angle, NOISE)
        assert whole == pytest.approx(np.median(said[1::2, 1]), rel=0.0015)


def test_a_bend_has_the_mean_density_over_the_angles_learned(curve):
    """Beyond which, and what does not settle it, faults of a flat sensor do not matter."""
    limits, angles = [], np.linspace(*RANGE, 7001)
    faults = SimpleNamespace(alone=lambda *given, **_: limits.append(given[2]))
    combined = COMBINATIONS.combine(curve.value(20.0) + 3e-4, 1.0, 0.0)
    SpecimenModel(np.zeros(0), None, curve, faults).angle(combined)
    logs = grid_log_densities(curve, angles, curve.value(angles), combined)
    assert limits == [pytest.approx(RIVAL - 2.0 * np.log(np.mean(np.exp(logs))), abs=0.05)]


# Learning from many specimens


def made_up(rng, count, frames, covariance, features=None):
    """Bent frames of specimens with random effects of this covariance."""
    own = rng.multivariate_normal(np.zeros(SIZE), covariance, count).reshape(
        -1, RANDOM_POWERS, CHANNELS
    )
    p = np.zeros((count, 0)) if features is None else rng.standard_normal((count, len(features)))
    specimen = np.repeat(np.arange(count), frames)
    angle = rng.uniform(*RANGE, len(specimen))
    mean = powers(angle, MEAN_POWERS) @ mean_curve()
    if features is not None:
        mean = mean + np.einsum("np,pkc,nk->nc", p[specimen], features, powers(angle, MEAN_POWERS))
    departure = np.einsum("nk,nkc->nc", powers(angle, RANDOM_POWERS), own[specimen])
    noise = rng.multivariate_normal(np.zeros(CHANNELS), NOISE, len(angle))
    order = rng.permutation(len(angle))  # specimens' frames need not follow each other
    change = mean + departure + noise
    return made_up_frames(change, angle, specimen, NOISE, features=p[specimen])[order]


@pytest.mark.slow
def test_mixed_models_find_covariance_and_moments_are_the_integral_over_angles(rng):
    """Random effects of 400 specimens from sixteen frames each."""
    true = own_covariance(rng)
    curves = BendCurvePrior.fit(made_up(rng, 400, 16, true))
    scatter = np.sqrt(2.0 / 400)
    at = {angle: curves.predict(()).uncertainty(angle) for angle in (-20.0, 25.0, 50.0)}
    truth = BendCurve(mean_curve(), np.zeros((RANDOM_POWERS, CHANNELS)), true, RANGE)
    for angle, said in at.items():
        expected = truth.uncertainty(angle)
        scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
        np.testing.assert_allclose(said / scale, expected / scale, atol=5 * scatter)
        np.testing.assert_allclose(
            curves.predict(()).value(angle), truth.value(angle), atol=4 * np.sqrt(scale.max() / 400)
        )
    curve, wide = flattening(5e-3), 0
    for _, combined in frames(curve, 8, np.random.default_rng(3)):

        def density(angle, power, combined=combined):
            spread = combined.noise + curve.uncertainty(angle)
            beyond = max(LOW - angle, angle - HIGH, 0.0)
            likelihood = stats.multivariate_normal(curve.value(angle), spread).pdf(combined.change)
            return likelihood * np.exp(-beyond) * angle**power

        total, first, second = (
            quad(density, LOW - 5.0, HIGH + 5.0, (k,), limit=200, points=(LOW, HIGH))[0]
            for k in range(3)
        )
        mean = first / total
        likeliest = estimate_angle(curve, combined.change, combined.noise)
        found = posterior_angle(curve, combined, AngleEstimate(*likeliest, 0.0))
        expected = np.sqrt(second / total - mean**2)
        if expected < NORMAL_DEG:
            continue
        wide += 1
        assert found.angle_deg == pytest.approx(mean, abs=0.1 * expected)
        assert found.deviation_deg == pytest.approx(expected, rel=0.1)
    assert wide > 2


def test_curves_are_conditioned_on_all_frames_and_less_certain_for_strange_specimens(rng):
    effect = 3e-3 * rng.standard_normal((2, MEAN_POWERS, CHANNELS))
    data = made_up(rng, 12, 5, own_covariance(rng), effect)
    curves = BendCurvePrior.fit(data)
    found = curves.expected_coefficients(data)
    for number in range(12):
        its = data[data.specimen == number]
        expected = curves.predict(its.features[0]).condition(its.angle_deg, its.change, NOISE)
        np.testing.assert_allclose(found[number], expected.coefficients, rtol=1e-6, atol=1e-9)
    prior = BendCurvePrior(
        np.concatenate([mean_curve()[None], np.zeros((2, MEAN_POWERS, CHANNELS))]),
        own_covariance(rng),
        RANGE,
        np.array([1.0, 0.04]),
    )
    usual = prior.predict(np.zeros(2)).covariance
    for features, rate, factor in (
        ((0.5, 0.1), 1.0, 1.0),
        ((2.0, 0.4), 1.0, 4.0),
        ((2.0, 0.4), 0.5, 2.0),
        ((0.0, 1.0), 0.2, 2.5),
    ):
        wide = prior.predict_widened(np.array(features), rate)
        np.testing.assert_allclose(wide.covariance, factor * usual)


# The posterior by a curve that is little known and flattens

LOW, HIGH = RANGE


def flattening(unknown=2e-3):
    """Curve that rises to a few percent and hardly any further from 35 deg on."""
    shape = np.linspace(0.02, 0.05, CHANNELS) * np.where(np.arange(CHANNELS) % 3, 1.0, -0.7)
    mean = np.zeros((MEAN_POWERS, CHANNELS))
    mean[:3] = np.outer([1.0, -0.25, -0.3], shape)
    covariance = unknown**2 * np.eye(RANDOM_POWERS * CHANNELS)
    return BendCurve(mean, np.zeros((RANDOM_POWERS, CHANNELS)), covariance, (LOW, HIGH))


def frames(curve, count, rng):
    """Angles, and frames of as many sensors whose curves are drawn."""
    angles = rng.uniform(LOW, HIGH, count)
    for angle in angles:
        spread = curve.uncertainty(angle) + NOISE
        change = curve.value(angle) + rng.multivariate_normal(np.zeros(CHANNELS), spread)
        yield angle, COMBINATIONS.combine(change, 1.0, 0.0)
