"""A frame explained by a bend and some touches.

A network proposes where touches are, Gauss-Newton fits angle, places and forces together; further
touches are looked for in what is left, and every touch must lower the misfit by more than chance
would.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eitskin.training.joint import lapack
from eitskin.training.joint.channel_faults import Fault, PossibleFaults, mended
from eitskin.training.joint.objective import (
    ANGLE_UNIT,
    TOUCH_UNITS,
    Fitted,
    Point,
    TouchProblem,
    refined,
)
from eitskin.training.joint.touch_search import Candidates, best_pairs, most_promising, with_forces

Array = NDArray[np.float64]

MOST_TOUCHES = 4
GRID = 15  # angles that the bend is tried at to start with
THRESHOLD = 25.0
"""By which a touch must lower the misfit. The gain of one that is not there is the largest of some
fifty chi-square variables of three degrees of freedom, above this once in a thousand frames."""

ROUGH, FINE = (4, 0.5), (8, 0.03)  # Gauss-Newton: steps at most, gain that ends it
PROMISING = 0.5  # times the threshold: least gain, to first order, of a place to start from
DOUBTFUL = 3.0  # times the threshold: gains, to second order, below which a touch is tried without
LUCKY, UNLIKELY = 2.0, 2.0  # standard deviations of the misfit below and above its expectation
SECOND_LOOKS = 2  # fits with other pairs that are tried where the misfit is unlikely
MOST_FAULTS = 2  # that are looked for in a frame


@dataclass(frozen=True, slots=True, eq=False)
class Explanation:
    """What explains a frame best.

    Attributes:
        angle_deg: [deg].
        angle_deviation_deg: standard error [deg], of its change since the reference.
        touches: x [m], y [m] and force [N] of each (k, 3).
        covariance: of each touch's three (k, 3, 3).
        evidence: by how much the first touch lowered the misfit, also where it was not kept.
        gains: how much the misfit would rise without each touch, to second order (k,).
        misfit: sum of the squared residuals, in units of their standard deviations.
        freedom: number of residuals less number of unknowns.
        faults: why measurements were left out.
    """

    angle_deg: float
    angle_deviation_deg: float
    touches: Array
    covariance: Array
    evidence: float
    gains: Array
    misfit: float
    freedom: int
    faults: tuple[Fault, ...]


def explain(
    problem: TouchProblem,
    candidates: Candidates,
    proposed: Array | None = None,
    possible: PossibleFaults | None = None,
) -> Explanation:
    """The bend and the touches that explain a frame.

    Args:
        problem: the frame.
        candidates: that are tried for further touches.
        proposed: places (k, 2) [m] from which the fit starts.
        possible: faults of measurements; none are looked for where these are not given.
    """
    untouched, found, evidence = _fit(problem, candidates, proposed)
    told: list[Fault] = []
    while possible and len(told) < MOST_FAULTS:
        better = mended(problem, untouched, found, _gains(found), possible)
        if better is None:
            break
        told.append(better.fault)
        problem, found = better.problem, better.found
        untouched = refined(problem, problem.tangent(untouched.point), *FINE)
        evidence = _gain(problem, untouched, found)
    return _explanation(found, evidence, tuple(told))


def _fit(
    problem: TouchProblem, candidates: Candidates, proposed: Array | None
) -> tuple[Fitted, Fitted, float]:
    """The fit without touches, the best one, and the evidence of any touch."""
    nothing = Point(np.zeros((0, 3)), _still_or_moved(problem))
    untouched = refined(problem, problem.tangent(nothing), *FINE)
    found, evidence = untouched, 0.0
    if proposed is not None and len(proposed):
        start = with_forces(problem, proposed, untouched.at)
        started = refined(problem, problem.tangent(start), *ROUGH)
        evidence = _gain(problem, untouched, started)
        if evidence > THRESHOLD:
            found = started
    while len(found.point.touches) < MOST_TOUCHES and _leaves_room(found):
        starts = most_promising(problem, found, candidates, PROMISING * THRESHOLD)
        if not starts:
            break
        trials = [refined(problem, problem.tangent(start), *ROUGH) for start in starts]
        more = min(trials, key=lambda trial: trial.misfit)
        gain = _gain(problem, found, more)
        evidence = max(evidence, gain)
        if gain < THRESHOLD:
            break
        found = more
    found = _pruned(problem, found)
    if found.excess > UNLIKELY and len(found.point.touches) < MOST_TOUCHES:
        found = _reconsidered(problem, found, candidates)
    return untouched, found, evidence


def _still_or_moved(problem: TouchProblem) -> float:
    """The angle from which the fit starts: where the bend alone explains most [deg]."""
    angles, values = problem.curve.grid(GRID)
    left = problem.change + problem.bent - np.concatenate([values, problem.bent[None]])
    weights = 1.0 / np.diagonal(problem.noise)[problem.good]
    best = int((left[:, problem.good] ** 2 @ weights).argmin())
    return float(angles[best]) if best < GRID else problem.reference_deg


def _gain(problem: TouchProblem, before: Fitted, after: Fitted) -> float:
    """By how much the misfit fell, in the later metric."""
    return problem.misfit(before.at, after.whitening) - after.misfit


def _leaves_room(found: Fitted) -> bool:
    """Whether a further touch could gain enough without leaving less than noise does."""
    freedom = max(found.freedom - 3, 1)
    least = max(freedom - LUCKY * math.sqrt(2.0 * freedom), 0.0)
    return found.misfit - least > THRESHOLD


def _pruned(problem: TouchProblem, found: Fitted) -> Fitted:
    """Converged, and without touches that the others explain after all."""
    while len(found.point.touches):
        found = refined(problem, found.at, *FINE)
        gains = _gains(found)
        weakest = int(gains.argmin())
        if gains[weakest] > DOUBTFUL * THRESHOLD:
            break
        fewer = refined(problem, problem.tangent(found.point.without(weakest)), *FINE)
        if _gain(problem, fewer, found) > THRESHOLD:
            break
        found = fewer
    return found


def _reconsidered(problem: TouchProblem, found: Fitted, candidates: Candidates) -> Fitted:
    """A better fit, if there is one, with one touch taken back and two put in its place.

    One touch after another finds the middle of two; pairs cannot be found so.
    """
    left_out = [found.point.without(i) for i in range(len(found.point.touches))]
    if len(found.point.touches) <= MOST_TOUCHES - 2:
        left_out.append(found.point)
    pairs = best_pairs(problem, left_out, found, candidates)
    best = found
    for _, start in sorted(pairs, key=lambda pair: pair[0])[:SECOND_LOOKS]:
        trial = refined(problem, problem.tangent(start), *FINE)
        more = len(trial.point.touches) - len(best.point.touches)
        if _gain(problem, best, trial) > THRESHOLD * more:
            best = trial
    return best if best is found else _pruned(problem, best)


def _gains(found: Fitted) -> Array:
    """How much the misfit would rise, to second order, were each touch's force zero."""
    variance = np.diagonal(lapack.inverse(found.quadratic.hessian))
    gains: Array = (found.point.touches[:, 2] / TOUCH_UNITS[2]) ** 2 / variance[3::3]
    return gains


def _explanation(found: Fitted, evidence: float, faults: tuple[Fault, ...]) -> Explanation:
    touches = found.point.touches
    covariance = lapack.inverse(found.quadratic.hessian)
    own = [slice(1 + 3 * i, 4 + 3 * i) for i in range(len(touches))]
    blocks = np.array([covariance[s, s] for s in own]).reshape(-1, 3, 3)
    return Explanation(
        found.point.angle_deg,
        ANGLE_UNIT * math.sqrt(covariance[0, 0]),
        touches,
        blocks * (TOUCH_UNITS[:, None] * TOUCH_UNITS),
        evidence,
        _gains(found),
        found.misfit,
        found.freedom,
        faults,
    )
