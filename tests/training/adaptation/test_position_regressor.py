"""Touch positions learned by version 0.1: what its saved regressors compute."""

import numpy as np
import pytest

from eitskin.errors import DataError
from eitskin.training.adaptation.position_regressor import PositionRegressor


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
