"""A frame explained by a bend and some touches: weighted least squares, one touch after another.

Matching pursuit finds where a further touch would explain most of what is left; Gauss-Newton
then fits angle, places and forces together; the touch stays if the misfit falls by more than
chance would let it.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from eitskin.training.bend_curve import BendCurve
from eitskin.training.touch_response import SpecimenResponse

Array = NDArray[np.float64]

MOST_TOUCHES = 4
THRESHOLD = 25.0
"""By which a touch must lower the misfit. The gain of one that is not there is the largest of some
fifty chi-square variables of three degrees of freedom, above this once in a thousand frames."""

ROUGH_STEPS, STEPS = 4, 12  # of Gauss-Newton at most, before and after all touches are found
DOUBTFUL = 3.0  # times the threshold: gains, to second order, below which a touch is tried without
UNLIKELY = 2.0  # standard deviations of the misfit above its expectation
SECOND_LOOKS = 2  # fits with other pairs that are tried then
PAIR_STRIDE = 3  # every how many-th candidate may be of a pair
RIVAL = 0.4  # share of the best promise from which on a second place is tried as well
SETTLED = 0.01  # change of the misfit after which it stops
FEARED_MOTION = 15.0  # deg, standard deviation of the angle since the reference was taken
PLACE_UNIT, FORCE_UNIT, ANGLE_UNIT = 0.010, 2.0, 5.0  # m, N, deg: unit steps of the unknowns


@dataclass(frozen=True, slots=True, eq=False)
class Explanation:
    """What explains a frame best.

    Attributes:
        angle_deg: [deg].
        angle_deviation_deg: standard error [deg], of its change since the reference.
        touches: x [m], y [m] and force [N] of each (k, 3).
        covariance: of each touch's three (k, 3, 3).
        evidence: by how much the first touch lowered the misfit, also where it was not kept.
        gains: how much the misfit rises without each touch (k,).
        misfit: sum of the squared residuals, in units of their standard deviations.
        freedom: number of residuals less number of unknowns.
    """

    angle_deg: float
    angle_deviation_deg: float
    touches: Array
    covariance: Array
    evidence: float
    gains: Array
    misfit: float
    freedom: int


@dataclass(frozen=True, slots=True, eq=False)
class Candidates:
    """Places that are tried for a further touch, and what a touch of middle force does there.

    Attributes:
        places: (n, 2) [m].
        force: that of all of them [N].
        change: of log V (n, C), at one angle.
    """

    places: Array
    force: float
    change: Array


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


class TouchFit:
    """The fit of one frame.

    Attributes:
        change: of log V since the reference, of the good measurements (C,).
        noise: their covariance (C, C).
        reference_deg: angle at which the reference was taken [deg].
    """

    def __init__(
        self,
        change: Array,
        noise: Array,
        reference_deg: float,
        response: SpecimenResponse,
        curve: BendCurve,
        habits: Habits,
    ) -> None:
        """Set up; measurements that are NaN are left out."""
        self._good = np.isfinite(change)
        self.change = change[self._good]
        self.noise = noise[np.ix_(self._good, self._good)]
        self.reference_deg = reference_deg
        self._response, self._curve, self._habits = response, curve, habits
        self._start = curve.value(reference_deg)

    def explain(self, candidates: Candidates, proposed: Array | None = None) -> Explanation:
        """The bend and the touches that explain the frame.

        Args:
            candidates: that are tried for further touches.
            proposed: places (k, 2) [m] from which the fit starts.
        """
        untouched = self._refined(np.zeros((0, 3)), self._still_or_moved(), STEPS)
        found, evidence = untouched, 0.0
        if proposed is not None and len(proposed):
            started = self._refined(
                self._with_forces(proposed, untouched.angle_deg), untouched.angle_deg, ROUGH_STEPS
            )
            evidence = self._misfit_of(*untouched.place, started.whitening) - started.misfit
            if evidence > THRESHOLD:
                found = started
        while len(found.touches) < MOST_TOUCHES:
            starts = self._most_promising(found, candidates)
            if not starts:
                break
            more = min(
                (self._refined(start, found.angle_deg, ROUGH_STEPS) for start in starts),
                key=lambda fitted: fitted.misfit,
            )
            before = self._misfit_of(*found.place, more.whitening)
            gain = before - more.misfit
            evidence = max(evidence, gain)
            if gain < THRESHOLD:
                break
            found = more
        found = self._pruned(found)
        if self._is_unlikely(found):
            found = self._reconsidered(found, candidates)
        return self._explanation(found, evidence)

    def _is_unlikely(self, found: "_Fitted") -> bool:
        """Whether the misfit is larger than it should be by two standard deviations."""
        freedom = max(len(self.change) - 1 - found.touches.size, 1)
        return bool(found.misfit > freedom + UNLIKELY * np.sqrt(2.0 * freedom))

    def _reconsidered(self, found: "_Fitted", candidates: Candidates) -> "_Fitted":
        """A better fit, if there is one, with one touch taken back and two put in its place.

        One touch after another finds the middle of two. Pairs cannot be found so.
        """
        starts = []
        left_out: list[int | None] = list(range(len(found.touches)))
        if len(found.touches) <= MOST_TOUCHES - 2:
            left_out.append(None)
        if len(found.touches) == MOST_TOUCHES:
            return found
        for number in left_out:
            others = found.touches
            if number is not None:
                others = np.delete(others, number, axis=0)
            starts.append(self._best_pair(others, found, candidates))
        starts.sort(key=lambda start: -start[0])
        best = found
        for _, touches in starts[:SECOND_LOOKS]:
            trial = self._refined(touches, found.angle_deg, STEPS)
            gain = self._misfit_of(*best.place, trial.whitening) - trial.misfit
            if gain > THRESHOLD * (len(touches) - len(best.touches)):
                best = trial
        return self._pruned(best) if best is not found else found

    def _best_pair(
        self, others: Array, found: "_Fitted", candidates: Candidates
    ) -> tuple[float, Array]:
        """Gain of, and start with, the two candidates that explain most beside `others`.

        Two shapes a, b with Gram matrix G and projections p explain p^T G^-1 p of a residual.
        """
        places, shapes = candidates.places[::PAIR_STRIDE], candidates.change[::PAIR_STRIDE]
        shapes = shapes[:, self._good] @ found.whitening.T
        left = found.whitening @ self._left(others, found.angle_deg)
        gram, p = shapes @ shapes.T, shapes @ left
        size = np.diag(gram)
        determinant = np.maximum(size[:, None] * size - gram**2, 1e-9 * size[:, None] * size)
        first = (p[:, None] * size - gram * p) / determinant
        second = (p * size[:, None] - gram * p[:, None]) / determinant
        gain = first * p[:, None] + second * p
        apart = np.linalg.norm(places[:, None] - places, axis=2)
        low, high = np.array(self._forces) / candidates.force
        possible = (apart > self._habits.separation) & (np.minimum(first, second) > low)
        possible &= np.maximum(first, second) < high
        for touch in others:
            free = np.hypot(*(places - touch[:2]).T) > 0.7 * self._habits.separation
            possible &= free[:, None] & free
        gain = np.where(possible, gain, 0.0)
        a, b = np.unravel_index(int(gain.argmax()), gain.shape)
        pair = [
            [*places[a], first[a, b] * candidates.force],
            [*places[b], second[a, b] * candidates.force],
        ]
        already = np.sum(left**2)
        return float(gain[a, b] - already), np.vstack([others, pair])

    def _pruned(self, found: "_Fitted") -> "_Fitted":
        """Converged, and without touches that the others explain after all."""
        while len(found.touches):
            found = self._refined(found.touches, found.angle_deg, STEPS)
            gains = self._gains(found)
            weakest = int(gains.argmin())
            if len(gains) == 1 or gains[weakest] > DOUBTFUL * THRESHOLD:
                break
            fewer = self._refined(np.delete(found.touches, weakest, axis=0), found.angle_deg, STEPS)
            before = self._misfit_of(*fewer.place, found.whitening)
            if before - found.misfit > THRESHOLD:
                break
            found = fewer
        return found

    def _still_or_moved(self) -> float:
        """The angle from which the fit starts: where the bend alone explains most [deg]."""
        low, high = self._curve.angle_deg
        angles = np.append(np.linspace(low, high, 15), self.reference_deg)
        left = self.change - (self._curve.value(angles) - self._start)[:, self._good]
        misfits = np.sum(left**2 / np.diag(self.noise), axis=1)
        misfits += ((angles - self.reference_deg) / FEARED_MOTION) ** 2
        return float(angles[misfits.argmin()])

    def _most_promising(self, found: "_Fitted", candidates: Candidates) -> list[Array]:
        """Touches (k + 1, 3) to start from: those found, and one where it explains most.

        The first touch may lie nearly as well elsewhere, such as across the middle of the sensor:
        then both places are tried.
        """
        whitening = self._whitening(found.touches, found.angle_deg)
        left = whitening @ self._left(found.touches, found.angle_deg)
        shapes = candidates.change[:, self._good] @ whitening.T
        # What a change of the angle explains is no evidence of a touch.
        bend = whitening @ self._curve.slope(found.angle_deg)[self._good] * FEARED_MOTION
        bend /= np.sqrt(1.0 + bend @ bend)
        shapes = shapes - np.outer(shapes @ bend, bend)
        sizes = np.sum(shapes**2, axis=1)
        strength = shapes @ left / sizes
        gain = np.where(strength > 0, strength**2 * sizes, 0.0)
        for touch in found.touches:
            near = np.hypot(*(candidates.places - touch[:2]).T) < 0.7 * self._habits.separation
            gain[near] = 0.0
        starts: list[Array] = []
        highest = float(gain.max())
        for _ in range(1 if len(found.touches) else 2):
            best = int(gain.argmax())
            if gain[best] < max(0.3 * THRESHOLD, RIVAL * highest):
                break
            force = np.clip(strength[best] * candidates.force, *self._forces)
            starts.append(np.vstack([found.touches, [*candidates.places[best], force]]))
            away = np.hypot(*(candidates.places - candidates.places[best]).T)
            gain[away < 0.5 * self._habits.separation] = 0.0
        return starts

    def _with_forces(self, places: Array, angle_deg: float) -> Array:
        """Touches (k, 3) at these places, with forces that suit together to first order."""
        mean, deviation = self._habits.force
        touches = np.column_stack([places, np.full(len(places), mean)])
        whitening = self._whitening(touches[:0], angle_deg)
        shapes = whitening @ self._response(touches, angle_deg)[:, self._good].T
        left = whitening @ self._left(touches[:0], angle_deg)
        ridge = (mean / deviation) ** 2 * np.eye(len(places))
        share = np.linalg.solve(shapes.T @ shapes + ridge, shapes.T @ left + ridge.sum(axis=1))
        touches[:, 2] = np.clip(share * mean, *self._forces)
        return touches

    @property
    def _forces(self) -> tuple[float, float]:
        return float(self._habits.low[2]), float(self._habits.high[2])

    def _left(self, touches: Array, angle_deg: float) -> Array:
        """What bend and touches leave of the change (C,)."""
        said = self._curve.value(angle_deg) - self._start
        if len(touches):
            said = said + self._response(touches, angle_deg).sum(axis=0)
        left: Array = self.change - said[self._good]
        return left

    def _whitening(self, touches: Array, angle_deg: float) -> Array:
        """L^-1 of the residuals' covariance L L^T: noise, bend curve and response."""
        covariance = self.noise
        if abs(angle_deg - self.reference_deg) > 0.01:
            unsure = self._curve.uncertainty(angle_deg, self.reference_deg)
            covariance = covariance + unsure[np.ix_(self._good, self._good)]
        if len(touches):
            change = self._response(touches, angle_deg)[:, self._good]
            mismatch = self._response.response.mismatch
            covariance = covariance + np.diag(mismatch**2 * np.sum(change**2, axis=0))
        lower = np.linalg.cholesky(covariance)
        whitening: Array = solve_triangular(lower, np.eye(len(lower)), lower=True)
        return whitening

    def _misfit_of(self, touches: Array, angle_deg: float, whitening: Array) -> float:
        left = whitening @ self._left(touches, angle_deg)
        return float(left @ left) + self._prior(touches, angle_deg)[0]

    def _refined(self, touches: Array, angle_deg: float, steps: int) -> "_Fitted":
        """Gauss-Newton with Levenberg's damping, from a start."""
        whitening = self._whitening(touches, angle_deg)
        damping = 1e-3
        misfit, gradient, hessian = self._quadratic(touches, angle_deg, whitening)
        for _ in range(steps):
            damped = hessian + damping * (np.diag(np.diag(hessian)) + np.eye(len(hessian)))
            step = np.linalg.solve(damped, gradient)
            new_angle = float(np.clip(angle_deg + ANGLE_UNIT * step[0], *self._angles))
            moved = touches + step[1:].reshape(-1, 3) * (PLACE_UNIT, PLACE_UNIT, FORCE_UNIT)
            moved = np.clip(moved, self._habits.low, self._habits.high)
            trial = self._quadratic(moved, new_angle, whitening)
            if trial[0] < misfit:
                settled = misfit - trial[0] < SETTLED
                touches, angle_deg = moved, new_angle
                misfit, gradient, hessian = trial
                damping *= 0.2
                if settled:
                    break
            else:
                damping *= 10.0
                if damping > 1e3:
                    break
        return _Fitted(touches, angle_deg, misfit, hessian, whitening)

    @property
    def _angles(self) -> tuple[float, float]:
        low, high = self._curve.angle_deg
        return low - 5.0, high + 5.0

    def _quadratic(
        self, touches: Array, angle_deg: float, whitening: Array
    ) -> tuple[float, Array, Array]:
        """Misfit, minus half its gradient, and Gauss-Newton's matrix, in units of the unknowns."""
        said = self._curve.value(angle_deg) - self._start
        columns = [ANGLE_UNIT * self._curve.slope(angle_deg)]
        if len(touches):
            changes, slopes = self._response.with_derivatives(touches, angle_deg)
            said = said + changes.sum(axis=0)
            units = np.array([PLACE_UNIT, PLACE_UNIT, FORCE_UNIT])
            columns += list((slopes * units[:, None]).reshape(-1, slopes.shape[-1]))
        left = whitening @ (self.change - said[self._good])
        J = whitening @ np.array(columns)[:, self._good].T
        value, gradient, hessian = self._prior(touches, angle_deg)
        return float(left @ left) + value, J.T @ left + gradient, J.T @ J + hessian

    def _prior(self, touches: Array, angle_deg: float) -> tuple[float, Array, Array]:
        """Of motion, forces and distances: value, minus half the gradient, half the Hessian."""
        size = 1 + 3 * len(touches)
        gradient, hessian = np.zeros(size), np.zeros((size, size))
        moved = (angle_deg - self.reference_deg) / FEARED_MOTION
        value = moved**2
        gradient[0] = -moved * ANGLE_UNIT / FEARED_MOTION
        hessian[0, 0] = (ANGLE_UNIT / FEARED_MOTION) ** 2
        mean, deviation = self._habits.force
        for i, touch in enumerate(touches):
            off = (touch[2] - mean) / deviation
            value += off**2
            gradient[3 + 3 * i] -= off * FORCE_UNIT / deviation
            hessian[3 + 3 * i, 3 + 3 * i] += (FORCE_UNIT / deviation) ** 2
            for j in range(i):
                value += self._repulsion(touches, i, j, gradient, hessian)
        return float(value), gradient, hessian

    def _repulsion(self, touches: Array, i: int, j: int, gradient: Array, hessian: Array) -> float:
        """Touches nearer than any seen push each other apart; adds to gradient and Hessian."""
        apart = touches[i, :2] - touches[j, :2]
        distance = float(np.hypot(*apart))
        lacking = self._habits.separation - distance
        if lacking <= 0:
            return 0.0
        stiffness = 1.0 / (0.1 * self._habits.separation)
        direction = apart / max(distance, 1e-9) * (PLACE_UNIT * stiffness)
        push = lacking * stiffness * direction
        a, b = slice(1 + 3 * i, 3 + 3 * i), slice(1 + 3 * j, 3 + 3 * j)
        gradient[a] += push
        gradient[b] -= push
        square = np.outer(direction, direction)
        hessian[a, a] += square
        hessian[b, b] += square
        hessian[a, b] -= square
        hessian[b, a] -= square
        return (lacking * stiffness) ** 2

    def _explanation(self, found: "_Fitted", evidence: float) -> Explanation:
        units = np.concatenate(
            [[ANGLE_UNIT], np.tile([PLACE_UNIT, PLACE_UNIT, FORCE_UNIT], len(found.touches))]
        )
        covariance = np.linalg.inv(found.hessian) * np.outer(units, units)
        own = [slice(1 + 3 * i, 4 + 3 * i) for i in range(len(found.touches))]
        return Explanation(
            found.angle_deg,
            float(np.sqrt(covariance[0, 0])),
            found.touches,
            np.array([covariance[s, s] for s in own]).reshape(-1, 3, 3),
            evidence,
            self._gains(found),
            found.misfit,
            len(self.change) - len(units),
        )

    def _gains(self, found: "_Fitted") -> Array:
        """How much the misfit would rise, to second order, were each touch's force zero."""
        inverse = np.linalg.inv(found.hessian)
        forces = found.touches[:, 2] / FORCE_UNIT
        rows = 3 + 3 * np.arange(len(forces))
        gains: Array = forces**2 / inverse[rows, rows]
        return gains


@dataclass(frozen=True, slots=True, eq=False)
class _Fitted:
    touches: Array
    angle_deg: float
    misfit: float
    hessian: Array
    whitening: Array

    @property
    def place(self) -> tuple[Array, float]:
        """Touches and angle: the unknowns."""
        return self.touches, self.angle_deg
