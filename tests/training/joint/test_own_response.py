"""What known touches and the twin of a sensor teach of its response."""

import json
from dataclasses import replace

import numpy as np
import pytest
from known_frames import known_frames
from smooth_joint import smooth_method

from eitskin.training.joint.adaptation import own_output, own_response
from eitskin.training.joint.method import JointMethod

from smooth_sensor import FLAT, LAYOUT, MEASUREMENTS, NOISE, TOUCH_PRIOR, response

pytestmark = pytest.mark.slow

RADIUS = 0.0075


class Twin:
    """Twin of a sensor whose channels answer by other gains, and more where they answer much."""

    def __init__(self, learned, size):
        self.learned, self.pressed = learned, []
        self.gains = 1.0 + size * np.random.default_rng(3).standard_normal(28)

    def inside(self, places):
        return places[:, 0] < 0.120

    def changes(self, touches, angle_deg, radius):
        assert radius == RADIUS
        self.pressed.append((angle_deg, touches))
        change = self.learned(touches, angle_deg)
        return self.gains * change * (1.0 + 0.2 * np.tanh(200.0 * np.abs(change)))


@pytest.fixture(scope="module")
def method():
    return smooth_method()


@pytest.fixture(scope="module")
def learned(method):
    return method.response.for_specimen(method.features.apply(FLAT))


def touches(count, rng):
    return rng.uniform([0.02, 0.015, 4.0], [0.11, 0.045, 12.0], (count, 3))


def pressed(twin, count, seed, *, forces=True):
    rng = np.random.default_rng(seed)
    known = touches(count, rng)
    change = twin.changes(known, 0.0, RADIUS) + NOISE * rng.standard_normal((count, 28))
    if not forces:
        known[:, 2] = np.nan
    return known_frames(FLAT, 4, change, np.zeros(count), touches=known[:, None])


def mean_error(method, known):
    found = method.predict(known.observations).touches
    places = known.touches[:, 0, :2]
    return np.mean([np.linalg.norm(f.place[0] - p) for f, p in zip(found, places, strict=True)])


def rms(values):
    return np.sqrt(np.mean(np.square(values)))


@pytest.mark.parametrize("angle_deg", [0.0, 30.0])
def test_the_last_layer_follows_the_twin_at_presses_and_bends_that_it_was_not_fitted_to(
    learned, angle_deg
):
    twin = Twin(learned, 0.15)
    output = own_output(learned, TOUCH_PRIOR, RADIUS, MEASUREMENTS, twin, bends=True)
    seen = touches(60, np.random.default_rng(5))
    exact = twin.changes(seen, angle_deg, RADIUS)
    left = [each(seen, angle_deg) - exact for each in (own_response(learned, output), learned)]
    assert rms(left[0]) < 0.15 * rms(left[1])


def test_the_twin_of_the_sensor_makes_places_better_by_the_flat_frame_alone(method, learned):
    twin = Twin(learned, 0.15)
    held_out = pressed(twin, 12, 1)
    flat = known_frames(FLAT, 4, np.zeros((1, 28)), [0.0])
    one, told = method.adapt(replace(flat, twin=twin))
    assert (told.twin.touches, told.twin.accepts_twin) == (0, True)
    json.dumps(told.as_dict(), allow_nan=False)
    assert mean_error(one, held_out) < 0.6 * mean_error(method, held_out)
    again = JointMethod.from_arrays(one.arrays(), LAYOUT)
    places = [each.predict(held_out.observations).touches[0].place for each in (one, again)]
    np.testing.assert_allclose(*places, atol=1e-6)
    assert one.adapt(flat)[0].own_output is None


@pytest.mark.parametrize("forces", [True, False])
def test_known_touches_keep_the_twin_of_the_sensor_and_refuse_that_of_another(
    method, learned, forces
):
    twin, other = Twin(learned, 0.15), Twin(learned, 0.3)
    other.gains = 2.0 - twin.gains
    known = pressed(twin, 6, 0, forces=forces)
    one, told = method.adapt(replace(known, twin=twin))
    assert told.twin.accepts_twin
    assert told.twin.with_twin < 0.5 * told.twin.without
    assert one.own_output is not None
    refused, told = method.adapt(replace(known, twin=other))
    assert not told.twin.accepts_twin
    np.testing.assert_array_equal(refused.own_output, method.adapt(known)[0].own_output)


# The response conditioned on known touches


LATENT = 4
SPREAD = 3.0  # of the sensors here, in those of `smooth_sensor`, which hardly differ


@pytest.fixture(scope="module")
def smooth():
    learned = response(mismatch=0.01, features=1, unseen=LATENT)
    wide = replace(learned, latent_output=SPREAD * learned.latent_output)
    return replace(smooth_method(), response=wide)


def sensor(smooth, latent, strength=1.0):
    """Response of a sensor with these latent variables (Q,)."""
    middle = smooth.response.for_specimen(smooth.features.apply(FLAT))
    more = np.tensordot(latent, smooth.response.latent_output, axes=1)
    return replace(middle, output=strength * (middle.output + more))


def pressed_known(one, count, rng, *, touches=1, forces=True):
    """Frames of a sensor with known touches."""
    low, high = TOUCH_PRIOR.low, TOUCH_PRIOR.high
    margin = np.array([0.01, 0.01, 1.0])
    known = rng.uniform(low + margin, high - margin, (count, touches, 3))
    change = np.array([one(each, 0.0).sum(axis=0) for each in known])
    change += NOISE * rng.standard_normal(change.shape)
    if not forces:
        known[..., 2] = np.nan
    return known_frames(FLAT, 4, change, np.zeros(count), touches=known)


def test_touches_are_estimated_by_the_likelier_of_two_responses(method):
    """Layers and gains differ on plates; on a base nothing changes, and known touches decide."""
    gains = 1.0 + 0.3 * np.random.default_rng(8).standard_normal((28, 1))
    first, *weights = method.response.weights
    there = replace(
        method.response, weights=(1.2 * first, *weights), output=gains * method.response.output
    )
    both, rng = replace(method, other_response=there), np.random.default_rng(1)
    base, plates = both.responses(FLAT)
    known = pressed_known(plates, 12, rng)
    assert mean_error(both, known) < 0.5 * mean_error(method, known)
    again = JointMethod.from_arrays(both.arrays(), LAYOUT)
    assert mean_error(again, known) == pytest.approx(mean_error(both, known), rel=1e-3)
    adapted = both.adapt(known[:4])[0]
    assert len(adapted.responses(FLAT)) == 1
    assert left(adapted, plates, rng) < 0.1 * left(method, plates, rng)
    restored = JointMethod.from_arrays(adapted.arrays(), LAYOUT)
    assert left(restored, plates, rng) < 0.1 * left(method, plates, rng)
    known = pressed_known(base, 12, rng)
    assert mean_error(both, known) == mean_error(method, known)
    for before in (both, adapted):  # an adaptation before has no effect
        assert left(before.adapt(known[:4])[0], base, rng) < 0.1


def left(smooth, one, rng):
    """Rms error of the response of an adapted smooth in other touches, relative to these."""
    touches = rng.uniform(TOUCH_PRIOR.low, TOUCH_PRIOR.high, (200, 3))
    exact = one(touches, 0.0)
    error = smooth.responses(FLAT)[0](touches, 0.0) - exact
    return np.sqrt(np.mean(error**2) / np.mean(exact**2))


@pytest.mark.parametrize(("touches", "forces"), [(1, True), (1, False), (2, True), (2, False)])
def test_known_touches_bring_the_response_nearer_to_the_sensor(smooth, touches, forces):
    rng = np.random.default_rng(0)
    one = sensor(smooth, rng.standard_normal(LATENT))
    adapted = smooth.adapt(pressed_known(one, 15, rng, touches=touches, forces=forces))[0]
    assert left(adapted, one, rng) < 0.3 * left(smooth, one, rng)


def test_the_strength_of_the_sensor_is_told_by_known_forces(smooth):
    rng = np.random.default_rng(1)
    one = sensor(smooth, np.zeros(LATENT), 1.2)
    known = pressed_known(one, 20, rng)
    adapted = smooth.adapt(known)[0]
    said = [each.predict(known.observations).touches for each in (smooth, adapted)]
    gains = [
        np.median([f.force[0] / k[0, 2] for f, k in zip(found, known.touches, strict=True)])
        for found in said
    ]
    assert gains[0] > 1.1
    assert gains[1] == pytest.approx(1.0, abs=0.05)


def test_the_covariance_left_is_that_of_the_errors(smooth):
    """Errors of the latent variables of 20 sensors over their standard deviations."""
    rng = np.random.default_rng(3)
    flat = smooth.response.latent_output.reshape(LATENT, -1)
    ratios = []
    for _ in range(20):
        latent = rng.standard_normal(LATENT)
        adapted = smooth.adapt(pressed_known(sensor(smooth, latent), 4, rng))[0]
        middle = sensor(smooth, np.zeros(LATENT)).output
        strength, *found = np.linalg.lstsq(
            np.vstack([middle.reshape(1, -1), flat]).T, adapted.own_output.ravel(), rcond=None
        )[0]
        root = np.linalg.lstsq(flat.T, adapted.own_latent.reshape(LATENT, -1).T, rcond=None)[0]
        ratios.append(np.linalg.solve(root / strength, np.array(found) / strength - latent))
    assert 0.6 < np.sqrt(np.mean(np.square(ratios))) < 1.2
