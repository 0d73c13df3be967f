"""Priors of one-step Gauss-Newton pictures, as precision matrices of the pixels."""

import math
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import csc_array, diags_array
from scipy.sparse.linalg import splu

from eitskin.training.reconstruction.pixel_grid import PixelGrid
from eitskin.training.reconstruction.regularised_inverse import RegularisedInverse

Array = NDArray[np.float64]
Prior = Literal["tikhonov", "noser", "laplace"]

PRIOR_FLOOR = 0.1  # least weight of a pixel in NOSER's prior, relative to the median pixel's


def noser_weights(jacobian: Array) -> Array:
    """Diagonal (pixels,) of NOSER's prior diag(J^T J) (Cheney et al. 1990), with a floor.

    The floor is a tenth of the median. Behind the outermost electrodes lie a few corner pixels that
    hardly any current passes; plain NOSER lets their conductivity vary a hundred times more than
    elsewhere, and every image peaks there.
    """
    sensitivities = np.sum(jacobian**2, axis=0)
    weights: Array = np.maximum(sensitivities, PRIOR_FLOOR * np.median(sensitivities))
    return weights


def gauss_newton(jacobian: ArrayLike, prior: Array | csc_array) -> RegularisedInverse:
    """One-step Gauss-Newton (J^T J + lambda^2 R)^-1 J^T for every lambda.

    Computed in the push-through form R^-1 J^T (J R^-1 J^T + lambda^2 I)^-1: a system of the size of
    one frame instead of one image.

    Args:
        jacobian: J (measurements, pixels).
        prior: R, its diagonal (pixels,) or a sparse matrix (pixels, pixels), positive definite.
    """
    J = np.asarray(jacobian, dtype=float)
    if isinstance(prior, np.ndarray):
        weighted = (J / prior).T
    else:
        weighted = splu(prior, permc_spec="MMD_AT_PLUS_A").solve(np.ascontiguousarray(J.T))
    return RegularisedInverse(weighted, J @ weighted)


def prior_matrix(name: Prior, grid: PixelGrid, jacobian: Array) -> Array | csc_array:
    """Precision matrix R of a prior: a diagonal (P,), or a sparse matrix (P, P).

    tikhonov: the identity; every pixel varies by itself and alike.
    noser: diag(J^T J), see `noser_weights`; every pixel's signal varies alike.
    laplace: the discrete Laplacian, whose quadratic form is the sum of the squared differences of
        neighbours: smooth pictures.
    """
    if name == "tikhonov":
        return np.ones(len(grid))
    return noser_weights(jacobian) if name == "noser" else weighted_laplacian(grid)


def weighted_laplacian(grid: PixelGrid, weights: Array | None = None) -> csc_array:
    """Laplacian D^T W D with weights of each pixel's gradient, (P,), as a sparse matrix (P, P).

    A constant picture has no gradient. A tiny multiple of the identity, for pictures that vary over
    a hundred times the sensor's extent, makes the matrix positive definite.
    """
    w = np.ones(len(grid)) if weights is None else weights
    D = grid.differences
    floor = w.min() / (1e4 * math.prod(grid.shape))
    identity = diags_array(np.full(len(grid), floor))
    return csc_array(D.T @ diags_array(np.tile(w, 2)) @ D + identity)
