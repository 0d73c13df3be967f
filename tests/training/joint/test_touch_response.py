"""Touch response: derivatives, superposition, copies, and training."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from made_up_frames import made_up_frames

from eitskin.training.joint.touch_response import TouchPrior
from eitskin.training.joint.touch_training import (
    ResponseNetwork,
    folded_response,
    packed_inputs,
)

from smooth_sensor import RANGES, SIZE, TOUCH_PRIOR, response, touch_change


@pytest.fixture(scope="module")
def learned():
    return response(features=2, unseen=2)


@pytest.fixture
def touches():
    return np.random.default_rng(1).uniform(TOUCH_PRIOR.low, TOUCH_PRIOR.high, (6, 3))


def plain(learned, p, touches, angle_deg):
    """The response by the formula of its docstring, touch by touch and layer by layer."""
    output = learned.output[0] + np.tensordot(p, learned.output[1:], axes=1)
    for touch in touches:
        hidden = learned.ranges.inputs(touch, angle_deg)
        for weight, bias in zip(learned.weights, learned.biases, strict=True):
            before = weight @ hidden + bias
            hidden = before / (1.0 + np.exp(-before))
        factor = touch[2] / learned.ranges.middle_force * learned.scale
        yield factor * output @ [*hidden, 1.0]


@pytest.mark.parametrize("layers", [1, 2, 4])
def test_response_is_that_of_the_plain_formula(learned, touches, layers):
    """Folding of scales into layers changes nothing, for any number of layers."""
    rng = np.random.default_rng(3)
    deep = replace(
        learned,
        weights=(learned.weights[0], *(0.1 * rng.standard_normal((layers - 1, 160, 160)))),
        biases=(learned.biases[0], *rng.standard_normal((layers - 1, 160))),
    )
    one, p = deep.for_specimen([0.5, -1.0]), [0.5, -1.0]
    expected = np.array(list(plain(deep, p, touches, 33.0)))
    size = np.abs(expected).max()
    np.testing.assert_allclose(one(touches, 33.0), expected, rtol=0, atol=1e-12 * size)
    said = one.with_derivatives(touches, 33.0)
    np.testing.assert_allclose(said[0], expected, rtol=0, atol=1e-12 * size)
    for by, step in zip(said[1:], 1e-6 * np.eye(3), strict=True):
        rise = one(touches + step, 33.0) - one(touches - step, 33.0)
        np.testing.assert_allclose(by, rise / 2e-6, rtol=0, atol=1e-5 * np.abs(by).max())


# Learning

STRENGTHS = np.exp(np.array([0.2, -0.2, 0.1, 0.0, -0.1, 0.15, -0.15, 0.0]))


def frames(count, seed):
    """Frames of one and two touches on eight specimens that differ in strength."""
    rng = np.random.default_rng(seed)
    touches = rng.uniform(TOUCH_PRIOR.low, TOUCH_PRIOR.high, (count, 2, 3))
    touches[rng.uniform(size=count) < 0.5, 1] = np.nan
    angle = rng.uniform(-20.0, 50.0, count)
    specimen = rng.integers(0, len(STRENGTHS), count)
    feature = np.linspace(-1.5, 1.5, len(STRENGTHS))[specimen]
    change = np.nansum([touch_change(touches[:, i], angle[:, None]) for i in range(2)], axis=0)
    # The feature makes some channels feel more and others less.
    change *= 1.0 + 0.05 * np.outer(feature, np.where(np.arange(28) % 2, 1.0, -1.0))
    change *= STRENGTHS[specimen][:, None]
    change += 1e-5 * rng.standard_normal(change.shape)
    return made_up_frames(change, angle, specimen, 1e-5, features=feature[:, None], touches=touches)


@pytest.mark.parametrize("features", [0, 1])
def test_network_says_what_it_was_trained_to_say(features):
    """The response without torch equals the network's; one specimen gives no covariance."""
    data = frames(40, 4)
    data = replace(data, features=data.features[:, :features])
    network = ResponseNetwork(data)
    network.latent.data[:] = 0.4  # the same for all: then it is none
    with torch.inference_mode():
        said = network(packed_inputs(data, RANGES)).numpy() * 0.5
    plain = folded_response(network, np.unique(data.specimen), 0.5, RANGES)
    for i in range(40):
        touches = data.touches[i][np.isfinite(data.touches[i][:, 0])]
        alone = plain.for_specimen(data.features[i])(touches, float(data.angle_deg[i])).sum(axis=0)
        np.testing.assert_allclose(alone, said[i], atol=1e-5 * np.abs(said).max())


NAN = np.nan
X = np.array([[0.010, 0.050, NAN], [0.001, NAN, NAN], [0.120, 0.120, 0.090]])
Y = np.array([[0.020, 0.020, NAN], [0.030, NAN, NAN], [0.050, 0.010, 0.030]])
FORCE = np.array([[4.0, 6.0, NAN], [8.0, NAN, NAN], [4.0, 10.0, 6.0]])


def test_prior_is_estimated_from_touches():
    """Bounds lie 3 mm and 30 % beyond the touches, but on the sensor."""
    prior = TouchPrior.fit(np.stack([X, Y, FORCE], axis=-1), SIZE, 0.0075)
    np.testing.assert_allclose(prior.low, [0.0, 0.007, 0.3 * 4.0])
    np.testing.assert_allclose(prior.high, [0.123, 0.053, 1.3 * 10.0])
    assert prior.separation == pytest.approx(np.hypot(0.030, 0.020))
    known = FORCE[np.isfinite(FORCE)]
    mean = known.mean()
    assert prior.force == pytest.approx((mean, np.hypot(known.std(), 0.15 * mean)))
    np.testing.assert_allclose(prior.box[0], [0.0615, 0.030, mean])
