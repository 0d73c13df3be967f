"""Gauss-Newton pictures against dense least squares, and the rules for lambda."""

import numpy as np
import pytest

from eitskin.errors import ConfigurationError
from eitskin.geometry.design.outline import Rectangle
from eitskin.training.reconstruction.picture_methods import least_variation, prior_matrix
from eitskin.training.reconstruction.pixel_grid import PixelGrid
from eitskin.training.reconstruction.regularised_inverse import Regularisation, gauss_newton

GRID = PixelGrid.from_outline(Rectangle(0.12, 0.06), 72)
RNG = np.random.default_rng(0)
# Channels feel the surroundings of one position each, more or less.
J = -GRID.discs(RNG.uniform((0, 0), (0.12, 0.06), (15, 2)), 0.03) @ np.diag(np.geomspace(1, 3, 72))
TRUTH = GRID.discs([(0.05, 0.03)], 0.015)[0]


def family(name="tikhonov"):
    return gauss_newton(J, prior_matrix(name, GRID, J))


@pytest.mark.parametrize("name", ["tikhonov", "noser", "laplace"])
def test_picture_is_that_of_dense_least_squares(name):
    """|J x - y|^2 + lambda^2 x^T R x, with a root of R written out, by an independent solver."""
    roots = {
        "tikhonov": np.eye(72),
        "noser": np.diag(np.linalg.norm(J, axis=0)),
        "laplace": GRID.differences.toarray(),
    }
    y, parameter = RNG.normal(size=15), 0.7
    stacked = np.concatenate([J, parameter * roots[name]])
    expected = np.linalg.lstsq(stacked, np.concatenate([y, np.zeros(len(roots[name]))]))[0]
    assert family(name).matrix(parameter) @ y == pytest.approx(expected, rel=1e-4, abs=1e-6)


def test_missing_channels_are_those_of_a_smaller_jacobian():
    missing = np.arange(15) % 4 == 1
    smaller = gauss_newton(J[~missing], np.ones(72)).matrix(0.3)
    assert family().drop_channels(missing).matrix(0.3) == pytest.approx(smaller)


def test_noise_figure_is_that_of_drawn_noise():
    inverse, parameter = family(), 0.9
    response = J @ TRUTH
    noise = np.random.default_rng(1).normal(size=(20_000, 15)) @ inverse.matrix(parameter).T
    signal = np.abs(inverse.matrix(parameter) @ response).mean() / np.sqrt(np.mean(noise**2))
    expected = np.abs(response).mean() / signal
    assert inverse.noise_figure(parameter, response) == pytest.approx(expected, rel=0.01)
    chosen = inverse.lambda_from_noise_figure(expected, response)
    assert chosen == pytest.approx(parameter, rel=0.05)


def test_cross_validation_is_least_at_its_lambda_and_near_the_best_picture():
    rng = np.random.default_rng(3)
    inverse = family()
    pictures = rng.normal(size=(50, 72))
    y = pictures @ J.T + 2.0 * rng.normal(size=(50, 15))

    def score(parameter):
        left = np.eye(15) - J @ inverse.matrix(parameter)
        return np.sum((y @ left) ** 2) / np.trace(left) ** 2

    found = inverse.lambda_from_gcv(y)
    assert score(found) <= min(score(found * factor) for factor in (0.1, 0.9, 1.1, 10.0))
    # The pictures are drawn from the prior with s = 1, and the noise is 2: lambda = n / s.
    assert found == pytest.approx(2.0, rel=0.3)


def test_misfit_is_kept():
    y, inverse = RNG.normal(size=15), family("laplace")
    parameter = inverse.lambda_from_misfit(1.2, y)
    assert np.linalg.norm(y - J @ inverse.matrix(parameter) @ y) == pytest.approx(1.2, rel=1e-3)


def test_rules_by_name():
    assert Regularisation.from_text("noise-figure:0.5") == Regularisation("noise-figure", 0.5)
    assert Regularisation.from_text("gcv").rule == "gcv"
    assert Regularisation.from_text("lambda:3").choose(family(), TRUTH, J) == 3.0
    assert Regularisation.from_text("snr:10").choose(
        family(), TRUTH, J
    ) == family().lambda_from_snr(10.0)
    for text in ("gcv:1", "snr", "snr:x", "snr:-1", "lambda:inf", "l-curve:1"):
        with pytest.raises(ConfigurationError, match="expected a rule"):
            Regularisation.from_text(text)


# ---- total variation ----


def test_step_of_one_dimension_has_its_closed_form():
    """min |x - y|^2 / 2 + alpha TV(x): both plateaus move by alpha over their lengths."""
    grid = PixelGrid(Rectangle(0.04, 0.001), (1, 40))
    y = np.where(np.arange(40) < 10, 1.0, 3.0)
    alpha = 2.0
    misfit = alpha * np.sqrt(1 / 10 + 1 / 30)
    found = least_variation(grid, np.eye(40), y, misfit)
    expected = np.where(np.arange(40) < 10, 1.0 + alpha / 10, 3.0 - alpha / 30)
    assert found == pytest.approx(expected, abs=0.1)  # corners are rounded a little
    assert found[[0, -1]] == pytest.approx(expected[[0, -1]], abs=0.015)


def test_data_within_the_misfit_need_no_change():
    grid = PixelGrid.from_outline(Rectangle(0.1, 0.1), 25)
    assert not least_variation(grid, np.eye(25), np.full(25, 0.1), 1.0).any()
