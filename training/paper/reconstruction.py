"""One-step Gauss-Newton reconstruction with the NOSER prior."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eitskin.errors import ConfigurationError

PRIOR_FLOOR = 0.1  # least weight of a pixel in the prior, relative to the median pixel's
MAX_SNR = 1e4  # for noise-free training sets, whose step would otherwise be unregularised


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
    def fit(cls, jacobian: ArrayLike, snr: float, shape: tuple[int, int]) -> "Reconstruction":
        """Reconstruction matrix for a Jacobian and a signal-to-noise ratio.

        The matrix of the paper, (J^T J + lambda^2 R)^-1 J^T with NOSER's R = diag(J^T J) (Cheney
        et al. 1990), is computed in its push-through form R^-1 J^T (J R^-1 J^T + lambda^2 I)^-1:
        a system of the size of one frame instead of one image.

        R has a floor, a tenth of its median. Behind the outermost electrodes lie a few corner
        pixels that hardly any current passes; plain NOSER lets their conductivity vary a hundred
        times more than elsewhere, and every image peaks there.

        lambda is not tuned. The step is the MAP estimate for a prior dsigma ~ N(0, s^2 R^-1) and
        noise of covariance n^2 I, with lambda = n / s. Under this prior signals have the
        covariance s^2 J R^-1 J^T, so the mean square signal of the M measurements is
        S^2 = s^2 trace(J R^-1 J^T) / M. Setting S to the root mean square of a touch gives
        lambda = n / s = sqrt(trace(J R^-1 J^T) / M) / SNR, with SNR = S / n. Without the floor,
        R_p = sum_m J_mp^2 and the trace is the number of pixels.

        Args:
            jacobian: relative Jacobian (measurements, pixels), dimensionless.
            snr: signal-to-noise ratio of a touch, root mean squares; see `signal_to_noise`.
            shape: of an image, (rows along y, columns along x).

        Raises:
            ConfigurationError: for a Jacobian of another shape, or an `snr` that is not positive.
        """
        J = np.asarray(jacobian, dtype=float)
        measurements, pixels = J.shape
        if pixels != shape[0] * shape[1]:
            raise ConfigurationError(
                f"expected a Jacobian of {shape[0] * shape[1]} columns for a "
                f"{shape[0]} x {shape[1]} image, got {pixels}; take it for the same pixels"
            )
        if not snr > 0:
            raise ConfigurationError(
                f"expected a positive snr, got {snr!r}; take that of the training frames"
            )
        sensitivities = np.sum(J**2, axis=0)
        prior = np.maximum(sensitivities, PRIOR_FLOOR * np.median(sensitivities))
        weighted = (J / prior).T  # R^-1 J^T
        covariance = J @ weighted
        regularisation = float(np.sqrt(np.trace(covariance) / measurements) / min(snr, MAX_SNR))
        system = covariance + regularisation**2 * np.eye(measurements)
        return cls(np.linalg.solve(system, weighted.T).T, shape, regularisation)

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


def relative_jacobian(
    sensitivity: ArrayLike, impedance: ArrayLike, conductivity: float
) -> NDArray[np.float64]:
    """Relative Jacobian (measurements, pixels), d log R / d log sigma, dimensionless.

    Args:
        sensitivity: dR/dsigma (measurements, pixels) [ohm per S/m].
        impedance: of the same sensor (measurements,) [ohm].
        conductivity: at which the sensitivity was taken [S/m].
    """
    R = np.real(np.asarray(impedance))
    J: NDArray[np.float64] = conductivity * np.asarray(sensitivity, dtype=float) / R[:, None]
    return J


def signal_to_noise(touch: ArrayLike, noise: float) -> float:
    """Signal-to-noise ratio of touches' dV (n, measurements) with noise of rms `noise` in it."""
    total = float(np.mean(np.square(np.asarray(touch, dtype=float))))
    if noise <= 0:
        return MAX_SNR
    # A signal below a tenth of the noise cannot be seen; the difference of squares may be negative.
    return float(np.sqrt(max(total / noise**2 - 1.0, 0.01)))
