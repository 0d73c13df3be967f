"""Frames drawn from the joint model of the smooth sensor, and their fits."""

from dataclasses import replace

import numpy as np

from eitskin.training.joint.channel_faults import possible_faults
from eitskin.training.joint.model_selection import fit_plain
from eitskin.training.joint.objective import TouchObjective
from eitskin.training.joint.touch_search import TouchCandidates

from smooth_sensor import (
    FLAT,
    MEASUREMENTS,
    NOISE,
    PROTOCOL,
    RANGES,
    TOUCH_PRIOR,
    curve,
    places,
    response,
)

RESPONSE = response()
CURVE = curve()
FAULTS = possible_faults(PROTOCOL, FLAT)
ONE = RESPONSE.for_specimen(())
STIFF = replace(
    RESPONSE, weights=(RESPONSE.weights[0] * [1.0, 1.0, 1.0, 0.0], *RESPONSE.weights[1:])
).for_specimen(())
TWO_FRAMES = 2.0 * NOISE**2 * np.eye(28)  # covariance of the difference of two


def candidates(angle_deg=0.0):
    touches = np.column_stack([places(), np.full(len(places()), RANGES.middle_force)])
    return TouchCandidates(places(), RANGES.middle_force, ONE(touches, angle_deg))


def frame(touches=(), angle_deg=0.0, reference_deg=0.0, rng=None, mismatch=0.0):
    """Objective of a frame drawn from the model itself."""
    touches = np.array(touches, dtype=float).reshape(-1, 3)
    change = CURVE.value(angle_deg) - CURVE.value(reference_deg)
    change = change + ONE(touches, angle_deg).sum(axis=0)
    if rng is not None:
        change = change + rng.multivariate_normal(np.zeros(28), TWO_FRAMES)
    told = replace(RESPONSE, mismatch=mismatch).for_specimen(())
    combined = MEASUREMENTS.combine(change, 2.0, 0.0)
    return TouchObjective(combined, reference_deg, told, CURVE, TOUCH_PRIOR)


def residual(objective, unknowns):
    """Measured minus modelled change by the plain formula."""
    bend = objective.curve.value([unknowns.angle_deg, objective.reference_deg])
    left = objective.combined.change - bend[0] + bend[1]
    return left - objective.response(unknowns.touches, unknowns.angle_deg).sum(axis=0)


def changed(objective, change):
    """Objective with another change."""
    return replace(objective, combined=MEASUREMENTS.combine(change, 2.0, 0.0))


def explained(objective):
    return (
        fit_plain(objective, candidates(objective.reference_deg)).without_faults(FAULTS).complete()
    )


TOUCHES = {
    1: [[0.045, 0.021, 8.0]],
    2: [[0.030, 0.040, 6.0], [0.110, 0.020, 10.0]],
    3: [[0.025, 0.020, 8.0], [0.075, 0.040, 9.0], [0.125, 0.025, 7.0]],
    4: [[0.020, 0.045, 8.0], [0.055, 0.015, 7.0], [0.095, 0.044, 9.0], [0.130, 0.016, 8.0]],
}
