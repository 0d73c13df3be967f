"""Bend curves: change with the angle, a linear mixed model over specimens.

Changes are those of log V in K combinations of measurements (`Combinations`).

Every specimen has its own curve. `BendCurvePrior` is the distribution of curves over all
specimens of a design, given their features; `BendCurve` that of one specimen, before or after a
calibration.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import cho_factor, cho_solve

from eitskin.compiled import implementation
from eitskin.training.joint.fit_kernels import KERNELS
from eitskin.training.joint.mirrored_frames import SCALE, MirroredFrames
from eitskin.training.method.stored_fields import Arrays, StoredField, StoredFields, restored_fields

Array = NDArray[np.float64]

MEAN_POWERS = 5  # of the angle, in the mean curve (fixed effects)
RANDOM_POWERS = 5  # in a specimen's departure from the mean (random effects); 3 in version 0.1
EM_ITERATIONS = 15
BEYOND_DEG = 5.0  # by which an estimated angle may lie outside of those learned from
MIN_SPREAD = 1e-3  # of a feature
TRUSTED_DEVIATIONS = 4.0
"""Standard deviations up to which features move the mean curve of a sensor whose curve is known at
some angles, which show more of it. A lower bound leaves more to them than one angle shows."""


@dataclass(frozen=True, slots=True, eq=False)
class BendCurve(StoredFields):
    """Normal distribution of one specimen's curve B = log V(angle) - log V(0).

        B(u) = sum_k u^k b_k + sum_j u^j w_j,   u = angle / 50 deg,   w ~ N(0, covariance)

    Attributes:
        mean: b_k (M, K).
        effects: mean of w, the specimen's random effects (R, K); zero before a calibration.
        covariance: covariance of w (R K, R K).
        angle_deg: smallest and largest angle that the curve was learned from [deg].
        coefficients: coefficients of the expected curve, b_k + w_k (M, K); follow from the above.
        blocks: covariances of w_j and w_k, and of w_k and w_j, for all pairs k <= j (R (R + 1) / 2,
            K^2); follow as well.
    """

    mean: Array
    effects: Annotated[Array, StoredField("own")]
    covariance: Array
    angle_deg: tuple[float, float]
    coefficients: Array = field(init=False, repr=False)
    blocks: Array = field(init=False, repr=False)
    _grids: dict[int, tuple[Array, Array]] = field(init=False, repr=False, default_factory=dict)
    _spreads: dict[bytes, Array] = field(init=False, repr=False, default_factory=dict)

    def __post_init__(self) -> None:
        """Arrange coefficients and covariances for evaluation."""
        coefficients, (random, channels) = self.mean.copy(), self.effects.shape
        coefficients[:random] += self.effects
        powers = self.covariance.reshape(random, channels, random, channels)
        pairs = np.tril_indices(random)
        blocks = powers.transpose(0, 2, 1, 3)[pairs]
        blocks[pairs[0] != pairs[1]] += blocks[pairs[0] != pairs[1]].transpose(0, 2, 1)
        blocks = blocks.reshape(len(blocks), channels**2)
        object.__setattr__(self, "coefficients", coefficients)
        object.__setattr__(self, "blocks", blocks)

    def value(self, angle_deg: ArrayLike) -> Array:
        """Expected change of log V (..., K) at angles (...) [deg]."""
        u = np.asarray(angle_deg, dtype=float)[..., None] / SCALE
        value: Array = _powers(u, len(self.mean)) @ self.coefficients
        return value

    def grid(self, count: int) -> tuple[Array, Array]:
        """Angles (count,) [deg] over the range learned from, and values there (count, K)."""
        if count not in self._grids:
            angles = np.linspace(*self.angle_deg, count)
            self._grids[count] = angles, self.value(angles)
        return self._grids[count]

    def slope(self, angle_deg: float) -> Array:
        """Derivative by the angle (K,) [1/deg]."""
        _, slope = self.value_and_slope(angle_deg)
        return slope

    def value_and_slope(self, angle_deg: float) -> tuple[Array, Array]:
        """Value (K,) and derivative (K,) [1/deg] at one angle [deg]."""
        orders, u = np.arange(1.0, len(self.mean) + 1.0), angle_deg / SCALE
        powers = u ** (orders - 1.0)
        value: Array = (u * powers) @ self.coefficients
        slope: Array = (orders / SCALE * powers) @ self.coefficients
        return value, slope

    def uncertainty(self, angle_deg: float, reference_deg: float = 0.0) -> Array:
        """Covariance (K, K) of B(angle) - B(reference) that w contributes."""
        kernels, u = implementation(KERNELS), angle_deg / SCALE
        covariance: Array = kernels.curve_covariance(self.blocks, u, reference_deg / SCALE)
        return covariance

    def uncertainties(self, angle_deg: Array) -> Array:
        """`uncertainty` of B at angles (n,) [deg], (n, K, K); stored for angles that come again."""
        if (key := angle_deg.tobytes()) not in self._spreads:
            random, channels = self.effects.shape
            powers = _powers(angle_deg[:, None] / SCALE, random)
            one, other = np.tril_indices(random)
            spreads = (powers[:, one] * powers[:, other]) @ self.blocks
            self._spreads[key] = spreads.reshape(-1, channels, channels)
        return self._spreads[key]

    def condition(self, angle_deg: Array, change: Array, noise: Array) -> "BendCurve":
        """Posterior of the curve given changes of log V at known angles, by Bayes' rule.

        Args:
            angle_deg: (n,) [deg].
            change: change of log V from the flat sensor (n, K); NaN where a measurement is bad.
            noise: covariance (n K, n K) of all changes jointly, or (K, K) of independent ones.
        """
        weights, residual, system = self._regression(angle_deg, change, noise)
        gain = cho_solve(cho_factor(system), weights @ self.covariance).T
        effects = self.effects + (gain @ residual).reshape(self.effects.shape)
        covariance = self.covariance - gain @ weights @ self.covariance
        return BendCurve(self.mean, effects, 0.5 * (covariance + covariance.T), self.angle_deg)

    def log_likelihood(self, angle_deg: Array, change: Array, noise: Array) -> float:
        """Log-likelihood of changes of log V at known angles; arguments as of `condition`."""
        _, residual, system = self._regression(angle_deg, change, noise)
        factor = cho_factor(system)
        width = _log_determinant(factor) + len(system) * np.log(2.0 * np.pi)
        return -0.5 * float(residual @ cho_solve(factor, residual) + width)

    def misfit(self, angle_deg: Array, change: Array, noise: Array) -> float:
        """Mean square of the whitened residuals, about 1 or less; arguments as of `condition`."""
        _, residual, system = self._regression(angle_deg, change, noise)
        return float(residual @ cho_solve(cho_factor(system), residual)) / max(len(residual), 1)

    def _regression(
        self, angle_deg: Array, change: Array, noise: Array
    ) -> tuple[Array, Array, Array]:
        """Weights of w in the good measurements (N, R K), their residual (N,) and its covariance.

        Arguments are those of `condition`.
        """
        count, channels = change.shape
        if noise.shape == (channels, channels):
            noise = np.asarray(np.kron(np.eye(count), noise), dtype=float)
        powers = _powers(angle_deg[:, None] / SCALE, len(self.effects))
        weights = np.asarray(np.kron(powers, np.eye(channels)), dtype=float)
        residual = (change - self.value(angle_deg)).ravel()
        good = np.isfinite(residual)
        weights, residual = weights[good], residual[good]
        system: Array = weights @ self.covariance @ weights.T + noise[np.ix_(good, good)]
        return weights, residual, system


def mixture_curve(curves: Sequence[BendCurve], shares: Array) -> BendCurve:
    """Mean and covariance of a mixture of curves of as many powers.

    Args:
        curves: n curves.
        shares: shares of each, one in sum (n,).
    """
    mean, effects, covariance = (
        np.tensordot(shares, [getattr(curve, name) for curve in curves], axes=1)
        for name in ("mean", "effects", "covariance")
    )
    random = len(effects)
    middle = (mean[:random] + effects).ravel()
    for curve, share in zip(curves, shares, strict=True):
        apart = curve.coefficients[:random].ravel() - middle
        covariance += share * np.outer(apart, apart)
    low = min(curve.angle_deg[0] for curve in curves)
    high = max(curve.angle_deg[1] for curve in curves)
    return BendCurve(mean, effects, covariance, (low, high))


@dataclass(frozen=True, slots=True, eq=False)
class BendCurvePrior(StoredFields):
    """Distribution of the curves of all specimens of a design, given their features.

    Attributes:
        mean: coefficients of the middle specimen, then their derivative by each feature
            (1 + P, M, K).
        covariance: covariance of the random effects (R K, R K).
        angle_deg: smallest and largest angle learned from; zero lies between them [deg].
        spread: mean square of each feature among the specimens learned from (P,); ones in older
            pipelines.
    """

    mean: Array
    covariance: Array
    angle_deg: tuple[float, float]
    spread: Array

    @classmethod
    def from_arrays(cls, arrays: Arrays, **given: Any) -> Self:
        """Restore the distribution, of older pipelines as well."""
        spread = np.ones(len(arrays["mean"]) - 1)
        return cls(**restored_fields(cls, {"spread": spread, **arrays}, **given))

    @classmethod
    def fit(cls, frames: MirroredFrames) -> "BendCurvePrior":
        """Learn from untouched frames.

        The mean is linear in the features and fitted by least squares; the covariance of the random
        effects by expectation maximisation of the linear mixed model (Laird and Ware 1982).
        """
        angle_deg, change = frames.angle_deg, frames.change
        powers = _powers(angle_deg[:, None] / SCALE, MEAN_POWERS)
        share = np.concatenate([np.ones((len(change), 1)), frames.features], axis=1)
        columns = (share[:, :, None] * powers[:, None, :]).reshape(len(change), -1)
        mean = np.asarray(np.linalg.lstsq(columns, change, rcond=1e-10)[0], dtype=float)
        residual = change - columns @ mean
        random = powers[:, :RANDOM_POWERS]
        covariance = _mixed_model(random, residual, frames.curve, frames.noise)
        shape = (share.shape[1], MEAN_POWERS, change.shape[1])
        ends = (min(0.0, float(angle_deg.min())), max(0.0, float(angle_deg.max())))
        first = np.unique(frames.curve, return_index=True)[1]
        spread = np.mean(frames.features[first] ** 2, axis=0)
        return cls(mean.reshape(shape), covariance, ends, spread)

    def log_likelihood(self, frames: MirroredFrames) -> Array:
        """Log-likelihood of the frames of each curve, in the order of their numbers (S,).

        With w integrated out, by the matrix determinant lemma and Woodbury's identity.
        """
        normal = np.linalg.slogdet(2.0 * np.pi * frames.noise)[1]
        width = np.linalg.slogdet(self.covariance)[1]
        logs = []
        for _, residual, posterior in self._posteriors(frames):
            misfit = float(np.sum(residual @ posterior.precision_of_noise * residual))
            misfit -= float(posterior.evidence @ posterior.effects)
            widths = _log_determinant(posterior.factor) + width + len(residual) * normal
            logs.append(-0.5 * (misfit + widths))
        return np.array(logs)

    def expected_coefficients(self, frames: MirroredFrames) -> Array:
        """Coefficients of each expected curve, in the order of their numbers.

        They are (S, M, K), as those of `BendCurve.condition` on all of its frames.
        """
        curves = []
        for prior, _, posterior in self._posteriors(frames):
            effects = posterior.effects.reshape(-1, frames.change.shape[1])
            curves.append(replace(prior, effects=effects).coefficients)
        return np.array(curves)

    def _posteriors(
        self, frames: MirroredFrames
    ) -> "Iterator[tuple[BendCurve, Array, _Posterior]]":
        """Prior of each curve, what it leaves of its frames, and the posterior of its effects."""
        size = len(self.covariance) // frames.change.shape[1]
        precision, inverse = _inverse(frames.noise), _inverse(self.covariance)
        for rows in _groups(frames.curve):
            prior, angle_deg = self.predict(frames.features[rows[0]]), frames.angle_deg[rows]
            powers = _powers(angle_deg[:, None] / SCALE, size)
            residual = frames.change[rows] - prior.value(angle_deg)
            yield prior, residual, _Posterior.from_residual(powers, residual, precision, inverse)

    @classmethod
    def flat(cls, features: int, channels: int) -> "BendCurvePrior":
        """Curves of sensors that are never bent: no change at the one angle of 0 deg."""
        size = RANDOM_POWERS * channels
        mean = np.zeros((1 + features, MEAN_POWERS, channels))
        return cls(mean, np.zeros((size, size)), (0.0, 0.0), np.ones(features))

    @property
    def bends(self) -> bool:
        """Whether the curves were learned from bent sensors."""
        low, high = self.angle_deg
        return low < high

    def predict(self, features: ArrayLike) -> BendCurve:
        """Prior of the curve of a specimen with features (P,)."""
        p = np.concatenate([[1.0], np.asarray(features, dtype=float)])
        mean = np.tensordot(p, self.mean, axes=1)
        channels = mean.shape[1]
        effects = np.zeros((len(self.covariance) // channels, channels))
        return BendCurve(mean, effects, self.covariance, self.angle_deg)

    def predict_widened(self, features: Array, rate: float) -> BendCurve:
        """Prior of the curve of a specimen, the less certain the stranger it is.

        The mean is linear in the features, and what it leaves grows with their mean square over
        that of the specimens learned from. Beyond `TRUSTED_DEVIATIONS` they move it no further.

        Args:
            features: features of the specimen (P,).
            rate: factor of the covariance over that ratio; at least 1 in all.
        """
        spread = np.maximum(self.spread, MIN_SPREAD)
        strangeness = float(np.mean(features**2 / spread)) if len(features) else 0.0
        curve = self.predict(np.clip(features, -TRUSTED_DEVIATIONS, TRUSTED_DEVIATIONS))
        return replace(curve, covariance=max(1.0, rate * strangeness) * curve.covariance)


@dataclass(frozen=True, slots=True, eq=False)
class _Posterior:
    """Posterior of the random effects w of one specimen, given its frames.

    Attributes:
        evidence: their part in the posterior of w (R K,).
        factor: Cholesky factor of its precision.
        effects: its mean (R K,).
        precision_of_noise: inverse covariance of one frame's change (K, K).
    """

    evidence: Array
    factor: tuple[Array, bool]
    effects: Array
    precision_of_noise: Array

    @classmethod
    def from_residual(
        cls, powers: Array, residual: Array, precision: Array, inverse: Array
    ) -> "_Posterior":
        """By what frames leave (n, K), of powers (n, R) of their angles; `inverse` that of w."""
        evidence = (powers.T @ (residual @ precision)).ravel()
        factor = cho_factor(inverse + np.kron(powers.T @ powers, precision))
        return cls(evidence, factor, cho_solve(factor, evidence), precision)


def _log_determinant(factor: tuple[Array, bool]) -> float:
    """Logarithm of the determinant of a matrix with this Cholesky factor."""
    return 2.0 * float(np.sum(np.log(np.diagonal(factor[0]))))


def _inverse(matrix: Array) -> Array:
    return np.asarray(np.linalg.inv(matrix), dtype=np.float64)


def _powers(u: Array, count: int) -> Array:
    """Powers u, u^2, ... (..., count) of u (..., 1)."""
    powers: Array = u ** np.arange(1, count + 1)
    return powers


def _mixed_model(
    powers: Array, residual: Array, specimen: NDArray[np.int64], noise: Array
) -> Array:
    """Covariance of the random effects, by expectation maximisation.

    The residuals of specimen s are powers of the angle times w_s, plus noise. Expectation step:
    mean and covariance of w_s given the residuals. Maximisation step: average over s of
    w_s w_s^T plus that covariance.
    """
    precision = _inverse(noise)
    groups, size = _groups(specimen), powers.shape[1] * residual.shape[1]
    covariance = np.eye(size) * float(np.mean(residual**2))
    for _ in range(EM_ITERATIONS):
        inverse, total = _inverse(covariance), np.zeros_like(covariance)
        for rows in groups:
            found = _Posterior.from_residual(powers[rows], residual[rows], precision, inverse)
            total += cho_solve(found.factor, np.eye(size)) + np.outer(found.effects, found.effects)
        covariance = total / len(groups)
        # Keeps the covariance invertible in directions in which no specimen departs.
        covariance += 1e-9 * np.trace(covariance) / size * np.eye(size)
    return covariance


def _groups(labels: NDArray[np.int64]) -> Sequence[NDArray[np.intp]]:
    """Row numbers of each label."""
    order = np.argsort(labels, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(labels[order])) + 1)
