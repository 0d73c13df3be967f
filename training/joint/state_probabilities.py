"""Probabilities of the states of a sensor from the fit of one frame."""

import numpy as np
from numpy.typing import NDArray

from eitskin.training.joint.angles.estimate import AngleEstimate
from eitskin.training.joint.fit.model_selection import FrameFit
from eitskin.training.joint.fit.touch_search import TOUCH_THRESHOLD

Array = NDArray[np.float64]

REJECTED = TOUCH_THRESHOLD - 2.0  # highest evidence that a rejected touch may leave


def state_probabilities(
    found: FrameFit, bend: AngleEstimate, bends: tuple[float, float] | None, touches: bool
) -> Array:
    """Probabilities of idle, touch and bend (3,); NaN for touch or bend where not learned.

    Touch follows from the evidence of the first touch. Flat or bent by an angle uniform over those
    learned follows from Bayes' rule for one normal measurement: that by the bend curve, which meets
    zero exactly, where there is one.

    Args:
        found: fit of the frame.
        bend: angle of the sensor, if it is untouched.
        bends: range of the angles learned [deg]; None where no bend was learned.
        touches: whether touches were learned.
    """
    # A rejected touch must not make touch the most probable state.
    evidence = found.evidence if len(found.touches) else min(found.evidence, REJECTED)
    touched = 1.0 / (1.0 + np.exp(-np.clip(0.5 * (evidence - TOUCH_THRESHOLD), -30, 30)))
    if bends is None:
        return np.array([1 - touched, touched, np.nan])
    angle_deg, deviation_deg = bend.from_flat
    bent = deviation_deg * np.sqrt(2 * np.pi) / (bends[1] - bends[0])
    bent *= np.exp(np.minimum(0.5 * (angle_deg / deviation_deg) ** 2, 700.0))
    flat = 1.0 / (1.0 + bent)
    if not touches:
        return np.array([flat, np.nan, 1 - flat])
    return np.array([(1 - touched) * flat, touched, (1 - touched) * (1 - flat)])
