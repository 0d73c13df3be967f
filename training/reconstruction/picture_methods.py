"""Methods of images: priors of Gauss-Newton images, total variation, and GREIT."""

import math
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array, diags_array

from eitskin.training.reconstruction.pixel_grid import PixelGrid
from eitskin.training.reconstruction.regularised_inverse import (
    RegularisedInverse,
    gauss_newton,
    noser_weights,
)

Array = NDArray[np.float64]
Prior = Literal["tikhonov", "noser", "laplace"]

MAX_STEPS = 60
# relative change of a picture that ends the iteration of total variation
CONVERGENCE_TOLERANCE = 5e-4
SMOOTHING = 1e-3  # gradient below which edges count as slopes, relative to the largest gradient
TARGET_SHARE = 0.25  # radius of a training target, relative to that of its desired image
EDGE = 0.25  # width of the soft edge of a desired image, relative to its radius


def prior_matrix(name: Prior, grid: PixelGrid, jacobian: Array) -> Array | csc_array:
    """Precision matrix R of a prior: a diagonal (P,), or a sparse matrix (P, P).

    tikhonov: the identity; every pixel varies on its own and alike.
    noser: diag(J^T J), see `noser_weights`; every pixel's signal varies alike.
    laplace: the discrete Laplacian, whose quadratic form is the sum of the squared differences of
        neighbours: smooth images.
    """
    if name == "tikhonov":
        return np.ones(len(grid))
    return noser_weights(jacobian) if name == "noser" else weighted_laplacian(grid)


def weighted_laplacian(grid: PixelGrid, weights: Array | None = None) -> csc_array:
    """Laplacian D^T W D with weights of each pixel's gradient, (P,), as a sparse matrix (P, P).

    A constant image has no gradient. A tiny multiple of the identity, for images that vary over
    a hundred times the sensor's extent, makes the matrix positive definite.
    """
    w = np.ones(len(grid)) if weights is None else weights
    D = grid.differences
    floor = w.min() / (1e4 * math.prod(grid.shape))
    identity = diags_array(np.full(len(grid), floor))
    return csc_array(D.T @ diags_array(np.tile(w, 2)) @ D + identity)


def least_variation(grid: PixelGrid, jacobian: Array, data: Array, misfit: float) -> Array:
    """Image (P,) of least total variation that explains a frame up to a misfit |y - J x|.

    The total variation, the sum over pixels of sqrt(|grad x|^2 + beta^2), is majorised by a
    quadratic with the weights 1 / sqrt(|grad x_k|^2 + beta^2) of the image before (lagged
    diffusivity, Vogel and Oman 1996): each step is a one-step Gauss-Newton image with a weighted
    Laplacian as prior, and its total variation is at most that of the step before.

    Args:
        grid: pixels inside the outline, P.
        jacobian: J (measurements, P).
        data: y (measurements,), dimensionless.
        misfit: Euclidean norm; zero where that of the data is no larger.
    """
    J, y, misfit = _compress(jacobian, data, misfit)
    weights, picture, beta = np.ones(len(grid)), np.zeros(len(grid)), 0.0
    if np.linalg.norm(y) <= misfit or not y.any():
        return picture
    for step in range(MAX_STEPS):
        family = gauss_newton(J, weighted_laplacian(grid, weights))
        before = picture
        picture = family.picture(family.lambda_from_misfit(misfit, y), y)
        slopes = np.hypot(*(grid.differences @ picture).reshape(2, -1))
        if step == 0:
            beta = SMOOTHING * float(slopes.max())
        if np.linalg.norm(picture - before) < CONVERGENCE_TOLERANCE * np.linalg.norm(picture):
            break
        weights = beta / np.sqrt(slopes**2 + beta**2)
    return picture


def _compress(jacobian: Array, data: Array, misfit: float) -> tuple[Array, Array, float]:
    """Jacobian, data and misfit in the range of the Jacobian, without dependent measurements.

    The part of the data that no image explains counts towards the misfit.
    """
    vectors, sizes, _ = np.linalg.svd(jacobian, full_matrices=False)
    independent = sizes > 1e-9 * sizes[0]
    basis = vectors[:, independent]
    inner = basis.T @ data
    unexplained = float(data @ data - inner @ inner)
    return basis.T @ jacobian, inner, float(np.sqrt(max(misfit**2 - unexplained, 0.0)))


def desired_radius(grid: PixelGrid, measurements: int) -> float:
    """Radius of desired images [m]: twice that of a disc of the area per independent measurement.

    Sixteen electrodes around a disc, driven and sensed by neighbours, have 104 independent
    measurements: the radius is a fifth of the disc's, as in Adler et al. 2009.
    """
    return 2.0 * math.sqrt(len(grid) * grid.area / (math.pi * measurements))


def greit(grid: PixelGrid, jacobian: Array, radius: float) -> RegularisedInverse:
    """Matrices R that minimise the sum over targets of |R y - d|^2, plus noise of lambda.

    Targets t are discs of `TARGET_SHARE` of the radius about every pixel, their data y = J t, and
    their desired images d discs of `radius` with a soft edge that have the same integral. With
    targets in the columns of T and desired images in those of D, and Y = J T, the minimum is
    R = D Y^T (Y Y^T + lambda^2 I)^-1 (Adler et al. 2009, with uniform weights and white noise).

    Args:
        grid: pixels inside the outline, P.
        jacobian: J (measurements, P).
        radius: radius of desired images [m]; see `desired_radius`.
    """
    targets = grid.discs(grid.centres, max(TARGET_SHARE * radius, 0.5 * math.sqrt(grid.area)))
    desired = desired_images(grid, radius)
    desired *= (targets.sum(axis=1) / desired.sum(axis=1))[:, None]
    data = targets @ jacobian.T
    return RegularisedInverse(desired.T @ data, data.T @ data)


def desired_images(grid: PixelGrid, radius: float) -> Array:
    """Discs with a soft edge about every pixel, (P, P), each row one of them.

    The edge is a logistic function of the distance: one inside, zero outside, one half at `radius`.
    """
    away = np.linalg.norm(grid.centres[:, None] - grid.centres, axis=2)
    steepness = np.clip((away - radius) / (EDGE * radius / 2.0), -50.0, 50.0)
    images: Array = 1.0 / (1.0 + np.exp(steepness))
    return images
