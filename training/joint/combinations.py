"""Combinations of measurements: the few that carry touches and bends, of however many measured.

Reciprocal measurements show the same, and hundreds of measurements of one sensor have far fewer
independent changes. Training and fit work with combinations, at the cost of as many channels.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eitskin.training.method.input_spec import Mirror
from eitskin.training.method.stored_fields import StoredFields

Array = NDArray[np.float64]

MAX_SHARE = 0.5
"""Share of the measurements beyond which combinations save too little to be made."""
LEFT_OUT = 1e8
"""Variance of a combination that no measurement shows, in units of its variance where all do."""

# features of responses and curves; each costs weights that the specimens must determine
RESPONSE_FEATURES = 8
ANGLE_FEATURES = 20  # that networks of the angle are reported
CLIP_SIGMA = 5.0  # standard deviations of the training specimens


@dataclass(frozen=True, eq=False)
class Combinations:
    """K combinations y of the changes of log V in C measurements.

        change = D B y + noise,   y = B^T D^-1 change,   D = diag(noise)

    With orthonormal columns B that span the changes by touches, bends and drift, y is a sufficient
    statistic: what is left of the change is noise, which shows nothing of them.

    Attributes:
        noise: standard deviation of log V of each measurement in one frame (C,).
        basis: B (C, K); None where every measurement is a combination on its own, in its own unit.
    """

    noise: Array
    basis: Array | None = None

    @classmethod
    def fit(cls, changes: Sequence[tuple[Array, float]], noise: Array) -> "Combinations":
        """Principal components of changes that exceed what noise alone would give.

        The largest eigenvalue of the covariance of white noise in n frames is (1 + sqrt(C / n))^2
        times its variance (Marchenko and Pastur 1967); larger ones are signals. The drift common to
        all measurements counts as a signal.

        Args:
            changes: changes of log V (n, C) in frames of one kind each, and the variance of their
                noise in units of that of one frame.
            noise: standard deviation of log V of each measurement in one frame (C,).
        """
        size = len(noise)
        covariance, limit = np.zeros((size, size)), 0.0
        for change, variance in changes:
            white = change / noise
            covariance += white.T @ white / len(white)
            limit += variance * (1.0 + np.sqrt(size / len(white))) ** 2
        values, vectors = np.linalg.eigh(covariance)
        signals = vectors[:, values > limit][:, ::-1]
        basis = np.linalg.qr(np.column_stack([signals, 1.0 / noise]))[0]
        return cls(noise, basis if basis.shape[1] <= MAX_SHARE * size else None)

    def __len__(self) -> int:
        """Number of combinations K."""
        return len(self.back)

    @cached_property
    def unit(self) -> Array:
        """Standard deviation of each combination in one frame (K,)."""
        return self.noise if self.basis is None else np.ones(len(self))

    @cached_property
    def forward(self) -> Array:
        """Matrix (C, K) by which changes of log V (..., C) become combinations (..., K)."""
        if self.basis is None:
            return np.eye(len(self.noise))
        return np.ascontiguousarray(self.basis / self.noise[:, None])

    @cached_property
    def back(self) -> Array:
        """Matrix (K, C) by which combinations (..., K) become changes of log V (..., C)."""
        if self.basis is None:
            return np.eye(len(self.noise))
        return np.ascontiguousarray((self.basis * self.noise[:, None]).T)

    @cached_property
    def drift(self) -> Array:
        """Each combination of a change by one in all measurements (K,)."""
        drift: Array = self.forward.sum(axis=0)
        return drift

    @cached_property
    def lateness(self) -> Array:
        """Weights (K, K) of the times at which a frame's measurements are taken, -0.5 to 0.5."""
        count = len(self.noise)
        late: Array = self.forward.T * (np.arange(count) / count - 0.5) @ self.back.T
        return late

    def combine(self, change: Array, frames: float, drift: float) -> "CombinedChange":
        """Combinations of one frame and their noise.

        Args:
            change: change of log V (C,), NaN where a measurement is bad.
            frames: sum of the reciprocal numbers of frames in both means that are compared.
            drift: variance of the change common to all measurements.
        """
        good = np.isfinite(change)
        return CombinedChange(self, np.where(good, change, 0.0), good, frames, drift)

    def restrict(self, good: NDArray[np.bool_]) -> tuple[Array, Array]:
        """Combinations where only the measurements `good` (C,) are known.

        They are the least-squares estimate. A combination that these do not show is zero, with the
        variance `LEFT_OUT`.

        Returns:
            matrix (K, C) from changes to combinations.
            covariance (K, K) of their noise in one frame.
        """
        if self.basis is None:
            alone = np.where(good, 1.0, LEFT_OUT) * self.noise**2
            return np.diag(good.astype(float)), np.diag(alone)
        good_basis = self.basis * good[:, None]
        information = good_basis.T @ good_basis + np.eye(len(self)) / LEFT_OUT
        covariance = np.linalg.inv(information)
        covariance = 0.5 * (covariance + covariance.T)
        return covariance @ (good_basis / self.noise[:, None]).T, covariance


@dataclass(frozen=True, eq=False)
class CombinedChange:
    """Combinations of the measured change of log V in one frame, with their noise.

    Attributes:
        combinations: combinations of the measurements.
        measured: change of log V (C,), zero where a measurement is left out.
        good: whether each measurement counts (C,).
        frames: sum of the reciprocal numbers of frames in both means that are compared.
        drift: variance of the change common to all measurements.
        further: covariance (K, K) of further noise, if any.
    """

    combinations: Combinations
    measured: Array
    good: NDArray[np.bool_]
    frames: float
    drift: float
    further: Array | None = None

    @cached_property
    def count(self) -> int:
        """Number of measurements that count."""
        return int(np.count_nonzero(self.good))

    @property
    def rank(self) -> int:
        """Number of combinations that they show at most."""
        return min(self.count, len(self.combinations))

    def drop(self, measurements: Sequence[int]) -> "CombinedChange":
        """The change with further measurements left out."""
        measured, good = self.measured.copy(), self.good.copy()
        measured[list(measurements)], good[list(measurements)] = 0.0, False
        return replace(self, measured=measured, good=good)

    @cached_property
    def _observed_matrices(self) -> tuple[Array, Array]:
        """Matrix (K, C) to combinations, and the covariance (K, K) of their noise in one frame."""
        if not self.good.all():
            return self.combinations.restrict(self.good)
        return self.combinations.forward.T, np.diag(self.combinations.unit**2)

    @cached_property
    def change(self) -> Array:
        """Combinations of the change (K,)."""
        return self.project_observed(self.measured)

    @cached_property
    def noise(self) -> Array:
        """Covariance of their noise (K, K)."""
        drift = self.combinations.drift
        noise: Array = (self.drift * drift)[
            :, None
        ] * drift + self.frames * self._observed_matrices[1]
        return noise if self.further is None else noise + self.further

    def project_observed(self, changes: Array) -> Array:
        """Combinations (K, ...) of changes (C, ...), from the measurements that count."""
        observed: Array = self._observed_matrices[0] @ changes
        return observed

    def remainder(self, changes: Array) -> Array:
        """Part of changes (C, n) that no combination has, in units of the noise (C, n).

        Zero in measurements that are left out.
        """
        combinations = self.combinations
        remainder = changes - combinations.back.T @ self.project_observed(changes)
        share: Array = remainder * (self.good / combinations.noise)[:, None]
        return share

    @cached_property
    def rest(self) -> Array:
        """`remainder` of the measured change (C,)."""
        return self.remainder(self.measured[:, None])[:, 0]


def log_change(difference: Array) -> Array:
    """log(V / ref) from dV (C,); NaN for a measurement that is bad or has no logarithm."""
    with np.errstate(divide="ignore", invalid="ignore"):
        change = np.log1p(difference)
    return np.where(np.isfinite(change), change, np.nan)


@dataclass(frozen=True, slots=True, eq=False)
class SpecimenFeatures(StoredFields):
    """Linear features of the logarithms of the flat resistances, without their common factor.

    The common factor holds conductivity, thickness and the board's gain, none of which alters
    relative changes. The features describe contacts and positions of the electrodes and the errors
    of signal paths.

    Attributes:
        middle: mean logarithms of the flat magnitudes, less their common factor (C,).
        directions: principal directions of the specimens' departures, each divided by the standard
            deviation along it, so that features have unit variance (P, C).
    """

    middle: Array
    directions: Array

    @classmethod
    def fit(
        cls, flat: ArrayLike, mirrors: Sequence[Mirror], count: int = ANGLE_FEATURES
    ) -> "SpecimenFeatures":
        """Principal component analysis of specimens and their mirror images.

        Args:
            flat: magnitudes of S specimens, flat and untouched (S, C) [ohm].
            mirrors: symmetries of the sensor.
            count: most features; there is at most one for five specimens.
        """
        logs = _without_common(np.log(np.asarray(flat, dtype=float)))
        images = np.concatenate([logs[:, mirror.order] for mirror in mirrors])
        middle = images.mean(axis=0)
        _, sizes, directions = np.linalg.svd(images - middle, full_matrices=False)
        deviations = sizes / np.sqrt(max(len(images), 1))
        feature_count = min(count, len(logs) // 5, int(np.sum(deviations > 1e-9)))
        return cls(middle, directions[:feature_count] / deviations[:feature_count, None])

    def first(self, count: int = RESPONSE_FEATURES) -> "SpecimenFeatures":
        """The features along which specimens differ most, `count` of them."""
        return SpecimenFeatures(self.middle, self.directions[:count])

    def apply(self, flat: ArrayLike) -> Array:
        """Features (..., P) of flat magnitudes (..., C) [ohm]; bad channels (NaN) are ignored."""
        departure = _without_common(np.log(np.asarray(flat, dtype=float)) - self.middle)
        return np.where(np.isfinite(departure), departure, 0.0) @ self.directions.T

    def clip(self, flat: ArrayLike) -> Array:
        """Features (..., P), each at most `CLIP_SIGMA` standard deviations from the middle.

        Bend curves are linear in the features and networks smooth, so far outside of the training
        specimens both are wrong without a sign of it; at the bound they are merely of another
        specimen, as their standard errors show.
        """
        return np.clip(self.apply(flat), -CLIP_SIGMA, CLIP_SIGMA)


def _without_common(logs: Array) -> Array:
    """Logarithms (..., C) minus their mean over the channels."""
    good = np.isfinite(logs)
    total = np.where(good, logs, 0.0).sum(axis=-1, keepdims=True)
    departure: Array = logs - total / np.maximum(good.sum(axis=-1, keepdims=True), 1)
    return departure
