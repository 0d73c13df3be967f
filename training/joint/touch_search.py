"""Touches to begin a fit with, found in the residual, and touches that a fit does not need."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack
from scipy.spatial.distance import cdist

from eitskin.training.joint.fit_kernels import ANGLE_PRIOR_STD_DEG, ANGLE_UNIT
from eitskin.training.joint.objective import (
    FURTHER_THRESHOLD,
    TOUCH_THRESHOLD,
    Linearisation,
    MapEstimate,
    TouchObjective,
    Unknowns,
    levenberg_marquardt,
    solution,
)

Array = NDArray[np.float64]

MIN_DISTANCE = 0.7  # times the prior's separation: least distance of a candidate from a touch
RIVAL = 0.4  # share of the highest gain from which a second position is tried as well
DIVISION_STRIDE = 2  # the same of a pair in place of one touch
MIN_SPACING = 0.5  # of the least distance of touches: that of two in place of one
# gain to first order from which two touches in place of the only one are fitted
REFINEMENT_GAIN = -5.0
FAINT = 2.5  # times the least force: least of either
PAIR_STRIDE = 3  # every how many-th candidate may be one of a pair
FINE = (8, 0.03)  # Levenberg-Marquardt: most steps, tolerance of the misfit
USUAL_SIGMA = 2.0  # largest misfit that chance makes, above its expectation
PRUNING_LIMIT = 3.0  # times the threshold: gain, to second order, below which a touch is questioned


@dataclass(frozen=True, eq=False)
class TouchCandidates:
    """Positions that are tried for a further touch, and the effect of a touch there.

    Attributes:
        places: (n, 2) [m].
        force: force of every candidate [N].
        change: change by each (n, K), at one angle.
    """

    places: Array
    force: float
    change: Array

    @cached_property
    def pair_distances(self) -> Array:
        """Distances (m, m) [m] of those that may be one of a pair."""
        distances: Array = cdist(self.places[::PAIR_STRIDE], self.places[::PAIR_STRIDE])
        return distances


def initial_touches(objective: TouchObjective, places: Array, untouched: Linearisation) -> Unknowns:
    """Touches at `places` (k, 2) [m] with the forces of a linear ridge regression."""
    mean, deviation = objective.prior.force
    angle_deg = untouched.angle_deg
    touches = np.empty((len(places), 3))
    touches[:, :2], touches[:, 2] = places, mean
    whitening = objective.whitening(untouched)
    shapes = objective.linearise(Unknowns(touches, angle_deg)).changes @ whitening.T
    ridge = (mean / deviation) ** 2
    projections = shapes @ (whitening @ untouched.residual) + ridge
    share = solution(shapes @ shapes.T + ridge * np.eye(len(places)), projections)
    touches[:, 2] = np.clip(share * mean, objective.prior.low[2], objective.prior.high[2])
    return Unknowns(touches, angle_deg)


def single_starts(
    estimate: MapEstimate, candidates: TouchCandidates, least_gain: float
) -> list[Unknowns]:
    """Unknowns with one more touch where the misfit falls most, by at least `least_gain`.

    The first touch may fit nearly as well elsewhere, such as across the middle of the sensor: then
    there are two starts.
    """
    objective, unknowns = estimate.objective, estimate.unknowns
    strength, gain = further_touches(estimate, candidates)
    gain = np.where(_is_far_enough(objective, candidates.places, unknowns), gain, 0.0)
    starts: list[Unknowns] = []
    highest = float(gain.max())
    for _ in range(1 if len(unknowns.touches) else 2):
        best = int(gain.argmax())
        if gain[best] < max(least_gain, RIVAL * highest):
            break
        force = strength[best] * candidates.force
        force = np.clip(force, objective.prior.low[2], objective.prior.high[2])
        starts.append(unknowns.with_touches(np.array([[*candidates.places[best], force]])))
        away = np.hypot(*(candidates.places - candidates.places[best]).T)
        gain[away < 0.5 * objective.prior.separation] = 0.0
    return starts


def pair_starts(
    estimate: MapEstimate, replaced: Sequence[int | None], candidates: TouchCandidates
) -> list[tuple[float, Unknowns]]:
    """Best pairs of further touches, where there is room, and the misfit that each leaves.

    Two shapes with Gram matrix G and projections p of the residual lower the misfit by p^T G^-1 p.

    Args:
        estimate: estimate of the frame.
        replaced: number of the touch that a pair takes the place of; None for a pair next to all.
        candidates: touches, some of which may be one of a pair.

    Returns:
        misfit to first order, and unknowns with the pair.
    """
    objective = estimate.objective
    places, change = (each[::PAIR_STRIDE] for each in (candidates.places, candidates.change))
    apart = candidates.pair_distances > objective.prior.separation
    shapes = change @ estimate.whitening.T
    gram = shapes @ shapes.T
    limits = objective.prior.low[2], objective.prior.high[2]
    least, most = (limit / candidates.force for limit in limits)
    pairs = []
    for touch in replaced:
        unknowns, residual = estimate.unknowns, estimate.white[0]
        if touch is not None:
            unknowns = unknowns.without_touch(touch)
            residual = residual + estimate.whitening @ estimate.at.changes[touch]
        free = _is_far_enough(objective, places, unknowns)
        gain, *pair = _best_pair(gram, shapes @ residual, apart, free, least, most)
        if gain <= 0.0:
            continue
        touches = [[*places[i], candidates.force * strength] for i, strength in pair]
        pairs.append((float(residual @ residual) - gain, unknowns.with_touches(np.array(touches))))
    return pairs


def further_touches(estimate: MapEstimate, candidates: TouchCandidates) -> tuple[Array, Array]:
    """Strength of one more touch at each candidate, and by how much it lowers the misfit (n,)."""
    whitening = estimate.own_whitening
    shapes = candidates.change @ whitening.T
    # Directions that a change of the angle explains are no evidence of a touch.
    bend = whitening @ estimate.at.rows[1] * (ANGLE_PRIOR_STD_DEG / ANGLE_UNIT)
    bend /= np.sqrt(1.0 + bend @ bend)
    residual = whitening @ estimate.at.residual
    on_bend, on_residual = shapes @ bend, shapes @ residual
    sizes = np.einsum("nk,nk->n", shapes, shapes) - (2.0 - bend @ bend) * on_bend**2
    strength = (on_residual - on_bend * (bend @ residual)) / sizes
    return strength, np.where(strength > 0.0, strength**2 * sizes, 0.0)


def divisions(estimate: MapEstimate, candidates: TouchCandidates) -> Array:
    """Two touches in place of each of k, as near to it as a fit may take them for one (k, 2).

    By how much the best pair of forces that touches have lowers the misfit, to first order, minus
    infinity where there is none; and how far the farther of both is from the touch [m].
    """
    objective, divided = estimate.objective, np.tile([-np.inf, 0.0], (len(estimate.at.touches), 1))
    limits = objective.prior.low[2], objective.prior.high[2]
    least, most = FAINT * limits[0] / candidates.force, limits[1] / candidates.force
    rest = _project_out(
        estimate.white[1:], np.zeros((0, estimate.white.shape[1])), estimate.white[0]
    )[1]
    for number, (touch, change) in enumerate(
        zip(estimate.at.touches, estimate.at.changes, strict=True)
    ):
        away = np.hypot(*(candidates.places - touch[:2]).T)
        around = np.flatnonzero(away < objective.prior.separation)[::DIVISION_STRIDE]
        places, free = candidates.places[around], np.ones(len(around), bool)
        others = np.delete(estimate.white[1:], slice(1 + 3 * number, 4 + 3 * number), axis=0)
        shapes = candidates.change[around] @ estimate.whitening.T
        shapes, residual = _project_out(
            others, shapes, estimate.white[0] + estimate.whitening @ change
        )
        apart = cdist(places, places) > MIN_SPACING * objective.prior.separation
        gain, (one, a), (other, b) = _best_pair(
            shapes @ shapes.T, shapes @ residual, apart, free, least, most
        )
        if gain > 0.0:
            decrease = float(residual @ residual) - float(rest @ rest)
            divided[number] = gain - decrease, max(away[around[one]], away[around[other]])
        if len(estimate.at.touches) == 1 and divided[number, 0] > REFINEMENT_GAIN:
            pair = np.column_stack([places[[one, other]], candidates.force * np.array([a, b])])
            divided[number] = _refine_pair(estimate, pair)
    return divided


def _refine_pair(estimate: MapEstimate, pair: Array) -> tuple[float, float]:
    """Decrease of the misfit by a pair (2, 3) in place of a touch, fitted, and its distance [m]."""
    prior = estimate.objective.prior
    objective = replace(
        estimate.objective, prior=replace(prior, separation=MIN_SPACING * prior.separation)
    )
    fitted = levenberg_marquardt(
        objective, Unknowns(pair, estimate.at.angle_deg), *FINE, estimate.whitening
    )
    away = np.hypot(*(fitted.at.touches[:, :2] - estimate.at.touches[0, :2]).T)
    return estimate.misfit - fitted.misfit, float(away.max())


def _project_out(explained: Array, shapes: Array, residual: Array) -> tuple[Array, Array]:
    """Shapes (n, K) and a residual (K,) less what other changes (m, K) explain as well."""
    factors, tau, _, _ = lapack.dgeqrf(explained.T)
    basis = lapack.dorgqr(factors[:, : len(tau)], tau)[0]
    return shapes - (shapes @ basis) @ basis.T, residual - basis @ (basis.T @ residual)


def _best_pair(
    gram: Array,
    projections: Array,
    apart: NDArray[np.bool_],
    free: NDArray[np.bool_],
    least: float,
    most: float,
) -> tuple[float, tuple[int, float], tuple[int, float]]:
    """The pair of shapes that lowers the misfit most, each of a strength within limits.

    Args:
        gram, projections: products of the shapes (m, m), and with the residual (m,).
        apart: whether two places are far enough from each other (m, m).
        free: whether a place is far enough from other touches (m,).
        least, most: strengths.

    Returns:
        decrease of the misfit, zero for no pair; number and strength of each shape.
    """
    size, p = np.diag(gram).copy(), projections
    sizes = np.outer(size, size)
    first = (np.outer(p, size) - gram * p) / np.maximum(sizes - gram * gram, 1e-9 * sizes)
    allowed = apart & (first > least) & (first < most) & free
    gain = (first.T * p).T
    gain = np.where(allowed & allowed.T, gain + gain.T, 0.0)
    a, b = divmod(int(gain.argmax()), len(p))
    return gain[a, b], (a, first[a, b]), (b, first[b, a])


def _is_far_enough(
    objective: TouchObjective, places: Array, unknowns: Unknowns
) -> NDArray[np.bool_]:
    """Whether each of `places` (n, 2) is far enough from the present touches (n,)."""
    least = (MIN_DISTANCE * objective.prior.separation) ** 2
    x, y = places.T
    apart = np.ones(len(places), bool)
    for at_x, at_y, _ in unknowns.touches.tolist():
        apart &= (x - at_x) ** 2 + (y - at_y) ** 2 > least
    return apart


def prune(estimate: MapEstimate) -> MapEstimate:
    """The converged estimate without touches that the others make superfluous."""
    while len(estimate.at.touches):
        start = estimate.objective, estimate.at
        estimate = levenberg_marquardt(*start, *FINE, estimate.own_whitening)
        # A touch that is held at the least force would rather be weaker, or not there.
        faint = estimate.at.touches[:, 2] <= estimate.objective.prior.low[2]
        gains = np.where(faint, 0.0, estimate.gains)
        weakest, threshold = int(gains.argmin()), _threshold_of_weakest(estimate)
        if gains[weakest] > PRUNING_LIMIT * threshold:
            break
        fewer = _without_touch(estimate, weakest, threshold)
        if estimate.misfit_decrease(fewer) > threshold:
            break
        estimate = fewer
    return estimate


def _threshold_of_weakest(estimate: MapEstimate) -> float:
    """Least gain of the weakest touch of an estimate.

    Where the estimate leaves more misfit than chance would, errors are larger than the model has
    them, and further touches gain more by chance in proportion (Birge 1932). That anything touches
    at all needs no more evidence: without the touch still more would be left.
    """
    if len(estimate.at.touches) < 2:
        return TOUCH_THRESHOLD
    usual = estimate.degrees_of_freedom + USUAL_SIGMA * math.sqrt(2.0 * estimate.degrees_of_freedom)
    return FURTHER_THRESHOLD * max(estimate.misfit / usual, 1.0)


def _without_touch(estimate: MapEstimate, touch: int, threshold: float) -> MapEstimate:
    """The estimate without one touch; one that has not converged where the touch is needed."""
    objective = estimate.objective
    others = objective.linearise(estimate.unknowns.without_touch(touch))
    whitening = objective.whitening(others)
    goal = estimate.misfit + threshold  # in the metric of `estimate`
    goal *= objective.misfit(others, whitening) / objective.misfit(others, estimate.whitening)
    return levenberg_marquardt(objective, others, *FINE, whitening, goal)
