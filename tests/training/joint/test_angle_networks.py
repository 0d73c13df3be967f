"""Angle networks: their formulae, and what they learn of sensors whose clamps differ."""

import numpy as np
import pytest
from made_up_frames import made_up_frames

from eitskin.threads import one_torch_thread
from eitskin.training import NetworkSettings
from eitskin.training.joint.bend_curve import BendCurvePrior
from eitskin.training.joint.combinations import Combinations, SpecimenFeatures
from eitskin.training.joint.networks import (
    AngleNetworks,
    without_drift,
)
from eitskin.training.joint.specimen_model import (
    BLEND_END_DEG,
    BLEND_START_DEG,
    blend_angles,
    estimate_angle,
)
from eitskin.training.joint.training import TrainingRun, fit_bends
from eitskin.training.method.settings import JointSettings, silent

from on_demand import OnDemand

TRAINING = "eitskin.training.joint.angle_training"
angle_training = OnDemand(TRAINING)

CHANNELS, NOISE = 6, 1e-4
SETTINGS = NetworkSettings(1e-2, epochs=30, batch=128)


def bent(specimens, seed, tightness=0.35):
    """Bent frames of sensors in clamps of random tightness; that at zero is the same for all.

    The change is a nonlinear function of the angle times a factor, with a part of its own shape
    that tells the factor.
    """
    rng = np.random.default_rng(seed)
    number = np.repeat(np.arange(specimens), 6)
    factor = np.exp(tightness * rng.standard_normal(specimens))[number]
    angle = rng.uniform(-20.0, 50.0, len(number))
    return changes(factor, angle, rng), angle, number


def changes(factor, angle, rng):
    u = factor * angle / 50.0
    ways = np.random.default_rng(0).standard_normal((3, CHANNELS)) * 0.02
    ways -= ways.mean(axis=1, keepdims=True)  # drift, which is common, tells nothing
    change = np.tanh(u)[:, None] * ways[0] + (u**2)[:, None] * ways[1]
    change += (np.log(factor) * u)[:, None] * ways[2]
    change += NOISE * rng.standard_normal(change.shape)
    return change


def frames(specimens=150, seed=1, tightness=0.35):
    change, angle, number = bent(specimens, seed, tightness)
    return made_up_frames(change, angle, number, NOISE)


def fitted(data, progress=silent, mixed=None):
    with one_torch_thread(), pytest.MonkeyPatch.context() as patch:
        patch.setattr(f"{TRAINING}.MEMBERS", 3)
        patch.setattr(f"{TRAINING}.HIDDEN_SIZES", (32, 32))
        patch.setattr(f"{TRAINING}.DRIFT", (1e-4, 1e-3))  # of minutes: fewer steps suffice
        if mixed is not None:
            patch.setattr(f"{TRAINING}.MIX_RANGE", mixed)
        return angle_training.fit_angles(
            data, data.features, BendCurvePrior.fit(data), SETTINGS, 0, progress
        )


@pytest.fixture(scope="module")
def trained():
    said = []
    found = fitted(frames(), lambda *told: said.append(told))
    return *found, said


def random_networks(members=3, inputs=5):
    rng = np.random.default_rng(3)
    sizes = [(5, inputs), (2, 5)]
    return AngleNetworks(
        tuple(0.3 * rng.standard_normal((members, *size)) for size in sizes),
        tuple(0.3 * rng.standard_normal((members, size[0])) for size in sizes),
        np.array([0.1, 0.2]),
        np.array([1.0, 0.5]),
        np.array([3.0, -1.0]),
        (-20.0, 50.0),
    )


# The formulae


def test_networks_are_dense_ones_with_a_jackknife_and_take_a_common_change_out():
    """The linear estimate of least mean square, beside regression on draws of the same model."""
    networks = random_networks()
    change, features = np.array([0.05, -0.1]), np.array([0.7, 9.0])
    common = 1e-6 * (3.0 * 0.5 + 1.0 * 0.5) / (1.0 + 1e-6 * (3.0 - 0.5))
    x = np.array([0.5 - common, -0.5 - 0.5 * common, 0.7, 4.0, np.log(10.0)])
    means, deviations = np.zeros(3), np.zeros(3)
    for k in range(3):
        before = networks.weights[0][k] @ x + networks.biases[0][k]
        last = networks.weights[1][k] @ (before / (1 + np.exp(-before))) + networks.biases[1][k]
        means[k], deviations[k] = 20 * last[0], 20 * np.exp(min(last[1], 0.0))
    angle, deviation = networks.estimate(change, features, 1e-3)
    assert angle == pytest.approx(means.mean())
    jackknife = 2 / 3 * np.sum((means - means.mean()) ** 2)
    assert deviation**2 == pytest.approx(np.mean(deviations**2) + jackknife)
    rng, networks = np.random.default_rng(2), random_networks()
    ways = np.array([[1.0, -0.4], [0.0, 0.2]])
    bend = rng.standard_normal((200_000, 2)) @ ways
    common = 0.3 * rng.standard_normal(len(bend))
    seen = bend + common[:, None] * networks.drift
    own = np.linalg.solve(ways.T @ ways, networks.drift)
    least = np.linalg.lstsq(seen, common, rcond=None)[0]
    expected = seen[:5] - (seen[:5] @ least)[:, None] * networks.drift
    found = without_drift(seen[:5], np.full(5, 0.3**2), networks.drift, own)
    np.testing.assert_allclose(found, expected, atol=0.02)


@pytest.mark.parametrize(
    ("by_networks", "expected"), [(0.0, 1.0), (BLEND_START_DEG / 2, 2.0), (8.0, 8.0)]
)
def test_the_curve_counts_near_zero(by_networks, expected):
    curve = (1.0, 0.1) if by_networks != BLEND_START_DEG / 2 else (4.0 - by_networks, 0.1)
    angle, deviation = blend_angles(curve, (by_networks, 0.5))
    assert angle == pytest.approx(expected)
    share = min(by_networks / BLEND_START_DEG, 1.0)
    assert deviation == pytest.approx(0.1 + share * 0.4)
    assert blend_angles((2.0 * BLEND_END_DEG, 17.0), (0.3, 0.5)) == (0.3, 0.5)  # networks see none
    assert blend_angles((0.1 * BLEND_END_DEG, 17.0), (0.3, 0.5))[0] > 1.5


# Learned


@pytest.mark.slow
def test_networks_tell_angles_of_clamps_never_seen(trained):
    networks, curve, said = trained
    unseen = frames(60, seed=9)
    found = np.array([networks.estimate(each, np.zeros(0), 1e-4) for each in unseen.change])
    error = found[:, 0] - unseen.angle_deg
    noise, curve_of_all = NOISE**2 * np.eye(CHANNELS), BendCurvePrior.fit(frames()).predict(())
    by_curve = np.array([estimate_angle(curve_of_all, each, noise)[0] for each in unseen.change])
    rms = np.sqrt(np.mean(error**2))
    assert rms < 0.6 * np.sqrt(np.mean((by_curve - unseen.angle_deg) ** 2))
    assert np.sqrt(np.mean((error / found[:, 1]) ** 2)) < 1.4
    assert curve.validation[-1] < curve.validation[0]
    assert said[-1] == ("angles", 90, 90)


@pytest.mark.slow
def test_known_clamps_teach_those_between_them():
    """Few clamps of many sensors each: networks that are told which one bends learn the others."""
    ways = np.random.default_rng(7).standard_normal((2, CHANNELS)) * 0.02
    ways -= ways.mean(axis=1, keepdims=True)

    def of(clamps, seed, known):
        rng = np.random.default_rng(seed)
        number = np.repeat(np.arange(8 * len(clamps)), 6)
        made = np.repeat(clamps, 48, axis=0)
        angle = rng.uniform(-20.0, 50.0, len(number))
        change = changes(0.04 / made[:, 0], angle, rng)
        turned = np.column_stack([100.0 * (made[:, 1] - 0.008), np.log(made[:, 3])])
        change += (angle / 50.0)[:, None] * (turned @ ways)
        return made_up_frames(change, angle, number, NOISE, clamp=made if known else np.nan)

    def clamps(count, seed):
        span, offset, ratio = np.random.default_rng(seed).uniform(-1.0, 1.0, (3, count))
        return np.column_stack(
            [0.04 + 0.015 * span, 0.008 + 0.004 * offset, np.full(count, 2.0), np.exp(ratio)]
        )

    unseen, error = of(clamps(30, 8), 5, known=False)[::3], {}
    for known in (True, False):
        networks, _ = fitted(of(clamps(16, 1), 1, known))
        found = [networks.estimate(change, np.zeros(0), 1e-4)[0] for change in unseen.change]
        error[known] = np.sqrt(np.mean((found - unseen.angle_deg) ** 2))
    assert error[True] < 0.87 * error[False]


@pytest.mark.slow
@pytest.mark.parametrize(("tightness", "kept"), [(0.7, True), (0.0, False)])
def test_networks_are_kept_where_they_tell_more_than_the_curves(tightness, kept):
    data = frames(120, 1, tightness)
    settings = JointSettings(angles=SETTINGS, drift=1e-6)
    with one_torch_thread(), pytest.MonkeyPatch.context() as patch:
        patch.setattr(f"{TRAINING}.MEMBERS", 2)
        patch.setattr(f"{TRAINING}.HIDDEN_SIZES", (24, 24))
        patch.setattr(f"{TRAINING}.DRIFT", (1e-4, 1e-3))
        none = SpecimenFeatures(np.zeros(CHANNELS), np.zeros((0, CHANNELS)))
        run = TrainingRun(none, Combinations(np.full(CHANNELS, NOISE)), settings, 0, silent)
        learned, _ = fit_bends(run, data)
    assert (learned["angles"] is not None) == kept
