"""One-step Gauss-Newton reconstruction with the NOSER prior."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eitskin.errors import ConfigurationError
from eitskin.training.reconstruction.priors import gauss_newton, noser_weights
from eitskin.training.reconstruction.regularised_inverse import MAX_SNR


@dataclass(frozen=True, slots=True, eq=False)
class Reconstruction:
    """Linear reconstruction of the relative conductivity change from dV.

    Attributes:
        matrix: reconstruction matrix (pixels, measurements), dimensionless.
        shape: of an image, (rows along y, columns along x).
        regularisation: lambda of the one-step Gauss-Newton method, dimensionless.
    """

    matrix: NDArray[np.float64]
    shape: tuple[int, int]
    regularisation: float

    @classmethod
    def fit(
        cls, jacobian: ArrayLike, snr: float, shape: tuple[int, int], noise: ArrayLike = 1.0
    ) -> "Reconstruction":
        """Reconstruction matrix for a Jacobian and a signal-to-noise ratio.

        The matrix of the paper is (J^T J + lambda^2 R)^-1 J^T with NOSER's R = diag(J^T J), with a
        floor (`priors.noser_weights`). lambda is not tuned but that of the signal-to-noise ratio
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

    def apply(self, difference: ArrayLike) -> NDArray[np.float64]:
        """Relative conductivity change (..., rows, columns) from dV (..., measurements)."""
        dV = np.asarray(difference, dtype=float)
        images = dV @ self.matrix.T
        return images.reshape(*dV.shape[:-1], *self.shape)

    def arrays(self) -> dict[str, NDArray[np.generic]]:
        """Trained arrays of the stage, as `from_arrays` takes them."""
        return {
            "matrix": self.matrix,
            "shape": np.array(self.shape),
            "regularisation": np.array(self.regularisation),
        }

    @classmethod
    def from_arrays(cls, arrays: dict[str, NDArray[np.generic]]) -> "Reconstruction":
        """The stage with the trained `arrays`."""
        rows, columns = (int(n) for n in arrays["shape"].astype(int))
        regularisation = float(arrays["regularisation"].astype(float))
        return cls(arrays["matrix"].astype(float), (rows, columns), regularisation)


def signal_to_noise(touch: ArrayLike, noise: float) -> float:
    """Signal-to-noise ratio of touches' dV (n, measurements) with noise of rms `noise` in it."""
    total = float(np.mean(np.square(np.asarray(touch, dtype=float))))
    if noise <= 0:
        return MAX_SNR
    # A signal below a tenth of the noise cannot be seen; the difference of squares may be negative.
    return float(np.sqrt(max(total / noise**2 - 1.0, 0.01)))
