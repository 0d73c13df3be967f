"""GREIT: a linear reconstruction trained on simulated targets (Adler et al. 2009)."""

import math

import numpy as np
from numpy.typing import NDArray

from eitskin.training.reconstruction.pixel_grid import PixelGrid
from eitskin.training.reconstruction.regularised_inverse import RegularisedInverse

Array = NDArray[np.float64]

TARGET_SHARE = 0.25  # radius of a training target, relative to that of its desired image
EDGE = 0.25  # width of the soft edge of a desired image, relative to its radius


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
        radius: of desired images [m]; see `desired_radius`.
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
