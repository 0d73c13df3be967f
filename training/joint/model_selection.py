"""Model selection: the number of touches, their MAP estimate, and faulty measurements of one frame.

A network proposes positions and Levenberg-Marquardt fits angle, positions and forces together. As
in matching pursuit, further touches are sought in the residual; each must lower the misfit by more
than chance would. A bar or disc that explains the frame about as well is a rival.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from eitskin.training.joint.channel_faults import (
    ACCEPTED_SIGMA,
    MAX_FAULTS,
    ChannelFault,
    PossibleFaults,
    fit_with_fault,
    gross_fault,
)
from eitskin.training.joint.combinations import CombinedChange
from eitskin.training.joint.fit_kernels import ANGLE_UNIT, OPTIMISM, TOUCH_UNITS
from eitskin.training.joint.objective import (
    TOUCH_THRESHOLD,
    Linearisation,
    MapEstimate,
    TouchObjective,
    Unknowns,
    inverse,
    levenberg_marquardt,
    price,
    solution,
)
from eitskin.training.joint.touch_response import MAX_TOUCHES, SpecimenResponse
from eitskin.training.joint.touch_search import (
    FINE,
    TouchCandidates,
    divisions,
    further_touches,
    initial_touches,
    pair_starts,
    prune,
    single_starts,
)

Array = NDArray[np.float64]
Seen: TypeAlias = list[tuple[MapEstimate, MapEstimate]]
"""Estimates that fits came by, and those that they ended with."""
Propose: TypeAlias = Callable[[], Array]
"""Positions (k, 2) [m] that fits of touches start from, where these are wanted."""

ANGLE_GRID = 15  # angles among which the initial one is chosen
COARSE = (4, 0.5)  # as `FINE`, of fits that are continued
DIVIDED_ODDS = 0.01  # that a touch is two, before it is seen, times the share of pairs that may be
START_THRESHOLD = 0.5  # times the threshold: least gain, to first order, of a start
REPORTED_SIGMA = 6.0  # misfit above its expectation from which it is reported
TOUCHED_SIGMA = (6.0, 4.5, 4.5, 3.5, 2.5)
"""The same of 0, 1, ... touches: the more unknowns, the less of another kind of touch is left."""
CHI2_LOW_SIGMA, CHI2_HIGH_SIGMA = 2.0, 2.0  # the misfit's usual range about its expectation
# Motion since the reference from which touches are fitted from there as well, where the first fit
# explains the frame and where it does not.
FAR_DEG, NEAR_DEG = 5.0, 1.0
# rise of the misfit from one estimate to another, below which both are taken for one
SAME_RISE = 4.0
PAIR_TRIALS = 2  # fits that split one touch into two where the misfit is unusually high
ALLOWANCE = (6.0, 30.0, 50.0)
"""Most that a wide contact, of five or six unknowns, may raise the misfit of 2, 3, ... touches to
be a rival: each touch that it spares has three unknowns, and a wide contact less odds."""
STEPS, TOLERANCE = 7, 0.5  # of the fit of a wide contact, and promise of its misfit at the end
FAR = 20.0  # improbability above that of a fit, from which another response is not fitted
HINT = 8.0  # decrease of the misfit, to first order, from which a touch may be there
DAMPING, LIGHTER, HEAVIER = 1e-2, 0.2, 6.0  # of its steps, and factors after good and bad ones
SIZE_UNIT, LEAST_SIZE = 0.010, 0.005  # m, unit step of half lengths and radii, and the least first
# m, spread of touches across that may be a bar, and that may be a disc
WIDTH, RADIUS = 0.010, 0.025
WEAKEST = 0.1  # times the least force of a touch: least of each point of a wide contact
_TURNS = np.arange(6) * np.pi / 3.0
_RING = np.column_stack([np.cos(_TURNS), np.sin(_TURNS)])
BAR = np.linspace(-1.0, 1.0, 5)[:, None, None] * np.eye(2)
DISC = np.concatenate([np.zeros((1, 2)), _RING])[:, :, None]
"""Places of n points by the size of a contact, a half length (2,) or a radius (1,), (n, 2, m)."""


@dataclass(frozen=True, slots=True, eq=False)
class WideContact:
    """A bar or disc of even pressure.

    Attributes:
        misfit: rise of the misfit that it makes in place of the touches of an estimate.
        centre: x and y [m].
        length: length of the bar, or diameter of the disc [m].
    """

    misfit: float
    centre: Array
    length: float


def wide_rival(estimate: MapEstimate) -> WideContact | None:
    """The likelier of a bar and a disc in place of all touches of an estimate; None if unlikely.

    Next to a single touch chance alone makes one likely.
    """
    touches = estimate.at.touches
    if len(touches) < 2:
        return None
    share = touches[:, 2] / touches[:, 2].sum()
    centre = share @ touches[:, :2]
    spread = touches[:, :2] - centre
    values, vectors = np.linalg.eigh((share[:, None] * spread).T @ spread)
    half, radius = np.sqrt(np.maximum([2.0 * values[1], 1.2 * values.sum()], LEAST_SIZE**2))
    starts = []
    if values[0] < WIDTH**2:
        starts.append((BAR, half * vectors[:, 1]))
    if values.sum() < RADIUS**2:
        starts.append((DISC, np.array([radius])))
    rivals = [_fit_contact(estimate, shape, centre, size) for shape, size in starts]
    return min(filter(None, rivals), key=lambda each: each.misfit, default=None)


def _fit_contact(
    estimate: MapEstimate, shape: Array, centre: Array, size: Array
) -> WideContact | None:
    """Contact of points centre + shape (n, 2, m) size (m,) of equal forces, by least squares.

    None where it cannot become a rival.
    """
    objective, count = estimate.objective, len(shape)
    prior, residual = objective.prior, estimate.white[0]
    limit = float(residual @ residual) + ALLOWANCE[len(estimate.at.touches) - 2]
    units = np.concatenate([[ANGLE_UNIT], TOUCH_UNITS, np.full(len(size), SIZE_UNIT)])
    across, eye = shape.reshape(2 * count, -1).T, np.eye(len(units))

    def rows(unknowns: Array) -> Array:
        points = unknowns[1:3] + shape @ unknowns[4:]
        touches = np.empty((count, 3))
        touches[:, :2] = np.minimum(np.maximum(points, prior.low[:2]), prior.high[:2])
        touches[:, 2] = unknowns[3]
        each = objective.linearise(Unknowns(touches, float(unknowns[0]))).rows
        by_point = each[2:].reshape(count, 3, -1)
        by_size = across @ by_point[:, :2].reshape(2 * count, -1)
        return np.concatenate([each[:2], by_point.sum(axis=0), by_size]) @ estimate.whitening.T

    unknowns = np.array(
        [estimate.at.angle_deg, *centre, estimate.at.touches[:, 2].sum() / count, *size]
    )
    white, damping = rows(unknowns), DAMPING
    for _ in range(STEPS):
        products = white @ white.T
        information = products[1:, 1:] * (1.0 + damping * eye) + 1e-3 * eye
        step = solution(information, products[0, 1:])
        promised = float(step @ products[0, 1:])
        if promised < TOLERANCE or products[0, 0] - OPTIMISM * promised > limit:
            break
        trial = unknowns + units * step / max(1.0, float(np.abs(step).max()))
        trial[3] = max(trial[3], WEAKEST * prior.low[2])
        tried = rows(trial)
        if tried[0] @ tried[0] < products[0, 0]:
            unknowns, white = trial, tried
            damping *= LIGHTER
        else:
            damping *= HEAVIER
    misfit = float(white[0] @ white[0])
    if misfit > limit:
        return None
    rise = misfit - float(residual @ residual)
    return WideContact(rise, unknowns[1:3], 2.0 * float(np.linalg.norm(unknowns[4:])))


@dataclass(slots=True, eq=False)
class FrameFit:
    """Selected model of one frame and the estimates of its unknowns.

    Covariances grow by the misfit per degree of freedom where that is above one: the errors of a
    frame that the model explains badly are larger than it has them (Birge 1932).

    Attributes:
        estimate: estimate from which all follows.
        evidence: decrease of the misfit by the first touch, even where that was rejected.
        faults: whose measurements were left out.
        rival: faults that explain the frame about as well as its touches, in words.
        faint: decrease of the misfit by a touch where none is estimated, to first order.
        division: two touches in place of each: the same, and how far from it they are (k, 2).
        wide: wide contact that explains the frame about as well as its touches, if any.
        touches: x [m], y [m] and force [N] of each (k, 3).
        angle_deg: bend angle [deg].
        angle_deviation_deg: standard error of its change since the reference [deg].
        covariance: covariance of each touch's x, y and force (k, 3, 3).
        misfit: sum of squares of the whitened residual, with its remainder, and the prior's terms.
        degrees_of_freedom: number of measurements minus number of unknowns.
    """

    estimate: MapEstimate
    evidence: float
    faults: tuple[ChannelFault, ...] = ()
    rival: str = ""
    faint: float = 0.0
    division: Array = field(default_factory=lambda: np.zeros((0, 2)))
    wide: WideContact | None = None
    touches: Array = field(init=False)
    angle_deg: float = field(init=False)
    angle_deviation_deg: float = field(init=False)
    covariance: Array = field(init=False)
    misfit: float = field(init=False)
    degrees_of_freedom: int = field(init=False)

    def __post_init__(self) -> None:
        """Give the estimate in physical units, with its covariances."""
        estimate = self.estimate
        self.touches, self.angle_deg = estimate.minimum(FINE[1])
        _, self.misfit, self.degrees_of_freedom = estimate.whole
        covariance = max(estimate.misfit / estimate.degrees_of_freedom, 1.0) * inverse(
            estimate.hessian
        )
        self.angle_deviation_deg = ANGLE_UNIT * math.sqrt(covariance[0, 0])
        blocks = [slice(1 + 3 * i, 4 + 3 * i) for i in range(len(self.touches))]
        of_touches = np.array([covariance[block, block] for block in blocks]).reshape(-1, 3, 3)
        self.covariance = of_touches * (TOUCH_UNITS[:, None] * TOUCH_UNITS)

    @classmethod
    def without_touches(
        cls, objective: TouchObjective, faults: tuple[ChannelFault, ...] = ()
    ) -> "FrameFit":
        """Fit without touches, of a frame whose `faults` were taken out."""
        nothing = Unknowns(np.zeros((0, 3)), objective.reference_deg)
        return cls(levenberg_marquardt(objective, nothing, *FINE), 0.0, faults)

    def take_touches_out(self, change: CombinedChange) -> CombinedChange:
        """The change less that by the touches, whose errors count as noise."""
        response = self.estimate.objective.response
        by_touches, *slopes = response.with_derivatives(self.touches, self.angle_deg)
        slopes_of_each = np.stack(slopes, axis=1)
        further = np.tensordot(
            slopes_of_each, self.covariance @ slopes_of_each, axes=([0, 1], [0, 1])
        )
        rest = change.measured - by_touches.sum(axis=0) @ change.combinations.back
        return replace(change, measured=np.where(change.good, rest, 0.0), further=further)

    @property
    def hidden_variance(self) -> Array:
        """Variance of the place of each touch by what may be two touches (k,) [m2]."""
        odds = DIVIDED_ODDS * np.exp(np.minimum(0.5 * self.division[:, 0], 50.0))
        share: Array = odds / (1.0 + odds) * self.division[:, 1] ** 2
        return share


@dataclass(frozen=True, eq=False)
class PlainFit:
    """Fit to one frame before divided touches and wide contacts are tried.

    Attributes:
        untouched: estimate without touches.
        best: the best estimate.
        evidence: decrease of the misfit by the first touch, even where that was rejected.
        candidates: positions that are tried for further touches.
        faults: whose measurements were left out.
    """

    untouched: MapEstimate
    best: MapEstimate
    evidence: float
    candidates: TouchCandidates
    faults: tuple[ChannelFault, ...] = ()

    @cached_property
    def faint(self) -> float:
        """Decrease of the misfit by one more touch, to first order."""
        return float(further_touches(self.best, self.candidates)[1].max(initial=0.0))

    @property
    def may_be_touched(self) -> bool:
        """Whether the frame has touches, or may have, as by another response."""
        poor = self.best.misfit_sigma > CHI2_HIGH_SIGMA
        return bool(len(self.best.at.touches)) or poor or self.faint > HINT

    def may_fit_better(self, response: SpecimenResponse) -> bool:
        """Whether another response may be likelier, by its fit from where this one ended.

        From touches that this one explains well, a response that does not hold is far away.
        """
        if not len(self.best.at.touches) or self.best.misfit_sigma > CHI2_HIGH_SIGMA:
            return True
        objective = replace(self.best.objective, response=response)
        tried = levenberg_marquardt(objective, self.best.unknowns, *COARSE)
        return tried.improbability < self.best.improbability + FAR

    def without_faults(self, possible: PossibleFaults) -> "PlainFit":
        """The fit without the measurements of those `possible` faults that explain more."""
        fit = self
        if fault := gross_fault(self.untouched, self.best, possible):
            fewer = self.best.objective.combined.drop(fault.members)
            again = fit_plain(replace(self.best.objective, combined=fewer), self.candidates)
            if again.best.whole_sigma < ACCEPTED_SIGMA:
                fit = replace(again, faults=(fault,))
        while len(fit.faults) < MAX_FAULTS:
            better = fit_with_fault(fit.untouched, fit.best, possible)
            if better is None:
                break
            fault, best = better
            untouched = levenberg_marquardt(best.objective, fit.untouched.unknowns, *FINE)
            evidence, faults = best.misfit_decrease(untouched), (*fit.faults, fault)
            fit = PlainFit(untouched, best, evidence, self.candidates, faults)
        return fit

    def complete(self) -> FrameFit:
        """The fit with divided touches, and a wide contact in place of touches."""
        best, faint = self.best, 0.0 if len(self.best.at.touches) else self.faint
        division = divisions(best, self.candidates)
        return FrameFit(best, self.evidence, self.faults, "", faint, division, wide_rival(best))


def fit_plain(
    objective: TouchObjective, candidates: TouchCandidates, propose: Propose | None = None
) -> PlainFit:
    """Select the number of touches and estimate bend and touches of one frame.

    Where the frame is explained without touches, and none is hinted at, none is tried.

    Touches that look like a large bend draw the fit far away, where the bend curve is uncertain
    and nothing leads back. So a fit that ends far from the reference, or explains the frame badly,
    is begun again at the reference's angle: a fit that explains the frame is better than one that
    does not, else the likelier one is. The likeliest of several such starts is fitted to the end,
    and only where it leads elsewhere.

    Args:
        objective: objective of the frame.
        candidates: positions that are tried for further touches.
        propose: positions from which the fit starts; none by default.
    """
    nothing = Unknowns(np.zeros((0, 3)), _initial_angle(objective))
    untouched = levenberg_marquardt(objective, nothing, *FINE)
    plain = PlainFit(untouched, untouched, 0.0, candidates)
    if not _may_gain(untouched) and plain.faint <= HINT:
        return plain

    def proposal(at: Linearisation) -> list[Unknowns]:
        places = propose() if propose else np.zeros((0, 2))
        return [initial_touches(objective, places, at)] if len(places) else []

    def minimise_from(start: Unknowns) -> MapEstimate:
        return levenberg_marquardt(objective, start, *COARSE)

    begun = [minimise_from(start) for start in proposal(untouched.at)] or [untouched]
    fits: Seen = []
    best_fit, evidence = _fit(candidates, untouched, begun[0], fits)
    moved = abs(best_fit.at.angle_deg - objective.reference_deg)
    least = NEAR_DEG if best_fit.misfit_sigma > CHI2_HIGH_SIGMA else FAR_DEG
    if not len(best_fit.at.touches) or moved < least:
        return PlainFit(untouched, best_fit, evidence, candidates)
    still = objective.reference_deg
    starts = [best_fit.unknowns._replace(angle_deg=still)]
    starts += proposal(objective.linearise(nothing._replace(angle_deg=still)))
    begun = [each for each in map(minimise_from, starts) if _earlier_minimum(each, fits) is None]
    if not begun:
        return PlainFit(untouched, best_fit, evidence, candidates)
    again, _ = _fit(candidates, untouched, min(begun, key=lambda trial: trial.improbability), fits)
    if again is best_fit:
        return PlainFit(untouched, best_fit, evidence, candidates)
    best = min(
        (best_fit, again),
        key=lambda trial: (trial.misfit_sigma > CHI2_HIGH_SIGMA, trial.improbability),
    )
    evidence = evidence if best is best_fit else best.misfit_decrease(untouched)
    return PlainFit(untouched, best, evidence, candidates)


def _fit(
    candidates: TouchCandidates, untouched: MapEstimate, started: MapEstimate, fits: Seen
) -> tuple[MapEstimate, float]:
    """The best estimate from a first one, with touches or without, and the evidence of any touch.

    A fit ends where it meets an estimate that an earlier one has `fits`, with what that led to.
    """
    best_fit, evidence = untouched, 0.0
    if len(started.at.touches):
        evidence = started.misfit_decrease(untouched)
        if evidence > TOUCH_THRESHOLD:
            best_fit = started
    most = MAX_TOUCHES if len(candidates.places) else 0  # none where no touch was learned
    while len(best_fit.at.touches) < most and _may_gain(best_fit):
        least = price(len(best_fit.at.touches) + 1) - price(len(best_fit.at.touches))
        starts = single_starts(best_fit, candidates, START_THRESHOLD * least)
        if not starts:
            break
        trials = [levenberg_marquardt(best_fit.objective, start, *COARSE) for start in starts]
        more = min(trials, key=lambda trial: trial.misfit)
        gain = more.misfit_decrease(best_fit)
        evidence = max(evidence, gain)
        if gain < least:
            break
        best_fit = more
    best = alone = prune(best_fit)
    if (earlier_minimum := _earlier_minimum(alone, fits)) is not None:
        return earlier_minimum, evidence
    if alone.misfit_sigma > CHI2_HIGH_SIGMA and len(alone.at.touches) < most:
        best = _split(alone, candidates)
    fits += [(alone, best), (best, best)]
    return best, evidence


def _earlier_minimum(estimate: MapEstimate, fits: Seen) -> MapEstimate | None:
    """Fit of an earlier start that `estimate` is equal to within its standard errors."""
    for earlier_fit, best in fits:
        if misfit_rise(estimate, earlier_fit) < SAME_RISE:
            return best
    return None


def misfit_rise(estimate: MapEstimate, second: MapEstimate) -> float:
    """Rise of the misfit from an estimate to another one, to second order.

    Infinite to one with another number of touches, or with touches elsewhere.
    """
    mine, others = estimate.at.touches, second.at.touches
    if len(mine) != len(others):
        return math.inf
    away = (others[:, None] - mine) / TOUCH_UNITS  # their order may differ
    nearest = np.einsum("ijc,ijc->ij", away, away).argmin(axis=0) if len(mine) else np.arange(0)
    if len(set(nearest.tolist())) < len(mine):
        return math.inf
    turned = (second.at.angle_deg - estimate.at.angle_deg) / ANGLE_UNIT
    step = np.concatenate([[turned], away[nearest, np.arange(len(mine))].ravel()])
    return float(step @ estimate.hessian @ step)


def _initial_angle(objective: TouchObjective) -> float:
    """The angle [deg], of a grid and the reference's, at which the bend alone fits best."""
    angles, values = objective.curve.grid(ANGLE_GRID)
    bend = objective.reference_bend
    residual = objective.combined.change + bend - np.concatenate([values, bend[None]])
    weights = 1.0 / np.diagonal(objective.combined.noise)
    best = int((residual**2 @ weights).argmin())
    return float(angles[best]) if best < ANGLE_GRID else objective.reference_deg


def _may_gain(estimate: MapEstimate) -> bool:
    """Whether a further touch could gain enough and leave a misfit that noise could cause."""
    degrees_of_freedom = max(estimate.degrees_of_freedom - 3, 1)
    lowest = max(degrees_of_freedom - CHI2_LOW_SIGMA * math.sqrt(2.0 * degrees_of_freedom), 0.0)
    touches = len(estimate.at.touches)
    return estimate.misfit - lowest > price(touches + 1) - price(touches)


def _split(estimate: MapEstimate, candidates: TouchCandidates) -> MapEstimate:
    """The better of the estimate and those in which two touches replace one.

    The greedy search finds the middle of two touches instead of the pair.
    """
    objective = estimate.objective
    replaced: list[int | None] = list(range(len(estimate.at.touches)))
    if len(estimate.at.touches) <= MAX_TOUCHES - 2:
        replaced.append(None)
    pairs = pair_starts(estimate, replaced, candidates)
    best = estimate
    for _, start in sorted(pairs, key=lambda pair: pair[0])[:PAIR_TRIALS]:
        at = objective.linearise(start)
        whitening = objective.whitening(at)
        more = price(len(start.touches)) - price(len(best.at.touches))
        goal = objective.misfit(best.at, whitening) - more
        trial = levenberg_marquardt(objective, at, *FINE, whitening, goal)
        if trial.misfit < goal:
            best = trial
    return best if best is estimate else prune(best)
