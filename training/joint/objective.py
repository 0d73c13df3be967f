"""The least-squares problem of one frame: what is left of it by a bend and some touches."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from eitskin.training.joint import lapack
from eitskin.training.joint.bend_curve import BendCurve
from eitskin.training.joint.touch_response import SpecimenResponse

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
        mean: of x, y [m] and force [N], (3,), as those say.
        stiffness: one over their variances, in unit steps (3,).
    """

    separation: float
    force: tuple[float, float]
    low: Array
    high: Array
    mean: Array = field(init=False)
    stiffness: Array = field(init=False)

    def __post_init__(self) -> None:
        """Places are spread evenly; a normal distribution as wide keeps them determined."""
        mean = 0.5 * (self.low + self.high)
        deviation = (self.high - self.low) / math.sqrt(12.0)
        mean[2], deviation[2] = self.force
        object.__setattr__(self, "mean", mean)
        object.__setattr__(self, "stiffness", (TOUCH_UNITS / deviation) ** 2)


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

    def step(self, damping: float) -> Array:
        """To the least of it, with Levenberg's damping (n,)."""
        damped = self.hessian.copy()
        diagonal = damped.reshape(-1)[:: len(damped) + 1]
        diagonal += damping * (1.0 + diagonal)
        return lapack.solved(damped, self.gradient)


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
class Tangent:
    """What the model leaves of a frame at a point and near it, in no metric yet.

    Attributes:
        point: where.
        rows: what is left of the change, then derivatives of what is said by unit steps of the
            unknowns (1 + n, C).
        changes: by each touch (k, C).
        hidden: of the touches, as their response's uncertainty needs it (k, hidden + 1).
    """

    point: Point
    rows: Array
    changes: Array
    hidden: Array

    @property
    def left(self) -> Array:
        """Of the change (C,)."""
        left: Array = self.rows[0]
        return left

    @property
    def bend_slope(self) -> Array:
        """Derivative of the bend curve (C,) [1/deg]."""
        slope: Array = self.rows[1] / ANGLE_UNIT
        return slope


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
            left -= self.response(point.touches, point.angle_deg).sum(axis=0)
        return left

    def tangent(self, point: Point) -> Tangent:
        """What bend and touches leave of the change, there and near it."""
        touches, angle = point.touches, point.angle_deg
        rows = np.empty((2 + touches.size, len(self.change)))
        value, slope = self.curve.tangent(angle)
        np.subtract(self.change + self.bent, value, out=rows[0])
        np.multiply(slope, ANGLE_UNIT, out=rows[1])
        if not len(touches):
            return Tangent(point, rows, touches, touches)
        said, hidden = self.response.tangent(touches, angle)
        changes = said[:, 0]
        rows[0] -= np.add.reduce(changes)
        np.multiply(said[:, 1:], TOUCH_UNITS[:, None], out=rows[2:].reshape(len(touches), 3, -1))
        return Tangent(point, rows, changes, hidden)

    def whitening(self, at: Tangent) -> Array:
        """L^-1 (good, C) of the residuals' covariance L L^T; columns left out are zero.

        The covariance is that of noise, of the bend curve since the reference, and of the response.
        """
        good, covariance, point = self.good, self.noise, at.point
        moved = point.angle_deg - self.reference_deg
        if abs(moved) > STILL_DEG:
            covariance = covariance + self.curve.uncertainty(point.angle_deg, self.reference_deg)
            covariance += skew(at.bend_slope, moved)
        if len(point.touches):
            covariance = covariance + self.response.uncertainty(at.changes, at.hidden)
        if len(good) == len(covariance):
            return lapack.whitening(covariance)
        whitening = np.zeros((len(good), len(covariance)))
        whitening[:, good] = lapack.whitening(covariance[good[:, None], good])
        return whitening

    def misfit(self, at: Tangent, whitening: Array) -> float:
        """Sum of squares at a point, in the metric of `whitening`."""
        return self.quadratic(at, whitening).misfit

    def quadratic(self, at: Tangent, whitening: Array) -> Quadratic:
        """Misfit, gradient and Hessian at a point, in the metric of `whitening`."""
        white = at.rows @ whitening.T
        # Of residual and Jacobian with themselves: misfit, gradient and Hessian are blocks of it.
        products = white @ white.T
        self._add_prior(at.point, products)
        misfit, gradient, hessian = float(products[0, 0]), products[0, 1:], products[1:, 1:]
        return Quadratic(misfit, gradient, hessian, white[0], white[1:].T)

    def stepped(self, point: Point, step: Array) -> Point:
        """`point` moved by unit steps, and kept within what is possible."""
        low, high = self.curve.angle_deg
        angle = min(
            max(point.angle_deg + ANGLE_UNIT * float(step[0]), low - BEYOND_DEG), high + BEYOND_DEG
        )
        moved = point.touches + step[1:].reshape(-1, 3) * TOUCH_UNITS
        kept = np.minimum(np.maximum(moved, self.habits.low), self.habits.high)
        return Point(kept, angle)

    def _add_prior(self, point: Point, products: Array) -> None:
        """Add what is usual of motion, touches and their distances to `quadratic`'s products."""
        touches, diagonal = point.touches, products.reshape(-1)[:: len(products) + 1]
        turn = ANGLE_UNIT / FEARED_MOTION
        moved = (self.reference_deg - point.angle_deg) / FEARED_MOTION
        diagonal[0] += moved**2
        diagonal[1] += turn**2
        products[0, 1] += turn * moved
        if not len(touches):
            return
        away = (self.habits.mean - touches) / TOUCH_UNITS
        pull = away * self.habits.stiffness
        products[0, 2:] += pull.reshape(-1)
        diagonal[0] += away.reshape(-1) @ pull.reshape(-1)
        diagonal[2:].reshape(-1, 3)[:] += self.habits.stiffness
        if len(touches) > 1:
            diagonal[0] += self._repulsion(touches, products[0, 1:], products[1:, 1:])

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
    late = moved_deg * slope * (np.arange(len(slope)) / len(slope) - 0.5)
    covariance: Array = late[:, None] * late
    return covariance


@dataclass(frozen=True, slots=True, eq=False)
class Fitted:
    """A point of least misfit, and the metric in which it is."""

    at: Tangent
    quadratic: Quadratic
    whitening: Array

    @property
    def point(self) -> Point:
        """Where."""
        return self.at.point

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


def refined(problem: TouchProblem, start: Tangent, steps: int, settled: float) -> Fitted:
    """Gauss-Newton with Levenberg's damping from a point, in the metric that belongs to it.

    It ends after so many steps, or when one gains less than `settled` of the misfit.
    """
    whitening = problem.whitening(start)
    at, now, damping = start, problem.quadratic(start, whitening), 1e-3
    for _ in range(steps):
        moved = problem.tangent(problem.stepped(at.point, now.step(damping)))
        trial = problem.quadratic(moved, whitening)
        if trial.misfit < now.misfit:
            gain = now.misfit - trial.misfit
            at, now = moved, trial
            damping *= 0.2
            if gain < settled:
                break
        else:
            damping *= 10.0
            if damping > 1e3:
                break
    return Fitted(at, now, whitening)
