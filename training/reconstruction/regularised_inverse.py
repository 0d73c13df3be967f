"""Families of linear reconstructions over the regularisation parameter, and the choice of it."""

from dataclasses import dataclass
from functools import cached_property
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import brentq, minimize_scalar
from scipy.sparse import csc_array
from scipy.sparse.linalg import splu

from eitskin.bounds import LEAST, MOST
from eitskin.errors import ConfigurationError
from eitskin.extras import old_names

Array = NDArray[np.float64]
RuleName = Literal["noise-figure", "snr", "gcv", "lambda"]

_RANGE = (-9.0, 6.0)  # decades of lambda about the root mean square signal that are searched
PRIOR_FLOOR = 0.1  # least weight of a pixel in NOSER's prior, relative to the median pixel's
MAX_SNR = 1e4  # for noise-free data, whose step would otherwise be unregularised


@dataclass(frozen=True, eq=False)
class RegularisedInverse:
    """Reconstruction matrices B (G + lambda^2 I)^-1 of every lambda, for white noise.

    One-step Gauss-Newton has this form with B = R^-1 J^T and G = J B (`gauss_newton`), GREIT with
    B = D Y^T and G = Y Y^T (`picture_methods.greit`).

    Attributes:
        back: B (pixels, measurements).
        gram: G (measurements, measurements), symmetric and positive semidefinite.
    """

    back: Array
    gram: Array

    def matrix(self, regularisation: float) -> Array:
        """Reconstruction matrix (pixels, measurements) of lambda."""
        system = self._system(regularisation)
        solved: Array = np.asarray(np.linalg.solve(system, self.back.T).T, dtype=np.float64)
        return solved

    def picture(self, regularisation: float, data: Array) -> Array:
        """Image (pixels,) of lambda and data (measurements,), without the matrix."""
        picture: Array = self.back @ np.linalg.solve(self._system(regularisation), data)
        return picture

    def _system(self, regularisation: float) -> Array:
        """Matrix G + lambda^2 I (measurements, measurements)."""
        system: Array = self.gram + regularisation**2 * np.eye(len(self.gram))
        return system

    def drop_channels(self, channels: NDArray[np.bool_]) -> "RegularisedInverse":
        """The family for frames without some channels, a mask (measurements,)."""
        kept = ~channels
        return RegularisedInverse(self.back[:, kept], self.gram[np.ix_(kept, kept)])

    def lambda_from_snr(self, snr: float) -> float:
        """Regularisation parameter lambda of a signal-to-noise ratio, root mean squares.

        The image is the MAP estimate for a prior of covariance s^2 R^-1 and noise of covariance
        n^2 I, with lambda = n / s. Under this prior signals have the covariance s^2 G, so the mean
        square signal of the M measurements is S^2 = s^2 trace(G) / M. With S / n = snr,
        lambda = sqrt(trace(G) / M) / snr.
        """
        if not snr > 0:
            raise ConfigurationError(
                f"expected a positive snr, got {snr!r}; take that of the frames"
            )
        return self._scale / min(snr, MAX_SNR)

    def lambda_from_noise_figure(self, noise_figure: float, response: Array) -> float:
        """Regularisation parameter lambda at which images have this noise figure.

        Args:
            noise_figure: figure of `noise_figure` [-]; 0.5 in GREIT (Adler et al. 2009).
            response: noise-free data of a small target in the middle (measurements,).

        Raises ConfigurationError, with the range of noise figures, for one that no lambda has.
        """

        def excess(exponent: float) -> float:
            figure = self.noise_figure(10.0**exponent * self._scale, response)
            return float(np.log(figure / noise_figure))

        # Noise figures fall as lambda grows, except for tiny ones: the last crossing counts.
        grid = np.arange(*_RANGE, 0.5)
        excesses = np.array([excess(each) for each in grid])
        crossings = np.flatnonzero((excesses[:-1] > 0.0) & (excesses[1:] <= 0.0))
        if not crossings.size:
            least, most = noise_figure * np.exp([excesses.min(), excesses.max()])
            raise ConfigurationError(
                f"expected a noise figure between {least:.3g} and {most:.3g} for this sensor and "
                f"method, got {noise_figure:g}; choose one in between"
            )
        last = crossings[-1]
        return float(10.0 ** brentq(excess, grid[last], grid[last + 1], xtol=1e-6)) * self._scale

    def noise_figure(self, regularisation: float, response: Array) -> float:
        """Noise figure of lambda: ratio of signal to noise in the data to that in the image.

        With white noise of unit variance in the data, NF = mean |y| / (mean |x| / s), where
        x = R y is the image of the response y, and s^2 = trace(R R^T) / P the mean variance of a
        pixel (Adler and Guardo 1996, in the form of Adler et al. 2009).
        """
        eigenvalues, vectors, spread = self._spectrum
        damped = 1.0 / (eigenvalues + regularisation**2)
        picture = spread @ (damped * (vectors.T @ response))
        variance = np.sum((spread * damped) ** 2) / len(spread)
        return float(np.mean(np.abs(response)) * np.sqrt(variance) / np.mean(np.abs(picture)))

    def lambda_from_gcv(self, data: ArrayLike) -> float:
        """Regularisation parameter lambda of least generalised cross-validation.

        The score (Golub, Heath and Wahba 1979) is |(I - A) y|^2 / trace(I - A)^2, summed over
        frames y (n, measurements), with A = G (G + lambda^2 I)^-1.
        """
        eigenvalues, vectors, _ = self._spectrum
        energy = np.sum((np.atleast_2d(np.asarray(data, dtype=float)) @ vectors) ** 2, axis=0)

        def score(exponent: float) -> float:
            filter_residual = 1.0 / (1.0 + eigenvalues / (10.0**exponent * self._scale) ** 2)
            return float(np.log(np.sum(filter_residual**2 * energy) / np.sum(filter_residual) ** 2))

        # The score may have several minima: the lowest of a coarse search is refined.
        grid = np.arange(-6.0, 3.0, 0.25)
        lowest = float(grid[np.argmin([score(each) for each in grid])])
        refined = minimize_scalar(score, bounds=(lowest - 0.25, lowest + 0.25), method="bounded")
        return float(10.0**refined.x) * self._scale

    def lambda_from_misfit(self, misfit: float, data: Array) -> float:
        """Regularisation parameter lambda whose image of `data` (measurements,) has this misfit.

        The misfit |y - J x| of a Gauss-Newton image rises with lambda from zero to |y|.
        """
        eigenvalues, vectors, _ = self._spectrum
        energy = (vectors.T @ data) ** 2

        def excess(exponent: float) -> float:
            filter_residual = 1.0 / (1.0 + eigenvalues / (10.0**exponent * self._scale) ** 2)
            return float(np.sqrt(np.sum(filter_residual**2 * energy)) - misfit)

        low, high = _RANGE
        if excess(low) >= 0.0:
            return float(10.0**low) * self._scale
        return float(10.0 ** brentq(excess, low, high, xtol=1e-6)) * self._scale

    @property
    def _scale(self) -> float:
        """Root mean square signal of the prior with s = 1."""
        return float(np.sqrt(np.trace(self.gram) / len(self.gram)))

    @cached_property
    def _spectrum(self) -> tuple[Array, Array, Array]:
        """Eigenvalues (M,) and eigenvectors (M, M) of G, and B times these (P, M)."""
        eigenvalues, vectors = np.linalg.eigh(self.gram)
        return np.maximum(eigenvalues, 0.0), vectors, self.back @ vectors


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


@old_names(named="from_text")
@dataclass(frozen=True, slots=True)
class Regularisation:
    """Rule for lambda, with its number.

    noise-figure: images lose this factor of signal to noise against the data; needs no frames
    (Adler and Guardo 1996; Graham and Adler 2006).
    snr: the MAP estimate for a signal-to-noise ratio of the frames.
    gcv: generalised cross-validation of the frames themselves; its number is not used.
    lambda: the parameter itself, for data as `Reconstructor.data` makes them.

    Attributes:
        rule: its name.
        value: its number, positive.

    Example:
        >>> from eitskin.training import Regularisation
        >>> Regularisation.from_text("snr:100").value
        100.0
    """

    rule: RuleName = "noise-figure"
    value: float = 1.0

    def __post_init__(self) -> None:
        if self.rule not in get_args(RuleName) or not LEAST <= self.value <= MOST:
            raise ConfigurationError(
                f"expected a rule for lambda of {', '.join(get_args(RuleName))} with a "
                f"number from {LEAST:g} to {MOST:g}, got {self.rule!r} with {self.value!r}"
            )

    @classmethod
    def from_text(cls, text: str) -> "Regularisation":
        """Rule of a text: `noise-figure:1`, `snr:100`, `gcv`, or `lambda:0.01`."""
        name, colon, number = text.partition(":")
        try:
            if name not in get_args(RuleName) or bool(colon) == (name == "gcv"):
                raise ValueError
            return cls(name, float(number) if colon else 1.0)  # type: ignore[arg-type]
        except ValueError as error:
            raise ConfigurationError(
                "expected a rule for lambda as noise-figure:1, snr:100, gcv or lambda:0.01, got "
                f"'{text}'"
            ) from error

    def choose(self, family: RegularisedInverse, response: Array, data: Array) -> float:
        """Regularisation parameter lambda for a family of reconstructions.

        Args:
            family: the reconstructions.
            response: noise-free data of a small target in the middle (measurements,).
            data: data of the frames, without missing channels (n, measurements).
        """
        if self.rule == "noise-figure":
            return family.lambda_from_noise_figure(self.value, response)
        if self.rule == "snr":
            return family.lambda_from_snr(self.value)
        return family.lambda_from_gcv(data) if self.rule == "gcv" else self.value
