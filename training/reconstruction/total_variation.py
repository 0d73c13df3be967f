"""Total-variation pictures by lagged diffusivity."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eitskin.training.reconstruction.pixel_grid import PixelGrid
from eitskin.training.reconstruction.priors import gauss_newton, weighted_laplacian

Array = NDArray[np.float64]

MOST_STEPS = 60
SETTLED = 5e-4  # relative change of a picture that ends the iteration
SMOOTHING = 1e-3  # gradient below which edges count as slopes, relative to the largest gradient


@dataclass(frozen=True, slots=True, eq=False)
class TotalVariation:
    """Pictures of least total variation that explain a frame up to a misfit.

    The total variation, the sum over pixels of sqrt(|grad x|^2 + beta^2), is majorised by a
    quadratic with the weights 1 / sqrt(|grad x_k|^2 + beta^2) of the picture before (lagged
    diffusivity, Vogel and Oman 1996): each step is a one-step Gauss-Newton picture with a weighted
    Laplacian as prior, and its total variation is at most that of the step before.

    Attributes:
        grid: pixels inside the outline, P.
        jacobian: J (measurements, P).
    """

    grid: PixelGrid
    jacobian: Array

    def picture(self, data: Array, misfit: float, history: list[float] | None = None) -> Array:
        """Picture (P,) of data (measurements,) with the misfit |y - J x|.

        Args:
            data: y, dimensionless.
            misfit: Euclidean norm; zero where that of the data is no larger.
            history: receives the total variation after each step.
        """
        J, y, misfit = _compressed(self.jacobian, data, misfit)
        if np.linalg.norm(y) <= misfit or not y.any():
            return np.zeros(len(self.grid))
        weights, picture, beta = np.ones(len(self.grid)), np.zeros(len(self.grid)), 0.0
        for step in range(MOST_STEPS):
            family = gauss_newton(J, weighted_laplacian(self.grid, weights))
            before = picture
            picture = family.picture(family.of_misfit(misfit, y), y)
            slopes = self.slopes(picture)
            if step == 0:
                beta = SMOOTHING * float(slopes.max())
            size = np.sqrt(slopes**2 + beta**2)
            if history is not None:
                history.append(float(size.sum()))
            if np.linalg.norm(picture - before) < SETTLED * np.linalg.norm(picture):
                break
            weights = beta / size
        return picture

    def slopes(self, picture: Array) -> Array:
        """Magnitudes (P,) of the gradient of a picture (P,), per pixel side."""
        along_x, along_y = (self.grid.differences @ picture).reshape(2, -1)
        slopes: Array = np.hypot(along_x, along_y)
        return slopes


def _compressed(jacobian: Array, data: Array, misfit: float) -> tuple[Array, Array, float]:
    """Jacobian, data and misfit in the range of the Jacobian, without dependent measurements.

    The part of the data that no picture explains counts towards the misfit.
    """
    vectors, sizes, _ = np.linalg.svd(jacobian, full_matrices=False)
    kept = sizes > 1e-9 * sizes[0]
    basis = vectors[:, kept]
    inner = basis.T @ data
    unexplained = float(data @ data - inner @ inner)
    return basis.T @ jacobian, inner, float(np.sqrt(max(misfit**2 - unexplained, 0.0)))
