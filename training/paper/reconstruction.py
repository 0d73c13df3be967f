"""One-step Gauss-Newton reconstruction with the NOSER prior, and signals without bends."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eitskin.errors import ConfigurationError
from eitskin.training.method.stored_fields import StoredFields
from eitskin.training.reconstruction.regularised_inverse import (
    MAX_SNR,
    gauss_newton,
    noser_weights,
)

Array = NDArray[np.float64]

TOLERANCE = 1.05  # of the residual of bend frames, over the noise


@dataclass(frozen=True, slots=True, eq=False)
class Reconstruction(StoredFields):
    """Linear reconstruction of the relative conductivity change from dV.

    Attributes:
        matrix: reconstruction matrix (pixels, measurements), dimensionless.
        shape: of an image, (rows along y, columns along x).
        regularisation: lambda of the one-step Gauss-Newton method, dimensionless.
    """

    matrix: Array
    shape: tuple[int, int]
    regularisation: float

    @classmethod
    def fit(
        cls, jacobian: ArrayLike, snr: float, shape: tuple[int, int], noise: ArrayLike = 1.0
    ) -> "Reconstruction":
        """Reconstruction matrix for a Jacobian and a signal-to-noise ratio.

        The matrix of the paper is (J^T J + lambda^2 R)^-1 J^T with NOSER's R = diag(J^T J), with a
        floor (`noser_weights`). lambda is not tuned but that of the signal-to-noise ratio
        (`RegularisedInverse.of_snr`).

        Args:
            jacobian: relative Jacobian (measurements, pixels), dimensionless.
            snr: signal-to-noise ratio of a touch, root mean squares; see `signal_to_noise`.
            shape: of an image, (rows along y, columns along x).
            noise: rms noise of each channel's dV (measurements,) in a common unit; channels count
                by its inverse, equally for a single number.

        Raises:
            ConfigurationError: for a Jacobian of another shape, or an `snr` that is not positive.
        """
        J = np.asarray(jacobian, dtype=float)
        pixels = J.shape[1]
        if pixels != shape[0] * shape[1]:
            raise ConfigurationError(
                f"expected a Jacobian of {shape[0] * shape[1]} columns for a "
                f"{shape[0]} x {shape[1]} image, got {pixels}; take it for the same pixels"
            )
        rms = np.broadcast_to(np.asarray(noise, dtype=float), J.shape[:1])
        whitened = J / rms[:, None]
        family = gauss_newton(whitened, noser_weights(whitened))
        regularisation = family.of_snr(snr)
        return cls(family.matrix(regularisation) / rms, shape, regularisation)

    def apply(self, difference: ArrayLike) -> Array:
        """Relative conductivity change (..., rows, columns) from dV (..., measurements)."""
        dV = np.asarray(difference, dtype=float)
        images = dV @ self.matrix.T
        return images.reshape(*dV.shape[:-1], *self.shape)


def signal_to_noise(touch: ArrayLike, noise: float) -> float:
    """Signal-to-noise ratio of touches' dV (n, measurements) with noise of rms `noise` in it."""
    total = float(np.mean(np.square(np.asarray(touch, dtype=float))))
    if noise <= 0:
        return MAX_SNR
    # A signal below a tenth of the noise cannot be seen; the difference of squares may be negative.
    return float(np.sqrt(max(total / noise**2 - 1.0, 0.01)))


def bend_free_projection(bend: ArrayLike, noise: float) -> Array:
    """Orthogonal projection (C, C) that reduces the dV (n, C) of bend frames to their noise.

    Bending moves one sensor along a curve in the space of its channels, several sensors along
    several curves; the leading right singular vectors of their frames span these. The rank is the
    smallest that leaves a residual within five percent of `noise`, the rms of idle dV, and at most
    half the number of channels.
    """
    dV = np.asarray(bend, dtype=float)
    count, channels = dV.shape
    _, sizes, directions = np.linalg.svd(dV, full_matrices=False)
    energy = np.sum(sizes**2) - np.concatenate([[0.0], np.cumsum(sizes**2)])
    freedom = count * (channels - np.arange(len(energy)))
    residual = np.sqrt(np.maximum(energy, 0.0) / np.maximum(freedom, 1))
    # At least half of the channels' freedom stays: touches need it.
    rank = min(int(np.count_nonzero(residual > TOLERANCE * noise)), channels // 2)
    basis = directions[:rank]
    projection: Array = np.eye(channels) - basis.T @ basis
    return projection
