"""Gains of touches, and estimates without the touches that the others make superfluous."""

import math

import numpy as np
from numpy.typing import NDArray

from eitskin.training.joint.fit import lapack
from eitskin.training.joint.fit.objective import MapEstimate, TouchObjective, levenberg_marquardt
from eitskin.training.joint.prior import TOUCH_UNITS

Array = NDArray[np.float64]

TOUCH_THRESHOLD = 25.0
"""Least decrease of the misfit by a touch. The decrease by a touch that is not there is the largest
of some fifty chi-square variables of three degrees of freedom, above this once in 1000 frames."""
FURTHER_THRESHOLD = 20.0
"""The same of a touch beside others: above this once in 100 frames. Several touches are missed more
often than one is made up."""

FINE = (8, 0.03)  # Levenberg-Marquardt: most steps, tolerance of the misfit
USUAL_SIGMA = 2.0  # largest misfit that chance makes, above its expectation
PRUNING_LIMIT = 3.0  # times the threshold: gain, to second order, below which a touch is questioned


def price(touches: int) -> float:
    """Decrease of the misfit that is asked of so many touches together."""
    return TOUCH_THRESHOLD + FURTHER_THRESHOLD * (touches - 1) if touches else 0.0


def price_of_next(touches: int) -> float:
    """Decrease of the misfit that is asked of a touch beside so many others."""
    return price(touches + 1) - price(touches)


def improbability(found: MapEstimate) -> float:
    """Minus twice the logarithm of a model's posterior density, but for a constant."""
    return found.improbability + price(len(found.unknowns.touches))


def pruned(objective: TouchObjective, found: MapEstimate) -> MapEstimate:
    """The converged estimate without touches that the others make superfluous."""
    while len(found.unknowns.touches):
        found = levenberg_marquardt(objective, found.at, *FINE)
        # A touch that is held at the least force would rather be weaker, or not there.
        faint = found.unknowns.touches[:, 2] <= objective.prior.low[2]
        gains = np.where(faint, 0.0, gains_of(found))
        weakest, threshold = int(gains.argmin()), threshold_of(found)
        if gains[weakest] > PRUNING_LIMIT * threshold:
            break
        fewer = _without(objective, found, weakest, threshold)
        if gain_of(objective, fewer, found) > threshold:
            break
        found = fewer
    return found


def threshold_of(found: MapEstimate) -> float:
    """Least gain of the weakest touch of an estimate.

    Where the estimate leaves more misfit than chance would, errors are larger than the model has
    them, and further touches gain more by chance in proportion (Birge 1932). That anything touches
    at all needs no more evidence: without the touch still more would be left.
    """
    if len(found.unknowns.touches) < 2:
        return TOUCH_THRESHOLD
    usual = found.degrees_of_freedom + USUAL_SIGMA * math.sqrt(2.0 * found.degrees_of_freedom)
    return FURTHER_THRESHOLD * max(found.misfit / usual, 1.0)


def _without(
    objective: TouchObjective, found: MapEstimate, touch: int, threshold: float
) -> MapEstimate:
    """The estimate without one touch; one that has not converged where the touch is needed."""
    others = objective.linearised(found.unknowns.without_touch(touch))
    whitening = objective.whitening(others)
    goal = found.misfit + threshold  # in the metric of `found`
    goal *= objective.misfit(others, whitening) / objective.misfit(others, found.whitening)
    return levenberg_marquardt(objective, others, *FINE, whitening, goal)


def gain_of(objective: TouchObjective, before: MapEstimate, after: MapEstimate) -> float:
    """Decrease of the misfit from one estimate to another, in the metric of the latter."""
    return objective.misfit(before.at, after.whitening) - after.misfit


def gains_of(found: MapEstimate) -> Array:
    """Rise of the misfit, to second order, were each touch's force zero (k,)."""
    variance = np.diagonal(lapack.inverse(found.quadratic.hessian))
    gains: Array = (found.unknowns.touches[:, 2] / TOUCH_UNITS[2]) ** 2 / variance[3::3]
    return gains
