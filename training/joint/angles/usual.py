"""Usual bend curves: those of the largest group of training specimens that bend alike.

A training set of many clamps may hold one of which it has far more sensors than of any other. One
normal distribution over all of them is so wide that some bend explains almost any frame. With the
usual curves beside it, a frame is judged by a mixture of both distributions.
"""

import math

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from eitskin.training.joint.bend_curve import BendCurvePrior
from eitskin.training.joint.bent_frames import BentFrames

Array = NDArray[np.float64]

FEWEST_SPECIMENS = 100  # that make a clamp usual
MOST_SHARE = 0.9  # of the specimens; beyond that all of them are of one clamp
ROUNDS = 3  # of assigning specimens and learning the curves of those assigned, at most
LEAST_GAIN = 2.0
"""Least mean of the log-likelihood ratio of a usual specimen that the usual curves were learned
without. The middle of one normal population gains nothing."""
HOLD_OUT = 5  # every how many-th specimen is held out for it
LOG_ODDS = math.log(1.0 / 50.0)
"""Logarithm of the odds that a sensor bends as usual, before any of its frames is seen: the usual
clamp counts as one of some fifty, however many of the training specimens it holds."""


def usual_curves(frames: BentFrames, everywhere: BendCurvePrior) -> BendCurvePrior | None:
    """Curves of the largest group of specimens that bend alike; None where there is none.

    The search begins with the closest neighbours that are to be found. Then, in turn, the curves of
    the group are learned, and every specimen belongs to the group whose curves are likelier by
    them than by those of all specimens (classification EM, Celeux and Govaert 1992).

    Args:
        frames: of all specimens.
        everywhere: distribution of the curves of all of them.
    """
    count = frames.specimens
    if count < 2 * FEWEST_SPECIMENS:
        return None
    member = _closest(frames.coordinates())
    likelihood = _log_likelihood(everywhere, frames)
    for _ in range(ROUNDS):
        prior = _learned(frames, member)
        log_odds = np.log(member.sum() / (count - member.sum()))
        before, member = member, _log_likelihood(prior, frames) - likelihood > -log_odds
        if not FEWEST_SPECIMENS <= member.sum() <= MOST_SHARE * count:
            return None
        if (member == before).all():
            break
    held_out = member & (np.arange(count) % HOLD_OUT == HOLD_OUT - 1)
    unseen = _log_likelihood(_learned(frames, member & ~held_out), frames) - likelihood
    if unseen[held_out].mean() < LEAST_GAIN:
        return None
    return _learned(frames, member)


def _closest(coordinates: Array) -> NDArray[np.bool_]:
    """Whether each specimen (S,) is of the `FEWEST_SPECIMENS` that lie closest together."""
    distance = cdist(coordinates, coordinates)
    radius = np.partition(distance, FEWEST_SPECIMENS - 1, axis=1)[:, FEWEST_SPECIMENS - 1]
    middle = int(radius.argmin())
    closest: NDArray[np.bool_] = distance[middle] <= radius[middle]
    return closest


def _learned(frames: BentFrames, member: NDArray[np.bool_]) -> BendCurvePrior:
    """Distribution of the curves of some specimens."""
    return BendCurvePrior.fit(frames[member[frames.specimen]])


def _log_likelihood(prior: BendCurvePrior, frames: BentFrames) -> Array:
    """Log-likelihood of each specimen (S,), without its mirror images."""
    return prior.log_likelihood(frames[frames.image == 0])
