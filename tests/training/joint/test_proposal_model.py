"""Proposal network: synthetic frames, training, and positions read from its map."""

from itertools import pairwise

import numpy as np

from eitskin.training.joint import touch_training
from eitskin.training.joint.networks import ProposalNetwork
from eitskin.training.joint.touch_response import MAX_TOUCHES
from eitskin.training.joint.touch_training import SyntheticFrames

from smooth_sensor import MEASUREMENTS, TOUCH_PRIOR, curves, response

MODEL = SyntheticFrames(
    response(mismatch=0.1, features=1), curves(features=1), TOUCH_PRIOR, MEASUREMENTS
)


def frames(count, seed=1):
    return MODEL.frames(count, np.random.default_rng(seed))


# Frames made up


def test_frames_are_follow_the_touch_prior():
    _, places = frames(4000)
    there = np.isfinite(places[..., 0])
    counts = there.sum(axis=1)
    assert set(counts) == {0, 1, 2, 3, 4}
    assert 0.12 < np.mean(counts == 0) < 0.3
    for axis in range(2):
        values = places[..., axis][there]
        assert TOUCH_PRIOR.low[axis] <= values.min() < TOUCH_PRIOR.low[axis] + 0.002
        assert TOUCH_PRIOR.high[axis] - 0.002 < values.max() <= TOUCH_PRIOR.high[axis]
    for i in range(MAX_TOUCHES):
        for j in range(i):
            apart = np.hypot(*(places[:, i] - places[:, j]).T)
            assert np.nanmin(apart) >= TOUCH_PRIOR.separation


def test_made_up_changes_are_those_of_the_response():
    """The mean change over specimens and noise is that of `TouchResponse`."""
    rng = np.random.default_rng(2)
    touches = np.full((2000, MAX_TOUCHES, 3), np.nan)
    touches[:, 0] = [0.05, 0.02, 9.0]
    angle, features = np.full(2000, 20.0), np.zeros((2000, 1))
    change = MODEL.touch_changes(touches, angle, features, rng)
    expected = MODEL.response.for_specimen([0.0])(touches[0, :1], 20.0)[0]
    strong = expected > 0.3 * expected.max()
    mean = change.mean(axis=0) / np.exp(0.5 * touch_training.LOG_SENSITIVITY_STD**2)
    np.testing.assert_allclose(mean[strong], expected[strong], rtol=0.02)
    spread = np.std(change / expected, axis=0)[strong]
    np.testing.assert_allclose(spread, np.hypot(touch_training.LOG_SENSITIVITY_STD, 0.1), rtol=0.1)


# Learned


# CombinedChange the map


def picture(*touches):
    """Network of constant output: bumps of these x, y and values."""
    columns, rows = np.linspace(0.01, 0.14, 27), np.linspace(0.01, 0.05, 9)
    x, y = np.meshgrid(columns, rows)
    values = np.full(x.shape, 1e-3)
    for px, py, value in touches:
        bump = value * np.exp(-0.5 * ((x - px) ** 2 + (y - py) ** 2) / 0.004**2)
        values = np.maximum(values, bump)
    logits = np.log(values / (1.0 - values)).ravel()
    return ProposalNetwork((np.zeros((len(logits), 3)),), (logits,), columns, rows)


def test_places_are_the_peaks_likeliest_first():
    found = picture((0.032, 0.023, 0.5), (0.112, 0.037, 0.9)).places(np.zeros(3), 0.030)
    np.testing.assert_allclose(found, [[0.112, 0.037], [0.032, 0.023]], atol=1.5e-3)


def test_map_is_that_of_the_plain_formula_in_double_precision():
    rng = np.random.default_rng(7)
    sizes = (30, 64, 64, 40)
    weights = tuple(rng.standard_normal((m, n)) / n**0.5 for n, m in pairwise(sizes))
    biases = tuple(rng.standard_normal(m) for m in sizes[1:])
    network = ProposalNetwork(weights, biases, np.arange(8.0), np.arange(5.0))
    inputs = hidden = rng.standard_normal(30)
    for weight, bias in zip(weights[:-1], biases[:-1], strict=True):
        before = weight @ hidden + bias
        hidden = before / (1.0 + np.exp(-before))
    expected = 1.0 / (1.0 + np.exp(-(weights[-1] @ hidden + biases[-1])))
    said = network.map(inputs)
    assert said.shape == (5, 8)
    np.testing.assert_allclose(said.ravel(), expected, atol=1e-5)
