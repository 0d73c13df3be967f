"""Inversion of maps, against covariances without bad channels; regressors of version 0.1."""

import numpy as np
import pytest

from eitskin.errors import DataError
from eitskin.training.adaptation.locator import Places, PositionRegressor, _Score, mixture_places


def test_a_bad_channel_is_left_out_of_covariance_and_residual():
    rng = np.random.default_rng(0)
    whitening, keep = rng.standard_normal((4, 4)), [0, 2, 3]
    back = np.linalg.inv(whitening)
    answer, means = rng.standard_normal(4), rng.standard_normal((2, 4))
    precision = rng.uniform(0.2, 1.0, (2, 4))
    score = _Score(np.array([1.0, 0.5]), answer @ whitening, whitening[[1]])
    yy, ym, mm, log = score._products(means, precision)
    dropped = []
    for at in range(2):
        covariance = (back.T @ np.diag(1.0 / precision[at]) @ back)[np.ix_(keep, keep)]
        y, m = answer[keep], (means[at] @ back)[keep]
        expected = [a @ np.linalg.solve(covariance, b) for a, b in ((y, y), (y, m), (m, m))]
        np.testing.assert_allclose([yy[at], ym[at], mm[at]], expected, rtol=1e-9)
        dropped.append(-np.linalg.slogdet(covariance)[1])
    np.testing.assert_allclose(log[1] - log[0], dropped[1] - dropped[0], rtol=1e-9)


def test_mixed_places_have_the_moments_of_the_mixture():
    rng = np.random.default_rng(1)
    each = [
        Places(rng.normal(size=(2, 2)), rng.uniform(0.1, 2.0, 2), np.ones(2), np.zeros((2, 4)))
        for _ in range(3)
    ]
    mixed = mixture_places(each)
    drawn = [
        one.place + one.deviation[:, None] / np.sqrt(2.0) * rng.standard_normal((100_000, 2, 2))
        for one in each
    ]
    points = np.concatenate(drawn)
    np.testing.assert_allclose(mixed.place, points.mean(axis=0), atol=0.02)
    spread = np.sqrt(points.var(axis=0).sum(axis=1))
    np.testing.assert_allclose(mixed.deviation, spread, rtol=0.01)
    assert mixture_places(each[:1]) is each[0]


def regressor(channels=8, count=30, seed=0):
    rng = np.random.default_rng(seed)
    directions = rng.standard_normal((count, channels))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    weights = rng.standard_normal((count, 2)) * 0.01
    return PositionRegressor(np.full(channels, 0.02), directions, weights, np.zeros(2), 0.7, 1.5)


def test_positions_are_scikit_learns_prediction():
    from sklearn.gaussian_process.kernels import Matern

    stage = regressor()
    ratio = np.exp(0.02 * np.random.default_rng(1).standard_normal((5, 8)))
    logs = np.log(ratio)
    directions = logs / np.linalg.norm(logs, axis=1, keepdims=True)
    covariance = 1.5 * Matern(0.7, nu=2.5)(directions, stage.directions)
    np.testing.assert_allclose(stage.apply(ratio), covariance @ stage.weights, atol=1e-12)
    np.testing.assert_allclose(stage.apply(ratio**3), stage.apply(ratio), atol=1e-9)


def test_bad_channels_and_other_numbers_of_them():
    stage = regressor()
    ratio = np.ones((2, 8))
    ratio[0, 0] = np.nan
    assert np.isfinite(stage.apply(ratio)).all()
    with pytest.raises(DataError, match="8 channels, got 7"):
        stage.apply(ratio[:, :7])
