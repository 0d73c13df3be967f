"""Mean bend curves of clamps: those of a training set, and of others between them."""

import dataclasses

import numpy as np
import pytest
from made_up_frames import made_up_frames
from scipy.spatial.distance import cdist

from eitskin.training.joint import clamp_curves
from eitskin.training.joint.bend_curve import BendCurvePrior
from eitskin.training.joint.clamp_curves import ClampCurves
from eitskin.training.joint.mirrored_frames import SCALE

CHANNELS = 3
NOISE = 1e-5
ANGLES = np.array([-18.0, -9.0, 8.0, 17.0, 26.0, 34.0, 43.0, 50.0])
WAYS = np.random.default_rng(0).standard_normal((5, CHANNELS)) * 0.02


def curve(clamps):
    """Coefficients of the angle and its square (n, 2, K): smooth, but not linear, in the clamp."""
    span, offset, faces, stiffness, *plates = np.asarray(clamps).T
    first = np.column_stack([0.04 / span, offset / 0.01, 1.0 + 0.1 * faces + 0.5 * sum(plates)])
    second = np.column_stack([np.log(stiffness), np.ones_like(span)])
    return np.stack([first @ WAYS[:3], second @ WAYS[3:]], axis=1)


def clamps_of(count, seed=1):
    rng = np.random.default_rng(seed)
    low, high = (0.025, 0.004, np.log(0.7)), (0.060, 0.014, np.log(2.8))
    span, offset, stiffness = rng.uniform(low, high, (count, 3)).T
    return np.column_stack([span, offset, 1.0 + np.arange(count) % 2, np.exp(stiffness)])


def bent(clamps, each=3, seed=2, feature=0.3):
    """Bent frames of `each` specimens in every clamp, with one feature that scales the curve."""
    rng = np.random.default_rng(seed)
    made = np.repeat(clamps, each, axis=0)
    features = rng.standard_normal((len(made), 1))
    number = np.repeat(np.arange(len(made)), len(ANGLES))
    u = np.tile(ANGLES, len(made))[:, None] / SCALE
    shape = curve(np.where(np.isfinite(made), made, 1.0))[number]
    change = u * shape[:, 0] + u**2 * shape[:, 1] + feature * u * features[number] * WAYS[4]
    change += NOISE * rng.standard_normal(change.shape)
    more = {"features": features[number], "clamp": made[number]}
    return made_up_frames(change, np.tile(ANGLES, len(made)), number, NOISE, **more)


def at_40(coefficients):
    powers = (40.0 / SCALE) ** np.arange(1, coefficients.shape[1] + 1)
    return np.einsum("p,npk->nk", powers, coefficients)


def expected(clamps):
    return at_40(curve(clamps))


def rms(values):
    return np.sqrt(np.mean(np.square(values)))


@pytest.mark.slow
def test_curves_of_clamps_are_those_of_their_specimens_and_unknown_ones_left_alone():
    made = clamps_of(40)
    frames = bent(made)
    unknown = frames.specimen % 3 == 0
    frames = dataclasses.replace(frames, clamp=np.where(unknown[:, None], np.nan, frames.clamp))
    prior = BendCurvePrior.fit(frames)
    found = ClampCurves.fit(frames, prior, prior.expected_coefficients(frames), 0)
    assert np.array_equal(found.known, np.arange(120) % 3 != 0)
    assert not found.own[~found.known].any()
    scatter = rms(expected(made) - expected(made).mean(axis=0))
    assert rms(at_40(found.own)[1::3] - expected(made)) < 0.05 * scatter


@pytest.mark.slow
def test_plates_that_carry_a_sensor_add_to_the_curve_of_any_clamp(monkeypatch):
    """They were seen with one clamp alone, and are drawn with others."""
    held = np.column_stack([clamps_of(60), np.zeros(60)])
    on_plates = held[:1] + np.eye(5)[4]
    seen = np.concatenate([held, np.repeat(on_plates, 20, axis=0)])
    drawn = []
    sample = clamp_curves._sample_smoothly

    def remember(*args):
        drawn.append(sample(*args))
        return drawn[0]

    monkeypatch.setattr(clamp_curves, "_sample_smoothly", remember)
    frames = bent(seen)
    prior = BendCurvePrior.fit(frames)
    found = ClampCurves.fit(frames, prior, prior.expected_coefficients(frames), 0)
    low, high = (np.append(end[:3], np.log(end[3])) for end in (held.min(axis=0), held.max(axis=0)))
    there = 0.5 * (drawn[0] + 1.0) * np.append(high - low, 1.0) + np.append(low, 0.0)
    exact = expected(np.column_stack([there[:, :3], np.exp(there[:, 3]), there[:, 4]]))
    plates = there[:, 4] > 0.5
    assert 0.2 < plates.mean() < 0.3
    scatter = rms(exact - exact.mean(axis=0))
    for kind in (plates, ~plates):
        assert rms(at_40(found.drawn)[kind] - exact[kind]) < 0.15 * scatter


def thin_plate_spline(places, values, at):
    """The least bent function near the values, with its weights orthogonal to linear functions."""

    def kernel(one, other):
        distance = cdist(one, other)
        return distance**2 * np.log(np.where(distance > 0.0, distance, 1.0))

    linear, linear_at = (np.column_stack([np.ones(len(x)), x]) for x in (places, at))
    whole = np.block(
        [
            [kernel(places, places) + clamp_curves.SMOOTHING * np.eye(len(places)), linear],
            [linear.T, np.zeros((linear.shape[1], linear.shape[1]))],
        ]
    )
    weights = np.linalg.solve(whole, np.pad(values, ((0, linear.shape[1]), (0, 0))))
    return np.column_stack([kernel(at, places), linear_at]) @ weights


def test_curves_of_drawn_clamps_are_those_of_a_thin_plate_spline(monkeypatch):
    ends = np.array([[0.025, 0.004, 1.0, 0.7], [0.060, 0.014, 2.0, 2.8]])
    known, others = np.concatenate([ends, clamps_of(60)]), clamps_of(30, seed=9)
    low, high = (np.append(end[:3], np.log(end[3])) for end in ends)
    places, at = (
        2.0 * (np.column_stack([each[:, :3], np.log(each[:, 3])]) - low) / (high - low) - 1.0
        for each in (known, others)
    )
    monkeypatch.setattr(clamp_curves, "SAMPLE_COUNT", len(others))
    monkeypatch.setattr(clamp_curves, "_sample_smoothly", lambda *_: at)
    frames, exact = bent(known, each=1), curve(known)
    prior = BendCurvePrior.fit(frames)
    without = dataclasses.replace(prior, mean=np.zeros((2, *exact.shape[1:])))
    found = ClampCurves.fit(frames, without, exact, 0).drawn.reshape(len(others), -1)
    spline = thin_plate_spline(places, exact.reshape(len(known), -1), at)
    np.testing.assert_allclose(found, spline, atol=1e-9 * np.abs(spline).max())
