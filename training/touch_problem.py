"""The least-squares problem of one frame: what is left of it by a bend and some touches."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from eitskin.training.bend_curve import BendCurve
from eitskin.training.touch_response import SpecimenResponse

Array = NDArray[np.float64]

FEARED_MOTION = 15.0  # deg, standard deviation of the angle since the reference was taken
BEYOND_DEG = 5.0  # how far outside of the angles learned from an angle may lie
ANGLE_UNIT = 5.0  # deg, in which steps of the angle are counted
TOUCH_UNITS = np.array([0.010, 0.010, 2.0])  # m, m, N: the same of touches
STILL_DEG = 0.01  # motion up to which the bend curve's uncertainty does not matter


@dataclass(frozen=True, slots=True, eq=False)
class Habits:
    """What touches are like, as far as the training set shows.

    Attributes:
        separation: smallest distance of two touches at once [m].
        force: mean and standard deviation [N].
        low, high: corners of the rectangle that they lie in, x and y, and bounds of the force (3,).
    """

    separation: float
    force: tuple[float, float]
    low: Array
    high: Array

    @property
    def spread(self) -> tuple[Array, Array]:
        """Means and standard deviations of x, y [m] and force [N], (3,) each."""
        mean = 0.5 * (self.low + self.high)
        deviation = (self.high - self.low) / math.sqrt(12.0)
        mean[2], deviation[2] = self.force
        return mean, deviation


@dataclass(frozen=True, slots=True, eq=False)
class Quadratic:
    """The misfit about a point, in unit steps of the unknowns: angle, then x, y, F of each touch.

    Attributes:
        misfit: sum of squares of whitened residuals and of departures from what is usual.
        gradient: minus half of the misfit's (n,).
        hessian: Gauss-Newton's half (n, n).
        residual: whitened (C,).
        jacobian: of what is said, whitened (C, n).
    """

    misfit: float
    gradient: Array
    hessian: Array
    residual: Array
    jacobian: Array


@dataclass(frozen=True, slots=True, eq=False)
class Point:
    """Values of the unknowns.

    Attributes:
        touches: x [m], y [m] and force [N] of each (k, 3).
        angle_deg: [deg].
    """

    touches: Array
    angle_deg: float

    def without(self, number: int) -> "Point":
        """The same less one touch."""
        return Point(np.delete(self.touches, number, axis=0), self.angle_deg)

    def beside(self, touches: Array) -> "Point":
        """The same with further touches (n, 3)."""
        return Point(np.concatenate([self.touches, touches]), self.angle_deg)


@dataclass(frozen=True, slots=True, eq=False)
class TouchProblem:
    """One frame beside its reference, and the specimen's model.

    Attributes:
        change: of log V since the reference (C,); zero where a measurement is left out.
        good: numbers of the measurements that are not left out.
        noise: covariance of the change (C, C).
        reference_deg: angle at which the reference was taken [deg].
        bent: of the curve there (C,).
        response: of the specimen to touches.
        curve: of its bending.
        habits: of touches.
    """

    change: Array
    good: NDArray[np.intp]
    noise: Array
    reference_deg: float
    bent: Array
    response: SpecimenResponse
    curve: BendCurve
    habits: Habits

    @classmethod
    def of(
        cls,
        change: Array,
        noise: Array,
        reference_deg: float,
        response: SpecimenResponse,
        curve: BendCurve,
        habits: Habits,
    ) -> "TouchProblem":
        """Of a change (C,) that is NaN where a measurement is bad."""
        good = np.isfinite(change)
        return cls(
            np.where(good, change, 0.0),
            np.flatnonzero(good),
            noise,
            reference_deg,
            curve.value(reference_deg),
            response,
            curve,
            habits,
        )

    def lacking(self, measurements: Sequence[int]) -> "TouchProblem":
        """The same without some measurements."""
        change = self.change.copy()
        change[list(measurements)] = 0.0
        return replace(self, change=change, good=np.setdiff1d(self.good, measurements))

    def left_by(self, point: Point) -> Array:
        """What bend and touches leave of the change (C,)."""
        left: Array = self.change - self.curve.value(point.angle_deg) + self.bent
        if len(point.touches):
            left = left - self.response(point.touches, point.angle_deg).sum(axis=0)
        return left

    def whitening(self, point: Point) -> Array:
        """L^-1 (good, C) of the residuals' covariance L L^T; columns left out are zero.

        The covariance is that of noise, of the bend curve since the reference, and of the response.
        """
        good, covariance = self.good, self.noise
        if abs(point.angle_deg - self.reference_deg) > STILL_DEG:
            moved = point.angle_deg - self.reference_deg
            unsure = self.curve.uncertainty(point.angle_deg, self.reference_deg)
            covariance = covariance + unsure + skew(self.curve.slope(point.angle_deg), moved)
        if len(point.touches):
            unsure = self.response.uncertainty(point.touches, point.angle_deg)
            covariance = covariance + unsure
        lower = np.linalg.cholesky(covariance[good[:, None], good])
        whitening = np.zeros((len(good), len(covariance)))
        whitening[:, good] = np.linalg.inv(lower)
        return whitening

    def misfit(self, point: Point, whitening: Array) -> float:
        """Sum of squares at `point`, in the metric of `whitening`."""
        left = whitening @ self.left_by(point)
        return float(left @ left) + self._prior(point)[0]

    def quadratic(self, point: Point, whitening: Array) -> Quadratic:
        """Misfit, gradient and Hessian at `point`, in the metric of `whitening`."""
        touches, angle = point.touches, point.angle_deg
        left = self.change - self.curve.value(angle) + self.bent
        columns = np.empty((1 + touches.size, len(left)))
        columns[0] = ANGLE_UNIT * self.curve.slope(angle)
        if len(touches):
            changes, slopes = self.response.with_derivatives(touches, angle)
            left -= changes.sum(axis=0)
            slopes *= TOUCH_UNITS[:, None]
            columns[1:] = slopes.reshape(touches.size, -1)
        residual = whitening @ left
        jacobian = whitening @ columns.T
        value, gradient, hessian = self._prior(point)
        return Quadratic(
            float(residual @ residual) + value,
            jacobian.T @ residual + gradient,
            jacobian.T @ jacobian + hessian,
            residual,
            jacobian,
        )

    def stepped(self, point: Point, step: Array) -> Point:
        """`point` moved by unit steps, and kept within what is possible."""
        low, high = self.curve.angle_deg
        angle = min(
            max(point.angle_deg + ANGLE_UNIT * float(step[0]), low - BEYOND_DEG), high + BEYOND_DEG
        )
        moved = point.touches + step[1:].reshape(-1, 3) * TOUCH_UNITS
        kept = np.minimum(np.maximum(moved, self.habits.low), self.habits.high)
        return Point(kept, angle)

    def _prior(self, point: Point) -> tuple[float, Array, Array]:
        """Of motion, places, forces, distances: value, minus half the gradient, half the Hessian.

        Places are spread evenly; a normal distribution as wide keeps them determined where a touch
        is hardly felt.
        """
        touches, count = point.touches, len(point.touches)
        moved = (point.angle_deg - self.reference_deg) / FEARED_MOTION
        value, scales = moved**2, np.full(1 + touches.size, ANGLE_UNIT / FEARED_MOTION)
        gradient = np.full(1 + touches.size, -moved * ANGLE_UNIT / FEARED_MOTION)
        if count:
            mean, deviation = self.habits.spread
            off = ((touches - mean) / deviation).ravel()
            value += float(off @ off)
            scales[1:].reshape(count, 3)[:] = TOUCH_UNITS / deviation
            gradient[1:] = -off * scales[1:]
        hessian = np.diag(scales**2)
        if count > 1:
            value += self._repulsion(touches, gradient, hessian)
        return value, gradient, hessian

    def _repulsion(self, touches: Array, gradient: Array, hessian: Array) -> float:
        """Touches nearer than any seen push each other apart; adds to gradient and Hessian."""
        softness, value = 0.1 * self.habits.separation, 0.0
        places = touches[:, :2].tolist()
        for (i, (xi, yi)), (j, (xj, yj)) in combinations(enumerate(places), 2):
            distance = math.hypot(xi - xj, yi - yj)
            lacking = (self.habits.separation - distance) / softness
            if lacking <= 0.0:
                continue
            # Two at one place part along x.
            towards = (
                ((xi - xj) / distance, (yi - yj) / distance) if distance > 1e-9 else (1.0, 0.0)
            )
            direction = np.array(towards) * TOUCH_UNITS[0] / softness
            a, b = slice(1 + 3 * i, 3 + 3 * i), slice(1 + 3 * j, 3 + 3 * j)
            gradient[a] += lacking * direction
            gradient[b] -= lacking * direction
            square = np.outer(direction, direction)
            hessian[a, a] += square
            hessian[b, b] += square
            hessian[a, b] -= square
            hessian[b, a] -= square
            value += lacking**2
        return value


def excess(misfit: float, freedom: int) -> float:
    """A misfit above its expectation, in standard deviations: a chi-square of so much freedom."""
    return (misfit - freedom) / math.sqrt(2.0 * max(freedom, 1))


def skew(slope: Array, moved_deg: float) -> Array:
    """Covariance (C, C) from measuring one after the other while the sensor moves.

    A frame takes as long as its C measurements, one after the other, and the first and the last
    of a moving sensor see different angles. How fast it moves is not known; that it moved by so
    much since the last frame says how fast it may.

    Args:
        slope: of log V with the angle (C,) [1/deg].
        moved_deg: since the reference [deg].
    """
    late = slope * (np.arange(len(slope)) / len(slope) - 0.5)
    covariance: Array = moved_deg**2 * np.outer(late, late)
    return covariance


@dataclass(frozen=True, slots=True, eq=False)
class Fitted:
    """A point of least misfit, and the metric in which it is."""

    point: Point
    quadratic: Quadratic
    whitening: Array

    @property
    def misfit(self) -> float:
        """Sum of squares."""
        return self.quadratic.misfit

    @property
    def freedom(self) -> int:
        """Number of residuals less number of unknowns, at least one."""
        return max(len(self.quadratic.residual) - len(self.quadratic.gradient), 1)

    @property
    def excess(self) -> float:
        """The misfit above its expectation, in standard deviations."""
        return excess(self.misfit, self.freedom)


def refined(problem: TouchProblem, point: Point, steps: int, settled: float) -> Fitted:
    """Gauss-Newton with Levenberg's damping from a point, in the metric that belongs to it.

    It ends after so many steps, or when one gains less than `settled` of the misfit.
    """
    whitening = problem.whitening(point)
    now, damping = problem.quadratic(point, whitening), 1e-3
    diagonal = np.arange(len(now.gradient))
    for _ in range(steps):
        damped = now.hessian.copy()
        damped[diagonal, diagonal] += damping * (1.0 + damped[diagonal, diagonal])
        step = np.asarray(np.linalg.solve(damped, now.gradient), dtype=float)
        moved = problem.stepped(point, step)
        trial = problem.quadratic(moved, whitening)
        if trial.misfit < now.misfit:
            gain = now.misfit - trial.misfit
            point, now = moved, trial
            damping *= 0.2
            if gain < settled:
                break
        else:
            damping *= 10.0
            if damping > 1e3:
                break
    return Fitted(point, now, whitening)
