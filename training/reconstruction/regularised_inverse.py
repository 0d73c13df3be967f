"""Methods of images, linear ones as families over the regularisation parameter, and its choice."""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import brentq, minimize_scalar
from scipy.sparse import csc_array, diags_array
from scipy.sparse.linalg import splu

from eitskin.bounds import LEAST, MOST
from eitskin.errors import ConfigurationError
from eitskin.extras import old_names
from eitskin.training.reconstruction.pixel_grid import PixelGrid

Array = NDArray[np.float64]
RuleName = Literal["noise-figure", "snr", "gcv", "lambda"]

_RANGE = (-9.0, 6.0)  # decades of lambda about the root mean square signal that are searched
PRIOR_FLOOR = 0.1  # least weight of a pixel in NOSER's prior, relative to the median pixel's
MAX_SNR = 1e4  # for noise-free data, whose step would otherwise be unregularised
Prior = Literal["tikhonov", "noser", "laplace"]

MAX_STEPS = 60  # of total variation
CONVERGENCE_TOLERANCE = 5e-4  # relative change of a picture that ends them
SMOOTHING = 1e-3  # gradient below which edges count as slopes, relative to the largest gradient
TARGET_SHARE = 0.25  # radius of a training target, relative to that of its desired image
EDGE = 0.25  # width of the soft edge of a desired image, relative to its radius


@dataclass(frozen=True, eq=False)
class RegularisedInverse:
    """Reconstruction matrices B (G + lambda^2 I)^-1 of every lambda, for white noise.

    One-step Gauss-Newton has this form with B = R^-1 J^T and G = J B (`gauss_newton`), GREIT with
    B = D Y^T and G = Y Y^T (`greit`).

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
