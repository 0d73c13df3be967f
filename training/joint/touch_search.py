"""Where a fit may start: places that would explain what is left of a frame, to first order."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eitskin.training.joint import lapack
from eitskin.training.joint.objective import FEARED_MOTION, Fitted, Point, Tangent, TouchProblem

Array = NDArray[np.float64]

CLOSEST = 0.7  # times the least separation seen: how near to a touch another is looked for
RIVAL = 0.4  # share of the best promise from which on a second place is tried as well
PAIR_STRIDE = 3  # every how many-th candidate may be of a pair


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


def with_forces(problem: TouchProblem, places: Array, untouched: Tangent) -> Point:
    """Touches at these places (k, 2) [m], with forces that suit together to first order."""
    mean, deviation = problem.habits.force
    angle_deg = untouched.point.angle_deg
    touches = np.empty((len(places), 3))
    touches[:, :2], touches[:, 2] = places, mean
    whitening = problem.whitening(untouched)
    shapes = problem.response(touches, angle_deg) @ whitening.T
    ridge = (mean / deviation) ** 2
    wanted = shapes @ (whitening @ untouched.left) + ridge
    share = lapack.solved(shapes @ shapes.T + ridge * np.eye(len(places)), wanted)
    touches[:, 2] = np.clip(share * mean, problem.habits.low[2], problem.habits.high[2])
    return Point(touches, angle_deg)


def most_promising(
    problem: TouchProblem, found: Fitted, candidates: Candidates, least_gain: float
) -> list[Point]:
    """Points with one more touch where it would gain most, if that is at least `least_gain`.

    The first touch may lie nearly as well elsewhere, such as across the middle of the sensor:
    then there are two.
    """
    point = found.point
    whitening = problem.whitening(found.at)
    left = whitening @ found.at.left
    shapes = candidates.change @ whitening.T
    # What a change of the angle explains is no evidence of a touch.
    bend = whitening @ found.at.bend_slope * FEARED_MOTION
    bend /= np.sqrt(1.0 + bend @ bend)
    shapes = shapes - np.outer(shapes @ bend, bend)
    sizes = np.sum(shapes**2, axis=1)
    strength = shapes @ left / sizes
    gain = np.where((strength > 0) & _free(problem, candidates.places, point), 1.0, 0.0)
    gain *= strength**2 * sizes
    starts: list[Point] = []
    highest = float(gain.max())
    for _ in range(1 if len(point.touches) else 2):
        best = int(gain.argmax())
        if gain[best] < max(least_gain, RIVAL * highest):
            break
        force = strength[best] * candidates.force
        force = np.clip(force, problem.habits.low[2], problem.habits.high[2])
        starts.append(point.beside(np.array([[*candidates.places[best], force]])))
        away = np.hypot(*(candidates.places - candidates.places[best]).T)
        gain[away < 0.5 * problem.habits.separation] = 0.0
    return starts


def best_pairs(
    problem: TouchProblem, others: Sequence[Point], found: Fitted, candidates: Candidates
) -> list[tuple[float, Point]]:
    """For each of `others`, promised misfit of, and point with, the two candidates that suit best.

    Two shapes with Gram matrix G and projections p explain p^T G^-1 p of a residual.
    """
    places = candidates.places[::PAIR_STRIDE]
    shapes = candidates.change[::PAIR_STRIDE] @ found.whitening.T
    gram = shapes @ shapes.T
    size = np.diagonal(gram)
    sizes = size[:, None] * size
    determinant = np.maximum(sizes - gram**2, 1e-9 * sizes)
    low, high = problem.habits.low[2] / candidates.force, problem.habits.high[2] / candidates.force
    apart = np.hypot(*(places[:, None] - places).T) > problem.habits.separation
    pairs = []
    for point in others:
        left = found.whitening @ problem.left_by(point)
        p = shapes @ left
        first = (p[:, None] * size - gram * p) / determinant
        allowed = apart & (first > low) & (first < high)
        gain = first * p[:, None]
        free = _free(problem, places, point)
        gain = np.where(allowed & allowed.T & free[:, None] & free, gain + gain.T, 0.0)
        a, b = np.unravel_index(int(gain.argmax()), gain.shape)
        forces = candidates.force * np.array([first[a, b], first[b, a]])
        pair = np.column_stack([places[[a, b]], forces])
        pairs.append((float(left @ left - gain[a, b]), point.beside(pair)))
    return pairs


def _free(problem: TouchProblem, places: Array, point: Point) -> NDArray[np.bool_]:
    """Which places (n, 2) are far enough from the touches of `point`."""
    if not len(point.touches):
        return np.ones(len(places), bool)
    away = np.linalg.norm(places[:, None] - point.touches[:, :2], axis=2)
    free: NDArray[np.bool_] = (away > CLOSEST * problem.habits.separation).all(axis=1)
    return free
