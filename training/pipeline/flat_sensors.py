"""Distribution of flat, untouched sensors of one design, by which a session's start is tested."""

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import fdtrc

from eitskin.datasets.store.dataset import Dataset
from eitskin.datasets.store.schema import State
from eitskin.training.method.observations import relative_difference
from eitskin.training.method.stored_fields import StoredField, StoredFields

Array = NDArray[np.float64]

MIN_SPECIMENS = 8
"""Fewer training specimens do not show how flat sensors differ."""
FALSE_ALARM = 5e-4
"""Probability of each of the two tests to doubt a flat, untouched sensor."""
BOARD_ERROR = 0.003
"""Least relative error of each path of a board: 0.4 % / sqrt 2."""
MIN_SHARE = 1e-4
"""Principal components with less than this share of the mean variance are not kept."""
FOLDS = 10
ANGLE_UNIT_DEG = 45.0
MIN_BENT = 10
"""Fewer bent frames give no bend curve."""


@dataclass(frozen=True, slots=True)
class Start:
    """Judgement of a session's start.

    Attributes:
        distance: squared Mahalanobis distance from the mean of flat sensors.
        chance: probability that a flat, untouched sensor is at least as unusual, 0 to 1.
        bend_deg: bend angle that explains the values best [deg]; NaN where no bend is known.
        deviation_deg: standard error of that angle [deg]; NaN where no bend is known.
        bend_chance: probability that a flat sensor looks bent as strongly; 1 where no bend is
            known.
    """

    distance: float
    chance: float
    bend_deg: float = math.nan
    deviation_deg: float = math.nan
    bend_chance: float = 1.0

    @property
    def doubt(self) -> str:
        """Reason why the sensor is not flat and untouched, in words; empty where it may be."""
        if self.bend_chance < FALSE_ALARM:
            return (
                f"the sensor does not look flat: a bend of {self.bend_deg:.0f} deg (standard error "
                f"{self.deviation_deg:.0f} deg) explains its values better"
            )
        if self.chance < FALSE_ALARM:
            return (
                "the sensor does not look flat and untouched: its values are unlike those of the "
                f"sensors that this pipeline knows (chance {self.chance:.0e})"
            )
        return ""


@dataclass(frozen=True, eq=False)
class FlatSensors(StoredFields):
    """Distribution of the log-impedances of flat, untouched sensors, learned from S specimens.

    Logarithms of magnitudes, less a factor common to all channels (conductivity, gain), are taken
    to be normal with unknown mean and covariance. The conjugate prior of the covariance is inverse
    Wishart with C + 2 degrees of freedom and the specimens' mean variance in each channel, so that
    few specimens give a wide distribution. The predictive distribution of a further sensor is a
    multivariate t (Gelman et al., Bayesian Data Analysis, 3rd ed., section 3.6), and its squared
    Mahalanobis distance over the number of degrees of freedom has an F distribution; so has the
    part of the distance that a bend explains (conditional distribution of the multivariate t). Few
    specimens seldom show all directions in which others differ; the covariance is inflated by the
    factor that cross-validation over the specimens calls for.

    Attributes:
        mean: logarithms less their mean over the channels (C,).
        components: principal components of the specimens' departures (k, C), each as long as the
            root of its sum of squares over the specimens.
        specimens: number S of specimens.
        bend: coefficients of the mean change of the logarithms with angle / 45 deg and its
            square (2, C); zeros where no bend is known.
        bend_range: least and greatest angle of the bend curve [deg]; both 0 without a curve.
        inflation: factor of the covariance, at least 1.
    """

    mean: Array
    components: Annotated[Array, StoredField(single=True)]
    specimens: int
    bend: Array
    bend_range: Annotated[tuple[float, float], StoredField("scalars")] = (0.0, 0.0)
    inflation: Annotated[float, StoredField("scalars")] = 1.0

    @classmethod
    def from_dataset(cls, dataset: Dataset) -> "FlatSensors | None":
        """Distribution of the specimens that occur in a dataset, with the bends of its frames."""
        rows = np.flatnonzero((dataset.state == State.BEND) & np.isfinite(dataset.bend_angle_deg))
        change = relative_difference(
            dataset.impedance[rows], dataset.reference[dataset.specimen[rows]]
        )
        change[dataset.status[rows] != 0] = np.nan
        good = np.isfinite(change).all(axis=1)
        angles = dataset.bend_angle_deg[rows][good].astype(float)
        flat = dataset.reference[np.unique(dataset.specimen)]
        return cls.fit(flat, angles, np.log1p(change[good]))

    @classmethod
    def fit(
        cls, flat: ArrayLike, angle_deg: ArrayLike = (), change: ArrayLike = ()
    ) -> "FlatSensors | None":
        """Distribution from flat specimens.

        Args:
            flat: impedances of S specimens (S, C) [ohm].
            angle_deg: bend angles of n untouched frames (n,) [deg].
            change: change of the logarithms in these frames from the flat sensor (n, C).

        Returns:
            None for fewer than `MIN_SPECIMENS` good ones, or where all are the same.
        """
        magnitudes = np.abs(np.asarray(flat)).astype(float)
        good = (np.isfinite(magnitudes) & (magnitudes > 0)).all(axis=1)
        if good.sum() < MIN_SPECIMENS or magnitudes.shape[1] < 2:
            return None
        logs = np.log(magnitudes[good])
        logs -= logs.mean(axis=1, keepdims=True)
        angles = np.asarray(angle_deg, dtype=float)
        curve, bend_range = np.zeros((2, logs.shape[1])), (0.0, 0.0)
        if len(angles) >= MIN_BENT:
            curve = np.linalg.lstsq(_powers(angles), np.asarray(change, dtype=float), rcond=None)[0]
            bend_range = (min(float(angles.min()), 0.0), max(float(angles.max()), 0.0))
        if not np.ptp(logs, axis=0).any():
            return None
        fitted = cls(*_moments(logs), len(logs), curve, bend_range)
        return replace(fitted, inflation=_cross_validated(fitted, logs))

    def for_sensor(self, flat: Array) -> "FlatSensors":
        """Distribution of one sensor's values from session to session.

        They are taken to scatter about those of a known session as those of different sensors do:
        more than they do, so that none of them is doubted for contacts of its own.

        Args:
            flat: its magnitudes, flat and untouched (C,) [ohm]; NaN where unknown.
        """
        valid = np.isfinite(flat) & (flat > 0)
        logs = np.log(np.where(valid, flat, 1.0))
        departure = logs - np.mean(logs[valid] - self.mean[valid])
        return replace(self, mean=np.where(valid, departure, self.mean))

    @property
    def freedom(self) -> int:
        """Degrees of freedom of the predictive distribution."""
        return self.specimens + 2

    @cached_property
    def covariance(self) -> Array:
        """Scale matrix of the predictive distribution of a further sensor (C, C).

        Its eigenvalues are at least the variance of a board's paths.
        """
        scatter = self.components.T @ self.components
        variance = np.trace(scatter) / ((self.specimens - 1) * len(scatter))
        share = self.inflation * (1.0 + 1.0 / self.specimens) / self.freedom
        values, vectors = np.linalg.eigh(share * (scatter + variance * np.eye(len(scatter))))
        covariance: Array = (vectors * np.maximum(values, BOARD_ERROR**2)) @ vectors.T
        return covariance

    @cached_property
    def _precision(self) -> Array:
        """Inverse of the covariance of all channels, blind to their common factor."""
        return _blind_inverse(self.covariance)

    def judge(self, impedance: ArrayLike) -> Start:
        """Judgement of a sensor that is stated to be flat and untouched.

        Args:
            impedance: (C,) [ohm]; NaN where a channel is bad.
        """
        magnitudes = np.abs(np.asarray(impedance))
        good_channels = np.flatnonzero(np.isfinite(magnitudes) & (magnitudes > 0))
        count = len(good_channels) - 1  # the common factor is unknown
        if count < 2:
            return Start(0.0, 1.0)
        whole = len(good_channels) == len(self.mean)
        part = np.ix_(good_channels, good_channels)
        precision = self._precision if whole else _blind_inverse(self.covariance[part])
        departure = np.log(magnitudes[good_channels]) - self.mean[good_channels]
        distance = float(departure @ precision @ departure)
        chance = float(fdtrc(count, self.freedom, distance / count))
        low, high = self.bend_range
        if low == high:
            return Start(distance, chance)
        angles = np.linspace(low, high, round(high - low) + 1)
        rest = departure - _powers(angles) @ self.bend[:, good_channels]
        left = np.sum((rest @ precision) * rest, axis=1)
        best = int(left.argmin())
        slopes = np.array([1.0, 2.0 * angles[best] / ANGLE_UNIT_DEG]) / ANGLE_UNIT_DEG
        slope = slopes @ self.bend[:, good_channels]
        deviation = float(1.0 / np.sqrt(slope @ precision @ slope))
        freedom = self.freedom + count - 1
        gain = max(distance - float(left[best]), 0.0) * freedom / (self.freedom + left[best])
        bend_chance = float(fdtrc(1, freedom, gain))
        return Start(distance, chance, float(angles[best]), deviation, bend_chance)


def _moments(logs: Array) -> tuple[Array, Array]:
    """Mean and principal components of logarithms (S, C), as the attributes."""
    mean = logs.mean(axis=0)
    _, lengths, directions = np.linalg.svd(logs - mean, full_matrices=False)
    significant = lengths**2 > MIN_SHARE * np.sum(lengths**2) / len(mean)
    return mean, lengths[significant, None] * directions[significant]


def _cross_validated(fitted: FlatSensors, logs: Array) -> float:
    """Factor of the covariance by which specimens that were left out are as far as expected."""
    folds = np.arange(len(logs)) % min(FOLDS, len(logs))
    ratios = []
    for fold in range(folds.max() + 1):
        training_logs = logs[folds != fold]
        mean, components = _moments(training_logs)
        without = replace(
            fitted, mean=mean, components=components, specimens=len(training_logs), inflation=1.0
        )
        for start in map(without.judge, np.exp(logs[folds == fold])):
            bend = (
                1.0 if math.isnan(start.bend_deg) else (start.bend_deg / start.deviation_deg) ** 2
            )
            ratios.append((start.distance / (logs.shape[1] - 1), bend))
    return float(max(1.0, *np.mean(ratios, axis=0)))


def _blind_inverse(covariance: Array) -> Array:
    """Inverse of a covariance (C, C), blind to a factor common to all channels."""
    precision = np.linalg.inv(covariance)
    total = precision.sum(axis=1)
    blind: Array = precision - np.outer(total, total) / total.sum()
    return blind


def _powers(angle_deg: Array) -> Array:
    """First and second power of angles in units of 45 deg (n, 2)."""
    t = angle_deg / ANGLE_UNIT_DEG
    return np.column_stack([t, t**2])
