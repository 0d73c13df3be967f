"""What bending does to log V: a curve through zero, of which every specimen has its own."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import cho_factor, cho_solve

Array = NDArray[np.float64]

MEAN_POWERS = 5  # of the angle, in the curve of the middle specimen
OWN_POWERS = 3  # of the angle, in what a specimen has of its own
SCALE = 50.0  # deg, the unit of the angle in those powers
ROUNDS = 15  # of expectation and maximisation

# u^1 u^2 ... of the value, and of the slope u^0 2u^1 ... over the unit of the angle
_EXPONENTS = np.arange(1.0, MEAN_POWERS + 1) - [[0.0], [1.0]]
_FACTORS = np.array([np.ones(MEAN_POWERS), np.arange(1, MEAN_POWERS + 1) / SCALE])


@dataclass(frozen=True, slots=True, eq=False)
class BendCurve:
    """log V(angle) - log V(0) of specimens: what is known of the curve, and how well.

        B(u) = sum_k u^k b_k + sum_j u^j w_j,   u = angle / 50 deg,   w ~ N(0, covariance)

    Attributes:
        mean: b_k (MEAN_POWERS, C).
        own: expected w (OWN_POWERS, C); zero before a calibration.
        covariance: of w (OWN_POWERS C, OWN_POWERS C).
        angle_deg: smallest and largest angle that it was learned from [deg].
    """

    mean: Array
    own: Array
    covariance: Array
    angle_deg: tuple[float, float]
    _whole: Array = field(init=False, repr=False)  # b_k + w_k (MEAN_POWERS, C)
    _blocks: Array = field(init=False, repr=False)  # covariances of w_j, w_k (OWN_POWERS^2, C^2)

    def __post_init__(self) -> None:
        """Arrange what every frame needs."""
        whole, channels = self.mean.copy(), self.mean.shape[1]
        whole[:OWN_POWERS] += self.own
        powers = self.covariance.reshape(OWN_POWERS, channels, OWN_POWERS, channels)
        blocks = powers.transpose(0, 2, 1, 3).reshape(OWN_POWERS**2, channels**2)
        object.__setattr__(self, "_whole", whole)
        object.__setattr__(self, "_blocks", blocks)

    def arrays(self) -> dict[str, Array]:
        """What `from_arrays` needs to make this again."""
        ends = np.array(self.angle_deg)
        return {
            "mean": self.mean,
            "own": self.own,
            "covariance": self.covariance,
            "angle_deg": ends,
        }

    @classmethod
    def from_arrays(cls, arrays: dict[str, NDArray[np.generic]]) -> "BendCurve":
        """The curve that `arrays` came from."""
        values = {name: array.astype(float) for name, array in arrays.items()}
        low, high = values["angle_deg"].tolist()
        return cls(values["mean"], values["own"], values["covariance"], (low, high))

    def value(self, angle_deg: ArrayLike) -> Array:
        """(..., C) at angles (...) [deg]."""
        u = np.asarray(angle_deg, dtype=float)[..., None] / SCALE
        value: Array = _powers(u, MEAN_POWERS) @ self._whole
        return value

    def grid(self, count: int) -> tuple[Array, Array]:
        """Angles (count,) [deg] over what was learned from, and the values there (count, C)."""
        angles, powers = _grid(*self.angle_deg, count)
        return angles, powers @ self._whole

    def slope(self, angle_deg: float) -> Array:
        """Its derivative (C,) [1/deg]."""
        _, slope = self.tangent(angle_deg)
        return slope

    def tangent(self, angle_deg: float) -> tuple[Array, Array]:
        """Value, and slope [1/deg], at one angle, (C,) each."""
        value, slope = (_FACTORS * (angle_deg / SCALE) ** _EXPONENTS) @ self._whole
        return value, slope

    def uncertainty(self, angle_deg: float, reference_deg: float = 0.0) -> Array:
        """Covariance (C, C) of B(angle) - B(reference), from not knowing w."""
        u, reference, channels = angle_deg / SCALE, reference_deg / SCALE, self.mean.shape[1]
        weights = np.array([u**k - reference**k for k in range(1, OWN_POWERS + 1)])
        covariance: Array = (weights[:, None] * weights).reshape(-1) @ self._blocks
        return covariance.reshape(channels, channels)

    def conditioned(self, angle_deg: Array, change: Array, noise: Array) -> "BendCurve":
        """The curve given changes of log V (n, C) at known angles (n,), by Bayes' rule.

        Args:
            angle_deg: (n,) [deg].
            change: of log V from the flat sensor (n, C); NaN where a measurement is bad.
            noise: covariance (n C, n C) of all changes together, or (C, C) of each alone.
        """
        count, channels = change.shape
        if noise.shape == (channels, channels):
            noise = np.asarray(np.kron(np.eye(count), noise), dtype=float)
        weights = np.kron(_powers(angle_deg[:, None] / SCALE, OWN_POWERS), np.eye(channels))
        residual = (change - self.value(angle_deg)).ravel()
        good = np.isfinite(residual)
        weights, residual = weights[good], residual[good]
        system = weights @ self.covariance @ weights.T + noise[np.ix_(good, good)]
        gain = cho_solve(cho_factor(system), weights @ self.covariance).T
        own = self.own + (gain @ residual).reshape(self.own.shape)
        covariance = self.covariance - gain @ weights @ self.covariance
        return BendCurve(self.mean, own, 0.5 * (covariance + covariance.T), self.angle_deg)


@dataclass(frozen=True, slots=True, eq=False)
class BendCurves:
    """Curves of all specimens of a design: the middle one, and how others depart from it.

    Attributes:
        mean: (1 + P, MEAN_POWERS, C): of the middle specimen, then for each feature.
        covariance: of what features do not tell (OWN_POWERS C, OWN_POWERS C).
        angle_deg: smallest and largest angle learned from; zero is between them [deg].
    """

    mean: Array
    covariance: Array
    angle_deg: tuple[float, float]

    @classmethod
    def fit(
        cls,
        angle_deg: Array,
        change: Array,
        features: Array,
        specimen: NDArray[np.int64],
        noise: Array,
    ) -> "BendCurves":
        """Learn from n untouched frames.

        The mean by least squares, linear in the features; the covariance of the rest by
        expectation maximisation of the linear mixed model (Laird and Ware 1982).

        Args:
            angle_deg: (n,) [deg].
            change: of log V from the flat sensor (n, C).
            features: of the specimens (n, P).
            specimen: number of the specimen (n,); mirror images count as specimens.
            noise: covariance of one frame's change (C, C).
        """
        powers = _powers(angle_deg[:, None] / SCALE, MEAN_POWERS)
        share = np.concatenate([np.ones((len(change), 1)), features], axis=1)
        columns = (share[:, :, None] * powers[:, None, :]).reshape(len(change), -1)
        mean = np.asarray(np.linalg.lstsq(columns, change, rcond=1e-10)[0], dtype=float)
        residual = change - columns @ mean
        own = powers[:, :OWN_POWERS]
        covariance = _mixed_model(own, residual, specimen, noise)
        shape = (share.shape[1], MEAN_POWERS, change.shape[1])
        ends = (min(0.0, float(angle_deg.min())), max(0.0, float(angle_deg.max())))
        return cls(mean.reshape(shape), covariance, ends)

    def of(self, features: ArrayLike) -> BendCurve:
        """The curve of a specimen of these features (P,), before any calibration."""
        p = np.concatenate([[1.0], np.asarray(features, dtype=float)])
        mean = np.tensordot(p, self.mean, axes=1)
        own = np.zeros((OWN_POWERS, mean.shape[1]))
        return BendCurve(mean, own, self.covariance, self.angle_deg)

    def arrays(self) -> dict[str, Array]:
        """What `from_arrays` needs to make this again."""
        ends = np.array(self.angle_deg)
        return {"mean": self.mean, "covariance": self.covariance, "angle_deg": ends}

    @classmethod
    def from_arrays(cls, arrays: dict[str, NDArray[np.generic]]) -> "BendCurves":
        """The curves that `arrays` came from."""
        values = {name: array.astype(float) for name, array in arrays.items()}
        low, high = values["angle_deg"].tolist()
        return cls(values["mean"], values["covariance"], (low, high))


def _powers(u: Array, count: int) -> Array:
    """u, u^2 ... (..., count) of u (..., 1)."""
    powers: Array = u ** np.arange(1, count + 1)
    return powers


@lru_cache(maxsize=16)
def _grid(low: float, high: float, count: int) -> tuple[Array, Array]:
    """Angles (count,) [deg] and their powers (count, MEAN_POWERS)."""
    angles = np.linspace(low, high, count)
    return angles, _powers(angles[:, None] / SCALE, MEAN_POWERS)


def _mixed_model(
    powers: Array, residual: Array, specimen: NDArray[np.int64], noise: Array
) -> Array:
    """Covariance of the specimens' own coefficients, by expectation maximisation.

    The residuals of specimen s are its powers times w_s and noise. Expectation: the mean and
    covariance of w_s given them. Maximisation: the mean over s of w_s w_s^T and that covariance.
    """
    precision = np.linalg.inv(noise)
    terms = []
    for rows in _groups(specimen):
        X = powers[rows]
        terms.append((X.T @ X, (X.T @ residual[rows] @ precision).ravel()))
    size = powers.shape[1] * residual.shape[1]
    covariance = np.eye(size) * float(np.mean(residual**2))
    for _ in range(ROUNDS):
        inverse = np.linalg.inv(covariance)
        total = np.zeros_like(covariance)
        for gram, evidence in terms:
            posterior = np.linalg.inv(inverse + np.kron(gram, precision))
            expected = posterior @ evidence
            total += posterior + np.outer(expected, expected)
        covariance = total / len(terms)
        # A direction in which no specimen departs must not make the next inverse fail.
        covariance += 1e-9 * np.trace(covariance) / size * np.eye(size)
    return covariance


def _groups(labels: NDArray[np.int64]) -> Sequence[NDArray[np.intp]]:
    """Rows of each label."""
    order = np.argsort(labels, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(labels[order])) + 1)
