"""Combinations of measurements, to which nothing is lost, and features of specimens."""

from dataclasses import replace

import numpy as np
import pytest
from made_up_frames import made_up_frames

from eitskin.geometry import SensorDesign
from eitskin.simulator import Protocol
from eitskin.training.joint.bend_curve import RANDOM_POWERS, BendCurve
from eitskin.training.joint.channel_faults import possible_faults
from eitskin.training.joint.combinations import (
    ANGLE_FEATURES,
    CLIP_SIGMA,
    Combinations,
    SpecimenFeatures,
)
from eitskin.training.joint.model_selection import fit_plain
from eitskin.training.joint.objective import TouchObjective
from eitskin.training.joint.touch_search import TouchCandidates
from eitskin.training.method.input_spec import mirrors

from smooth_sensor import RANGES, TOUCH_PRIOR, curve, places, response

PROTOCOL = Protocol.adjacent(10, shared=True)
COUNT = len(PROTOCOL)  # 100 measurements of a sensor with 28 independent changes
RNG = np.random.default_rng(3)
MIX = np.eye(28)[np.arange(COUNT) % 28] + 0.2 * RNG.standard_normal((COUNT, 28))
NOISES = RNG.uniform(1e-4, 4e-4, COUNT)
FLAT = RNG.uniform(100.0, 800.0, COUNT)
RESPONSE, CURVE = response(unseen=2), curve()
LATE = MIX @ CURVE.slope(15.0) * (np.arange(COUNT) / COUNT - 0.5)  # measured one after the other
SIGNALS = np.column_stack([MIX, np.ones(COUNT), LATE])  # touches, bends, drift, motion
ALL = Combinations(NOISES)
FEW = Combinations(NOISES, np.linalg.qr(SIGNALS / NOISES[:, None])[0])
TOUCHES = np.array([[0.030, 0.040, 6.0], [0.110, 0.020, 10.0]])


def model(combinations, mismatch=0.0):
    """Response of the specimen and bend curve of the mixed measurements, in combinations."""
    mix = (MIX.T @ combinations.forward).T
    output, latent = (
        np.einsum("kc,pch->pkh", mix, each) for each in (RESPONSE.output, RESPONSE.latent_output)
    )
    mixed = replace(RESPONSE, output=output, latent_output=latent, mismatch=mismatch).for_specimen(
        ()
    )
    powers = np.kron(np.eye(RANDOM_POWERS), mix)
    covariance = powers @ CURVE.covariance @ powers.T
    effects = np.zeros((RANDOM_POWERS, len(mix)))
    return mixed, BendCurve(CURVE.mean @ mix.T, effects, covariance, CURVE.angle_deg)


def measured(touches=TOUCHES, angle_deg=20.0):
    """Change of log V (C,) in a frame of a sensor that has moved by 5 deg."""
    change = CURVE.value(angle_deg) - CURVE.value(angle_deg - 5.0)
    if len(touches):
        change = change + RESPONSE.for_specimen(())(touches, angle_deg).sum(axis=0)
    return MIX @ change + 1.4 * NOISES * np.random.default_rng(1).standard_normal(COUNT)


def fitted(combinations, change, mismatch=0.0):
    """Fit of one frame with the possible faults of its measurements."""
    specimen, bend = model(combinations, mismatch)
    touches = np.column_stack([places(), np.full(len(places()), RANGES.middle_force)])
    candidates = TouchCandidates(places(), RANGES.middle_force, specimen(touches, 15.0))
    objective = TouchObjective(
        combinations.combine(change, 2.0, 1e-8), 15.0, specimen, bend, TOUCH_PRIOR
    )
    faults = possible_faults(PROTOCOL, FLAT)
    plain = fit_plain(objective, candidates, lambda: TOUCHES[:, :2] + 0.003)
    return plain.without_faults(faults).complete()


def assert_same(one, other):
    np.testing.assert_allclose(one.touches, other.touches, rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(one.covariance, other.covariance, rtol=1e-3, atol=1e-12)
    assert one.angle_deg == pytest.approx(other.angle_deg, abs=1e-3)
    assert one.misfit == pytest.approx(other.misfit, rel=1e-4)
    assert one.degrees_of_freedom == other.degrees_of_freedom
    assert [each.name for each in one.faults] == [each.name for each in other.faults]


def test_combinations_fit_as_all_measurements_leave_out_and_tell_signals_from_noise():
    """Reciprocal measurements: half of them carry nothing of their own."""
    assert len(FEW) == 30
    assert_same(fitted(FEW, measured()), fitted(ALL, measured()))
    change = measured()
    change[[2, 30, 31, 77]] = np.nan
    few = fitted(FEW, change)
    assert_same(few, fitted(ALL, change))
    assert few.degrees_of_freedom == COUNT - 4 - 7
    change[[2, 30, 31, 77]] = 5.0  # values that are left out do not matter
    combined = FEW.combine(change, 2.0, 0.0).drop([2, 30, 31, 77])
    change[[2, 30, 31, 77]] = np.nan
    np.testing.assert_allclose(combined.change, FEW.combine(change, 2.0, 0.0).change, atol=1e-12)
    rng = np.random.default_rng(5)
    none = SpecimenFeatures(np.zeros(COUNT), np.zeros((0, COUNT)))
    frames = made_up_frames(change[None], np.zeros(1), np.zeros(1, int), np.diag(NOISES**2))
    expected = FEW.forward.T @ (frames.noise + 1e-6) @ FEW.forward  # and a drift that all share
    np.testing.assert_allclose(frames.combine(none, FEW, 1e-6).noise, expected, atol=1e-9)
    shapes = MIX[:, :9]
    change = 1e-2 * rng.standard_normal((600, 9)) @ shapes.T
    change += NOISES * rng.standard_normal(change.shape)
    found = Combinations.fit([(change, 1.0)], NOISES)
    assert len(found) == 10  # and the drift
    for signal in (shapes, np.ones((COUNT, 1))):
        left = signal - (signal.T @ found.forward @ found.back).T
        assert np.abs(left / NOISES[:, None]).max() < 0.02 * np.abs(signal / NOISES[:, None]).max()


IMAGES = mirrors(SensorDesign.reference(), Protocol.pairwise(8))
MIDDLE = np.linspace(300.0, 900.0, 28)


def specimens(count, rng, directions=28, spread=0.02):
    """Flat magnitudes (count, 28) [ohm] that differ along some directions and by a factor."""
    ways = rng.standard_normal((directions, 28)) * spread
    common = rng.uniform(0.5, 2.0, (count, 1))
    return MIDDLE * common * np.exp(rng.standard_normal((count, directions)) @ ways)


@pytest.fixture
def rng():
    return np.random.default_rng(3)


def test_features_are_uncorrelated_of_variance_one_and_bounded_at_the_bound(rng):
    """Unit variance over the specimens and their mirror images."""
    flat = specimens(120, rng)
    features = SpecimenFeatures.fit(flat, IMAGES)
    said = np.concatenate([features.apply(flat[:, mirror.order]) for mirror in IMAGES])
    assert said.shape == (480, ANGLE_FEATURES)
    np.testing.assert_allclose(said.mean(axis=0), 0.0, atol=1e-9)
    np.testing.assert_allclose(said.T @ said / 480, np.eye(ANGLE_FEATURES), atol=1e-9)
    features = SpecimenFeatures.fit(specimens(50, rng), IMAGES)
    near = specimens(1, rng)[0]
    np.testing.assert_array_equal(features.clip(near), features.apply(near))
    far = np.exp(features.middle + 12.0 * np.linalg.pinv(features.directions)[:, 0])
    assert features.apply(far)[0] == pytest.approx(12.0)
    assert features.clip(far)[0] == CLIP_SIGMA


@pytest.mark.parametrize(("count", "kept"), [(2, 0), (4, 0), (5, 1), (14, 2), (40, 8), (300, 20)])
def test_few_specimens_have_few_features(rng, count, kept):
    features = SpecimenFeatures.fit(specimens(count, rng), IMAGES)
    assert features.directions.shape == (kept, 28)
    assert features.apply(specimens(3, rng)).shape == (3, kept)
