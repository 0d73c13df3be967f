"""Relative differences to a conductivity map: one Gauss-Newton step with the NOSER prior."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eitskin.errors import ConfigurationError

DARKEST = 0.1  # least weight of a pixel in the prior, in units of the median pixel's
MAX_SNR = 1e4  # of noise-free training sets, whose own ratio would leave the step unregularised


@dataclass(frozen=True, slots=True, eq=False)
class Reconstruction:
    """The linear map from dV to a picture of the relative conductivity change.

    Attributes:
        matrix: (pixels, measurements), dimensionless.
        shape: of the picture, (rows along y, columns along x).
        regularisation: lambda of the one-step Gauss-Newton method.
    """

    matrix: NDArray[np.float64]
    shape: tuple[int, int]
    regularisation: float

    @classmethod
    def fit(cls, jacobian: ArrayLike, snr: float, shape: tuple[int, int]) -> "Reconstruction":
        """Precompute the step for a relative `jacobian` (measurements, pixels) and an `snr`.

        The step of the paper, (J^T J + lambda^2 R)^-1 J^T with NOSER's R = diag(J^T J) (Cheney
        et al. 1990), is taken in its push-through form R^-1 J^T (J R^-1 J^T + lambda^2 I)^-1: the
        same matrix from a system of the size of one frame instead of one picture.

        R has a floor, a tenth of its median. Behind the outermost electrodes lie a few corner
        pixels that hardly any current passes; plain NOSER lets their conductivity vary a hundred
        times more than elsewhere, and every picture peaks there.

        lambda is not tuned. The step is the most probable picture when dsigma has the covariance
        s^2 R^-1 and the noise n^2 I, with lambda = n / s. Such pictures give signals of
        covariance s^2 J R^-1 J^T, so the mean square signal of the M measurements is
        S^2 = s^2 trace(J R^-1 J^T) / M. Setting S to the root mean square of a touch gives
        lambda = n / s = sqrt(trace(J R^-1 J^T) / M) / SNR, with SNR = S / n. Without the floor,
        R_p = sum_m J_mp^2 and the trace is the number of pixels.
        """
        J = np.asarray(jacobian, dtype=float)
        measurements, pixels = J.shape
        if pixels != shape[0] * shape[1]:
            raise ConfigurationError(
                f"a {shape[0]} x {shape[1]} picture needs a Jacobian of {shape[0] * shape[1]} "
                f"columns, got {pixels}"
            )
        if not snr > 0:
            raise ConfigurationError(f"snr must be positive, got {snr!r}")
        sensitivities = np.sum(J**2, axis=0)
        prior = np.maximum(sensitivities, DARKEST * np.median(sensitivities))
        weighted = (J / prior).T  # R^-1 J^T
        covariance = J @ weighted
        regularisation = float(np.sqrt(np.trace(covariance) / measurements) / min(snr, MAX_SNR))
        system = covariance + regularisation**2 * np.eye(measurements)
        return cls(np.linalg.solve(system, weighted.T).T, shape, regularisation)

    def apply(self, difference: ArrayLike) -> NDArray[np.float64]:
        """Pictures (..., rows, columns) of relative differences (..., measurements)."""
        dV = np.asarray(difference, dtype=float)
        pictures = dV @ self.matrix.T
        return pictures.reshape(*dV.shape[:-1], *self.shape)

    def arrays(self) -> dict[str, NDArray[np.generic]]:
        """What `from_arrays` needs to make this stage again."""
        return {
            "matrix": self.matrix,
            "shape": np.array(self.shape),
            "regularisation": np.array(self.regularisation),
        }

    @classmethod
    def from_arrays(cls, arrays: dict[str, NDArray[np.generic]]) -> "Reconstruction":
        """The stage that `arrays` came from."""
        rows, columns = (int(n) for n in arrays["shape"].astype(int))
        regularisation = float(arrays["regularisation"].astype(float))
        return cls(arrays["matrix"].astype(float), (rows, columns), regularisation)


def relative_jacobian(
    sensitivity: ArrayLike, impedance: ArrayLike, conductivity: float
) -> NDArray[np.float64]:
    """Relative change of each measurement per relative change of each pixel, dimensionless.

    Args:
        sensitivity: dR/dsigma (measurements, pixels) [ohm per S/m].
        impedance: of the same sensor (measurements,) [ohm].
        conductivity: at which the sensitivity was taken [S/m].
    """
    R = np.real(np.asarray(impedance))
    J: NDArray[np.float64] = conductivity * np.asarray(sensitivity, dtype=float) / R[:, None]
    return J


def signal_to_noise(touch: ArrayLike, noise: float) -> float:
    """Root mean square of touches' dV (n, measurements) over that of the noise in it."""
    total = float(np.mean(np.square(np.asarray(touch, dtype=float))))
    if noise <= 0:
        return MAX_SNR
    # A touch below a tenth of the noise is not to be seen, whatever the difference says.
    return float(np.sqrt(max(total / noise**2 - 1.0, 0.01)))
