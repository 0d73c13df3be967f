"""Response of a sensor given known touches: nearer to the truth, as uncertain as it should be."""

from dataclasses import replace

import numpy as np
import pytest
from known_frames import known_frames
from smooth_joint import smooth_method

from smooth_sensor import FLAT, NOISE, TOUCH_PRIOR, response

LATENT = 4
SPREAD = 3.0  # of the sensors here, in those of `smooth_sensor`, which hardly differ


@pytest.fixture(scope="module")
def method():
    learned = response(mismatch=0.01, features=1, unseen=LATENT)
    wide = replace(learned, latent_output=SPREAD * learned.latent_output)
    return replace(smooth_method(), response=wide)


def sensor(method, latent, strength=1.0):
    """Response of a sensor with these latent variables (Q,)."""
    middle = method.response.for_specimen(method.features.apply(FLAT))
    more = np.tensordot(latent, method.response.latent_output, axes=1)
    return replace(middle, output=strength * (middle.output + more))


def pressed(one, count, rng, *, touches=1, forces=True):
    """Frames of a sensor with known touches."""
    low, high = TOUCH_PRIOR.low, TOUCH_PRIOR.high
    margin = np.array([0.01, 0.01, 1.0])
    known = rng.uniform(low + margin, high - margin, (count, touches, 3))
    change = np.array([one(each, 0.0).sum(axis=0) for each in known])
    change += NOISE * rng.standard_normal(change.shape)
    if not forces:
        known[..., 2] = np.nan
    return known_frames(FLAT, 4, change, np.zeros(count), touches=known)


def left(method, one, rng):
    """Rms error of the response of an adapted method in other touches, relative to these."""
    touches = rng.uniform(TOUCH_PRIOR.low, TOUCH_PRIOR.high, (200, 3))
    exact = one(touches, 0.0)
    error = method.specimen_response(FLAT)(touches, 0.0) - exact
    return np.sqrt(np.mean(error**2) / np.mean(exact**2))


@pytest.mark.parametrize(("touches", "forces"), [(1, True), (1, False), (2, True), (2, False)])
def test_known_touches_bring_the_response_nearer_to_the_sensor(method, touches, forces):
    rng = np.random.default_rng(0)
    one = sensor(method, rng.standard_normal(LATENT))
    adapted = method.adapt(pressed(one, 15, rng, touches=touches, forces=forces))[0]
    assert left(adapted, one, rng) < 0.3 * left(method, one, rng)


def test_the_strength_of_the_sensor_is_told_by_known_forces(method):
    rng = np.random.default_rng(1)
    one = sensor(method, np.zeros(LATENT), 1.2)
    known = pressed(one, 20, rng)
    adapted = method.adapt(known)[0]
    said = [each.predict(known.observations).touches for each in (method, adapted)]
    gains = [
        np.median([f.force[0] / k[0, 2] for f, k in zip(found, known.touches, strict=True)])
        for found in said
    ]
    assert gains[0] > 1.1
    assert gains[1] == pytest.approx(1.0, abs=0.05)


@pytest.mark.slow
def test_the_covariance_left_is_that_of_the_errors(method):
    """Errors of the latent variables of 20 sensors over their standard deviations."""
    rng = np.random.default_rng(3)
    flat = method.response.latent_output.reshape(LATENT, -1)
    ratios = []
    for _ in range(20):
        latent = rng.standard_normal(LATENT)
        adapted = method.adapt(pressed(sensor(method, latent), 4, rng))[0]
        middle = sensor(method, np.zeros(LATENT)).output
        strength, *found = np.linalg.lstsq(
            np.vstack([middle.reshape(1, -1), flat]).T, adapted.own_output.ravel(), rcond=None
        )[0]
        root = np.linalg.lstsq(flat.T, adapted.own_latent.reshape(LATENT, -1).T, rcond=None)[0]
        ratios.append(np.linalg.solve(root / strength, np.array(found) / strength - latent))
    assert 0.6 < np.sqrt(np.mean(np.square(ratios))) < 1.2
