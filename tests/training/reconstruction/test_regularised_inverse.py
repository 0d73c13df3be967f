"""Pictures by regularised least squares, and the pixels of their grids."""

import numpy as np
import pytest

from eitskin.errors import ConfigurationError, DataError
from eitskin.geometry.design.outline import Disc, Polygon, Rectangle
from eitskin.training.reconstruction.picture_methods import least_variation, prior_matrix
from eitskin.training.reconstruction.pixel_grid import PixelGrid, figures_of_merit
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


# Pixels of rectangles, discs and polygons

L_SHAPE = Polygon(((0, 0), (0.12, 0), (0.12, 0.05), (0.06, 0.05), (0.06, 0.1), (0, 0.1)))


def test_reference_sensor_has_squares_of_two_millimetres():
    grid = PixelGrid.from_outline(Rectangle(0.150, 0.060))
    assert grid.shape == (30, 75)
    assert len(grid) == 2250
    assert grid.sides == pytest.approx((2e-3, 2e-3))
    assert (grid.x[0], grid.y[-1]) == pytest.approx((1e-3, 59e-3))


@pytest.mark.parametrize(("outline", "area"), [(Disc(0.05), np.pi * 0.05**2), (L_SHAPE, 0.009)])
def test_mask_has_the_area_of_the_outline(outline, area):
    grid = PixelGrid.from_outline(outline, 4000)
    assert len(grid) * grid.area == pytest.approx(area, rel=0.02)
    picture = grid.image(np.arange(len(grid)))
    assert np.isnan(picture).sum() == picture.size - len(grid)
    assert (picture[grid.inside] == np.arange(len(grid))).all()


def test_differences_of_a_slope_are_its_gradient_and_none_crosses_the_rim():
    grid = PixelGrid.from_outline(L_SHAPE, 300)
    x, y = grid.centres.T
    along_x, along_y = (grid.differences @ (3.0 * x - 2.0 * y)).reshape(2, -1)
    for values, expected in ((along_x, 3.0 * grid.sides[0]), (along_y, -2.0 * grid.sides[1])):
        assert values[values != 0.0] == pytest.approx(expected)
    assert (along_x == 0.0).sum() == grid.shape[0]  # the last pixel of every row


# ---- figures of merit ----


DISC = PixelGrid.from_outline(Disc(0.1), 10_000)
CENTRE, RADIUS = (0.13, 0.09), 0.02
INTEGRAL = np.pi * RADIUS**2


def test_picture_of_nothing_is_refused():
    with pytest.raises(DataError, match="got none"):
        figures_of_merit(np.zeros(len(DISC)), DISC, CENTRE, INTEGRAL)
