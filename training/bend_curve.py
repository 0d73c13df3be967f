"""What bending does to log V: a curve through zero, of which every specimen has its own."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import cho_factor, cho_solve

Array = NDArray[np.float64]

MEAN_POWERS = 5  # of the angle, in the curve of the middle specimen
OWN_POWERS = 3  # of the angle, in what a specimen has of its own
SCALE = 50.0  # deg, the unit of the angle in those powers
ROUNDS = 15  # of expectation and maximisation


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
        value: Array = _powers(u, MEAN_POWERS) @ self.mean + _powers(u, OWN_POWERS) @ self.own
        return value

    def slope(self, angle_deg: float) -> Array:
        """Its derivative (C,) [1/deg]."""
        u = angle_deg / SCALE
        powers = np.arange(MEAN_POWERS, dtype=float)
        rate = (powers + 1.0) * u**powers
        slope: Array = (rate @ self.mean + rate[:OWN_POWERS] @ self.own) / SCALE
        return slope

    def uncertainty(self, angle_deg: float, reference_deg: float = 0.0) -> Array:
        """Covariance (C, C) of B(angle) - B(reference), from not knowing w."""
        weights = _powers(np.array([angle_deg / SCALE]), OWN_POWERS)
        weights = weights - _powers(np.array([reference_deg / SCALE]), OWN_POWERS)
        channels = self.mean.shape[1]
        blocks = self.covariance.reshape(OWN_POWERS, channels, OWN_POWERS, channels)
        half = np.tensordot(weights, blocks, axes=1)
        covariance: Array = np.einsum("akb,k->ab", half, weights)
        return covariance

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
