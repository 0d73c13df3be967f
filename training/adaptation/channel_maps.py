"""Gaussian-process maps of all channels over the sheet, with one covariance between channels."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any, TypeVar, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import interpn
from scipy.linalg import eigh, solve_triangular

Array = NDArray[np.float64]
Rows = TypeVar("Rows", bound=Any)  # a dataclass of arrays

MAX_PLACES = 400  # of a kernel's features; smooth maps over a sheet need no more
DROPPED_VARIANCE_SHARE = 1e-6  # share of the prior variance that features may leave out
ITERATIONS = 20
BLOCK = 1000  # presses whose features are held at once


@dataclass(frozen=True, slots=True, eq=False)
class DesignSpan:
    """Span of the sensitivity maps that a design allows, whatever the instrument does.

    To first order the response of every channel to a small change of conductivity at p is
    sum_jk w_jk grad u_j . grad u_k (p), where u_j is the potential for a current into electrode j
    (Geselowitz 1971): a linear network of loads and leaks at the electrodes changes the weights w
    alone. Independent weights of equal variance give the covariance
    sum_jk (grad u_j . grad u_k)(p) (grad u_j . grad u_k)(p').

    Attributes:
        maps: maps of pairs of electrodes, (pairs, rows, columns), rows along y; rms one over the
            sheet.
        size: size of the bounding box, along x and y (2,) [m].
    """

    maps: Array
    size: Array

    def features(self, places: ArrayLike) -> Array:
        """Maps at places (n, 2) [m], linear between the pixels, (n, pairs)."""
        _, rows, columns = self.maps.shape
        at = np.asarray(places, dtype=float) / self.size * [columns, rows] - 0.5
        at = np.clip(at, 0.0, [columns - 1.0, rows - 1.0])[:, ::-1]
        axes = np.arange(rows), np.arange(columns)
        features: Array = interpn(axes, np.moveaxis(self.maps, 0, -1), at)
        return features


@dataclass(frozen=True, slots=True, eq=False)
class PlaceKernel:
    """Matern 5/2 covariance of two places, mixed with the covariance of a design's span.

    Attributes:
        length: length scale [m].
        span: span of the design; None for the plain kernel.
        share: share of the span in the variance, 0 to 1.
    """

    length: float
    span: DesignSpan | None = None
    share: float = 0.0

    def __call__(self, first: ArrayLike, second: ArrayLike) -> Array:
        """Covariances (n, m) of places (n, 2) and (m, 2) [m]."""
        covariance: Array = self.covariance(self.describe(first), self.describe(second))
        return covariance

    def describe(self, places: ArrayLike) -> tuple[Array, Array]:
        """Places (n, 2) [m], and the span's maps there (n, pairs); none without a share."""
        points = np.asarray(places, dtype=float)
        if self.span is None or self.share == 0.0:
            return points, np.zeros((len(points), 0))
        return points, self.span.features(points)

    def covariance(self, first: tuple[Array, Array], second: tuple[Array, Array]) -> Array:
        """Covariances (n, m) of places that `describe` described."""
        (a, span_a), (b, span_b) = first, second
        square = np.sum(a**2, axis=1)[:, None] + np.sum(b**2, axis=1) - 2.0 * a @ b.T
        d = np.sqrt(5.0 * np.maximum(square, 0.0)) / self.length
        covariance: Array = (1.0 - self.share) * (1.0 + d + d**2 / 3.0) * np.exp(-d)
        return covariance + self.share * span_a @ span_b.T

    def variance(self, places: ArrayLike) -> Array:
        """Variances (n,) at places (n, 2) [m]."""
        _, span = self.describe(places)
        variance: Array = 1.0 - self.share + self.share * np.sum(span**2, axis=1)
        return variance


@dataclass(frozen=True, slots=True, eq=False)
class KernelFeatures:
    """Features phi with phi(p) . phi(p') = k(p, p'), exact at the chosen places.

    Attributes:
        kernel: the covariance.
        chosen: places that carry the features (m, 2) [m].
        factor: lower Cholesky factor of their covariance (m, m).
    """

    kernel: PlaceKernel
    chosen: Array
    factor: Array

    @classmethod
    def choose(cls, kernel: PlaceKernel, places: ArrayLike) -> "KernelFeatures":
        """Choose places by a pivoted Cholesky factorisation (Harbrecht et al. 2012).

        Each step takes the place whose variance is explained worst, until `DROPPED_VARIANCE_SHARE`
        of the sum is left or `MAX_PLACES` are chosen: memory is bounded however many places there
        are.
        """
        points = np.asarray(places, dtype=float)
        left, described = kernel.variance(points), kernel.describe(points)
        total, rows = float(left.sum()), np.zeros((min(MAX_PLACES, len(points)), len(points)))
        chosen: list[int] = []
        for step in range(len(rows)):
            best = int(np.argmax(left))
            if left.sum() <= DROPPED_VARIANCE_SHARE * total or left[best] <= 1e-9 * total / len(
                points
            ):
                break
            own = (described[0][best : best + 1], described[1][best : best + 1])
            row = kernel.covariance(own, described)[0] - rows[:step, best] @ rows[:step]
            rows[step] = row / np.sqrt(left[best])
            left = np.maximum(left - rows[step] ** 2, 0.0)
            left[best] = 0.0
            chosen.append(best)
        return cls(kernel, points[chosen], np.tril(rows[: len(chosen), chosen].T))

    def __call__(self, places: ArrayLike) -> Array:
        """Features (n, m) of places (n, 2) [m]."""
        covariance = self.kernel(self.chosen, places)
        features: Array = solve_triangular(self.factor, covariance, lower=True).T
        return features


@dataclass(frozen=True, slots=True, eq=False)
class Presses:
    """Labelled presses: what maps are learned from.

    Attributes:
        places: (n, 2) [m].
        strength: relative strength s of each press (n,); a channel answers in proportion to it.
        answers: answers of the channels, of order one (n, C).
        weight: weight of each press in the fit (n,); the noise variance of a press is divided by
            it.
        owner: number of the recorded press that each came from (n,).
    """

    places: Array
    strength: Array
    answers: Array
    weight: Array
    owner: NDArray[np.int64]

    @classmethod
    def from_frames(
        cls,
        places: ArrayLike,
        strength: ArrayLike,
        answers: ArrayLike,
        owner: NDArray[np.int64] | None = None,
    ) -> "Presses":
        """Recorded frames of weight one, each a press of its own unless `owner` says otherwise."""
        n = len(np.asarray(strength))
        return cls(
            np.asarray(places, dtype=float),
            np.asarray(strength, dtype=float),
            np.asarray(answers, dtype=float),
            np.ones(n),
            np.arange(n) if owner is None else owner,
        )

    @property
    def unit_scale(self) -> Array:
        """Root mean square answer of each channel at strength one (C,); one where it has none."""
        scale = np.sqrt(np.mean((self.answers / self.strength[:, None]) ** 2, axis=0))
        return np.where(scale > 0.0, scale, 1.0)

    @property
    def owners(self) -> NDArray[np.int64]:
        """Numbers of the recorded presses, each once."""
        return np.unique(self.owner)

    def select(self, which: NDArray[np.bool_] | NDArray[np.int64]) -> "Presses":
        """Some of the presses, which keep their owners' numbers."""
        return Presses(*(getattr(self, field.name)[which] for field in fields(self)))


def concatenate(parts: Sequence[Rows]) -> Rows:
    """Rows of all parts, dataclasses of arrays (n, ...) each."""
    names = [field.name for field in fields(parts[0])]
    joined = type(parts[0])(*(np.concatenate([getattr(p, n) for p in parts]) for n in names))
    return cast("Rows", joined)


@dataclass(frozen=True, slots=True, eq=False)
class ChannelMaps:
    """Maps f of all channels: answers y = s f(p) + noise, y and f of C channels.

    f(p) = W' phi(p), with rows of W independent and of covariance `signal` between channels, and
    noise of covariance `noise` between channels, both learned from the presses.

    The whitening Z brings both covariances to diagonal form, Z' noise Z = 1 and
    Z' signal Z = diag(gain): the channels become independent Gaussian processes of noise one
    (Rakitsch et al. 2013).

    Attributes:
        features: phi.
        whitening: Z (C, C).
        gain: variances of the independent maps (C,), in units of the noise.
        basis: eigenvectors of the presses' features (m, m).
        values: their eigenvalues (m,).
        weights: posterior mean of W for the independent maps, in that basis (m, C).
    """

    features: KernelFeatures
    whitening: Array
    gain: Array
    basis: Array
    values: Array
    weights: Array

    @classmethod
    def fit(
        cls, kernel: PlaceKernel, presses: Presses, noise: float, weight: float = 1.0
    ) -> "ChannelMaps":
        """Learn the channels' covariances by expectation maximisation, then the maps.

        Args:
            kernel: prior covariance over the sheet.
            presses: touches to learn from.
            noise: prior guess of the noise variance, in units of the answers' variance.
            weight: weight of this guess, and of the guess 1 of the signal, in presses per channel.
        """
        features = KernelFeatures.choose(kernel, presses.places)
        values, basis, answers, residual = _normal_equations(features, presses)
        w, (m, channels) = values[:, None], answers.shape
        # Directions beyond those of fewer presses than channels are all alike: one stands for them.
        turned = np.eye(channels)
        if (rank := min(len(presses.strength), channels)) < channels:
            turned = np.linalg.qr(presses.answers.T, mode="complete")[0]
        seen_in = turned[:, : rank + 1]
        answers, residual = answers @ seen_in, seen_in.T @ residual @ seen_in
        prior, prior_signal = weight * channels, np.eye(answers.shape[1])
        prior_noise = noise * prior_signal
        gain, whitening = _diagonalise(prior_signal, prior_noise)
        signal, error = prior_signal, prior_noise
        for _ in range(ITERATIONS):
            back = np.linalg.inv(whitening)
            whitened = answers @ whitening
            variance = w * gain / (w * gain + 1.0)
            mean = variance * whitened
            maps = (mean / w).T @ mean + np.diag(np.sum(variance / w, axis=0))
            off = whitened - mean
            errors = (
                off.T @ off + np.diag(np.sum(variance, axis=0)) + whitening.T @ residual @ whitening
            )
            signal = (back.T @ maps @ back + prior * prior_signal) / (m + prior)
            count = len(presses.strength) + prior
            error = (back.T @ errors @ back + prior * prior_noise) / count
            gain, whitening = _diagonalise(0.5 * (signal + signal.T), 0.5 * (error + error.T))
        weights = gain * np.sqrt(w) * (answers @ whitening) / (gain * w + 1.0)
        others = turned[:, rank + 1 :] / np.sqrt(error[-1, -1])
        alike = np.full(others.shape[1], signal[-1, -1] / error[-1, -1])
        return cls(
            features,
            np.hstack([seen_in @ whitening, others]),
            np.concatenate([gain, alike]),
            basis,
            values,
            np.hstack([weights, np.zeros((m, len(alike)))]),
        )

    def evaluate(self, places: ArrayLike) -> tuple[Array, Array]:
        """Mean and variance (n, C) each of the independent maps at places (n, 2) [m]."""
        phi = self.features(places)
        turned, gain = phi @ self.basis, self.gain
        variance_factor = (turned**2) @ (gain / (gain * self.values[:, None] + 1.0))
        missing = np.maximum(self.features.kernel.variance(places) - np.sum(phi**2, axis=1), 0.0)
        return turned @ self.weights, variance_factor + missing[:, None] * gain

    def left_out(self, presses: Presses) -> tuple[Array, Array]:
        """Mean and variance of the independent answers of each press, it left out of the fit.

        Presses of one owner are left out together; those of weight one are described. In closed
        form from the leverages (Rasmussen and Williams 2006, section 5.4.2), (k, C) each.
        """
        root = np.sqrt(presses.weight)[:, None]
        phi = self.features(presses.places) * presses.strength[:, None] * root @ self.basis
        whitened = presses.answers * root @ self.whitening
        residual = whitened - phi @ self.weights
        gain = self.gain
        shrunk = gain / (gain * self.values[:, None] + 1.0)
        own = np.flatnonzero(presses.weight == 1.0)
        mean, variance = np.empty((2, len(own), len(gain)))
        for row, press in enumerate(own):
            group = np.flatnonzero(presses.owner == presses.owner[press])
            part = phi[group]
            leverage = np.einsum("am,mc,bm->cab", part, shrunk, part, optimize=True)
            inverse = np.linalg.inv(np.eye(len(group)) - leverage)
            at = int(np.flatnonzero(group == press)[0])
            off = np.einsum("cb,bc->c", inverse[:, at], residual[group])
            mean[row], variance[row] = whitened[press] - off, inverse[:, at, at]
        return mean, variance

    def log_density(self, presses: Presses) -> Array:
        """Log predictive density of the answers of other presses (n,)."""
        mean, variance = self.evaluate(presses.places)
        s = presses.strength[:, None]
        off = presses.answers @ self.whitening - s * mean
        return self._density(off, s**2 * variance + 1.0)

    def _density(self, deviations: Array, variance: Array) -> Array:
        """Log density of deviations (n, C) of independent answers, in the channels' unit (n,)."""
        density = -0.5 * np.sum(deviations**2 / variance + np.log(2.0 * np.pi * variance), axis=1)
        return np.asarray(density + np.linalg.slogdet(self.whitening)[1], dtype=np.float64)

    def left_out_density(self, presses: Presses) -> Array:
        """Log predictive density of each press of weight one, it left out of the fit (k,)."""
        mean, variance = self.left_out(presses)
        own = presses.weight == 1.0
        return self._density(presses.answers[own] @ self.whitening - mean, variance)


def _diagonalise(signal: Array, noise: Array) -> tuple[Array, Array]:
    """Gain (C,) and whitening (C, C) by the generalised eigenvalues of both covariances (C, C)."""
    gain, whitening = eigh(signal, noise)
    return np.maximum(gain, 0.0), np.ascontiguousarray(whitening)


def _normal_equations(
    features: KernelFeatures, presses: Presses
) -> tuple[Array, Array, Array, Array]:
    """Normal equations of presses in the eigenbasis of their features, summed block by block.

    Returns:
        values: eigenvalues w of sum weight s^2 phi phi' (m,).
        basis: their eigenvectors V (m, m).
        answers: w^-1/2 V' sum weight s phi y' (m, C).
        rest: scatter of what no map explains (C, C).
    """
    m, channels = len(features.chosen), presses.answers.shape[1]
    gram, moment = np.zeros((m, m)), np.zeros((m, channels))
    scatter = np.zeros((channels, channels))
    for begin in range(0, len(presses.strength), BLOCK):
        part = presses.select(np.arange(begin, min(begin + BLOCK, len(presses.strength))))
        root = np.sqrt(part.weight)[:, None]
        phi = features(part.places) * part.strength[:, None] * root
        y = part.answers * root
        gram, moment, scatter = gram + phi.T @ phi, moment + phi.T @ y, scatter + y.T @ y
    values, basis = eigh(gram)
    values = np.maximum(values, 1e-9 * values[-1])
    answers = (basis.T @ moment) / np.sqrt(values)[:, None]
    return values, basis, answers, scatter - answers.T @ answers
