"""Usual bend curves: the group of specimens that bend alike, and what a frame says of it."""

from dataclasses import replace

import numpy as np
import pytest
from made_up_frames import made_up_frames

from eitskin.simulator import Protocol
from eitskin.training.joint import training
from eitskin.training.joint.bend_curve import RANDOM_POWERS, BendCurvePrior
from eitskin.training.joint.channel_faults import possible_faults
from eitskin.training.joint.clamp_curves import usual_curves
from eitskin.training.joint.combinations import Combinations, SpecimenFeatures
from eitskin.training.joint.mirrored_frames import SCALE
from eitskin.training.joint.specimen_model import SpecimenModel
from eitskin.training.joint.training import TrainingRun, fit_bends
from eitskin.training.method.interface import LearningCurve
from eitskin.training.method.settings import JointSettings, silent

from on_demand import OnDemand

stats = OnDemand("scipy.stats")

CHANNELS, NOISE = 6, 2e-4
COMBINATIONS = Combinations(np.full(CHANNELS, NOISE))
WAYS = np.random.default_rng(0).standard_normal((3, CHANNELS)) * 0.03
ANGLES = np.array([-15.0, 5.0, 15.0, 25.0, 35.0, 45.0])


def frames(alike, various, seed=1, spread=0.03):
    """Bent frames of `alike` specimens of one clamp, then of `various` in clamps of their own."""
    rng = np.random.default_rng(seed)
    count = alike + various
    usual = np.arange(count) < alike
    factor = np.where(usual, 1.0, np.exp(0.4 * rng.standard_normal(count)))
    turned = np.where(usual, 0.0, rng.standard_normal(count))
    own = spread * rng.standard_normal((count, CHANNELS)) * 0.03
    number = np.repeat(np.arange(count), len(ANGLES))
    u = np.tile(ANGLES, count)[:, None] / SCALE
    change = u * (factor[:, None] * WAYS[0] + turned[:, None] * WAYS[1] + own)[number]
    change += u**2 * WAYS[2] + NOISE * rng.standard_normal((len(number), CHANNELS))
    return made_up_frames(change, np.tile(ANGLES, count), number, NOISE)


@pytest.fixture(scope="module")
def mixture():
    return frames(160, 140)


@pytest.fixture(scope="module")
def everywhere(mixture):
    return BendCurvePrior.fit(mixture)


@pytest.fixture(scope="module")
def usual(mixture, everywhere):
    return usual_curves(mixture, everywhere)


# Likelihoods


@pytest.mark.slow
def test_likelihood_of_a_specimen_is_that_of_a_normal_vector():
    """Beside the whole covariance of its frames, written out."""
    mixture = frames(12, 8)
    everywhere = BendCurvePrior.fit(mixture)
    told = everywhere.log_likelihood(mixture)
    powers = (ANGLES[:, None] / SCALE) ** np.arange(1, RANDOM_POWERS + 1)
    weights = np.kron(powers, np.eye(CHANNELS))
    whole = weights @ everywhere.covariance @ weights.T + NOISE**2 * np.eye(len(weights))
    curve = everywhere.predict(())
    for number in (0, 15):
        change = mixture.change[mixture.specimen == number]
        normal = stats.multivariate_normal(curve.value(ANGLES).ravel(), whole)
        assert told[number] == pytest.approx(normal.logpdf(change.ravel()), rel=1e-6)
        by_curve = curve.log_likelihood(ANGLES, change, mixture.noise)
        assert by_curve == pytest.approx(told[number], rel=1e-6)


# The group


@pytest.mark.slow
def test_the_group_that_bends_alike_is_found(mixture, usual):
    alike = mixture[mixture.specimen < 160]
    by_hand = BendCurvePrior.fit(alike)
    size = np.trace(by_hand.covariance)
    assert np.trace(usual.covariance) == pytest.approx(size, rel=0.013)
    np.testing.assert_allclose(
        usual.predict(()).value(30.0),
        by_hand.predict(()).value(30.0),
        atol=2.5e-4 * np.abs(WAYS).max(),
    )


@pytest.mark.slow
@pytest.mark.parametrize(("alike", "various"), [(60, 240), (300, 0), (0, 300), (110, 60)])
def test_no_group_is_found_where_none_is(alike, various):
    """Too few alike, all of one clamp, none alike, or too few specimens altogether."""
    data = frames(alike, various)
    assert usual_curves(data, BendCurvePrior.fit(data)) is None


# Two hypotheses of one frame


@pytest.mark.slow
@pytest.mark.parametrize("alike", [True, False])
def test_a_bent_frame_tells_whether_its_sensor_bends_as_usual(everywhere, usual, alike):
    unseen = frames(1, 0, seed=7) if alike else frames(0, 1, seed=8)
    none = possible_faults(Protocol.pairwise(4), np.ones(CHANNELS))
    known = (usual.predict(()),)
    both = SpecimenModel(np.zeros(0), None, everywhere.predict(()), none, usual=known)
    alone, only = (
        SpecimenModel(np.zeros(0), None, prior.predict(()), none) for prior in (everywhere, usual)
    )
    for change, angle in list(zip(unseen.change, ANGLES, strict=True))[3:]:
        combined = COMBINATIONS.combine(change, 1.0, 0.0)
        found, before = both.angle(combined), alone.angle(combined)
        assert found.usual == pytest.approx(float(alike), abs=0.2 if alike else 0.01)
        if alike:
            assert abs(found.angle_deg - angle) < 2.6 * found.deviation_deg
            assert found.deviation_deg < 0.98 * before.deviation_deg
            mean = np.average(
                [only.angle(combined).angle_deg, before.angle_deg],
                weights=[found.usual, 1.0 - found.usual],
            )
            assert found.angle_deg == pytest.approx(mean, abs=1e-6)
        else:
            assert found.angle_deg == pytest.approx(before.angle_deg, abs=1e-6)
            assert found.deviation_deg == pytest.approx(before.deviation_deg, rel=1e-6)


@pytest.mark.slow
def test_sensors_on_plates_have_usual_curves_of_their_own(monkeypatch, mixture, everywhere):
    """Where there are enough; a bent frame shows which of the usual curves its sensor has."""
    monkeypatch.setattr(training, "_fit_networks", lambda *_: (None, LearningCurve()))
    none = SpecimenFeatures(np.zeros(CHANNELS), np.zeros((0, CHANNELS)))
    run = TrainingRun(none, COMBINATIONS, JointSettings(drift=1e-6), 0, silent)

    def carried(count, seed=5):
        held = frames(count, 0, seed)
        return replace(held, change=0.8 * held.change)

    learned, _ = fit_bends(run, mixture, [mixture, carried(110)])
    curves = [learned[name].predict(()) for name in ("usual", "other_usual")]
    held, on_plates = (curve.value(30.0) for curve in curves)
    assert on_plates @ held / (held @ held) == pytest.approx(0.8, rel=0.02)
    for few in (carried(60), mixture[:0]):
        assert fit_bends(run, mixture, [mixture, few])[0]["other_usual"] is None
    alone, _ = fit_bends(run, carried(110), [mixture[:0], carried(110)])
    assert (alone["usual"], alone["other_usual"] is None) == (None, False)
    faults = possible_faults(Protocol.pairwise(4), np.ones(CHANNELS))
    model = SpecimenModel(np.zeros(0), None, everywhere.predict(()), faults, usual=tuple(curves))
    for number, unseen in enumerate((frames(1, 0, seed=7), carried(1, seed=7))):
        for change, angle in list(zip(unseen.change, ANGLES, strict=True))[3:]:
            bend = model.angle(COMBINATIONS.combine(change, 1.0, 0.0))
            assert (bend.usual > 0.5, bend.usual_curve) == (True, number)
            assert abs(bend.angle_deg - angle) < 3.0 * bend.deviation_deg


@pytest.mark.slow
def test_the_likeliest_usual_curve_is_as_wide_as_what_it_shows(usual):
    narrow = usual.predict(())
    curves = narrow, replace(narrow, covariance=100.0 * narrow.covariance)
    none = possible_faults(Protocol.pairwise(4), np.ones(CHANNELS))
    model = SpecimenModel(np.zeros(0), None, curves[0], none, usual=curves)
    noise, rng = NOISE**2 * np.eye(CHANNELS), np.random.default_rng(5)
    for drawn in curves:
        spread = np.linalg.cholesky(drawn.uncertainty(30.0) + noise)
        change = drawn.value(30.0) + spread @ rng.standard_normal(CHANNELS)
        assert model.likeliest_usual(change, noise) is drawn
