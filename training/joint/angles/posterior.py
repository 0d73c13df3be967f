"""Posterior of the bend angle of an untouched frame, where it is no normal distribution.

Scoring gives the likeliest angle, and the standard error by the curve's slope there. Where the
curve is little known and flattens, as towards the largest angles, the posterior is skewed or has
further modes; its mean errs less than the likeliest angle, and its width tells of them.
"""

import math
from dataclasses import replace

import numpy as np

from eitskin.training.joint.angles.estimate import AngleEstimate, grid_log_densities
from eitskin.training.joint.bend_curve import BEYOND_DEG, BendCurve
from eitskin.training.joint.combinations import CombinedChange

STEP_DEG = 1.0  # of the angles over which posteriors are summed
DECAY_DEG = 1.0  # beyond the angles learned, in which the prior falls by a factor of e
NORMAL_DEG = 0.4
"""Standard error below which a single mode counts as normal: sums of this step do not resolve it,
and curves are straight over so few degrees."""
ONE_MODE = 0.99  # least share of the posterior within three standard errors


def posterior_angle(
    curve: BendCurve, combined: CombinedChange, likeliest: AngleEstimate
) -> AngleEstimate:
    """Mean and standard deviation of the angle.

    Before it is measured, any angle learned is as likely as another, and those beyond are less so.

    The variance of everything that the frame is weighed by grows with the misfit per degree of
    freedom, where this exceeds one (Birge 1932): a curve that explains no frame well tells less of
    the angle than it says.

    Args:
        curve: of the specimen.
        combined: of the change from the flat sensor.
        likeliest: estimate by that curve.
    """
    freedom = max(combined.count - len(likeliest.left_out) - 1, 1)
    misfit = freedom + likeliest.misfit_sigma * math.sqrt(2.0 * freedom)
    excess = max(misfit / freedom, 1.0)
    deviation = likeliest.deviation_deg * math.sqrt(excess)
    fewer = combined.without(likeliest.left_out) if likeliest.faults else combined
    low, high = curve.angle_deg
    angles = np.arange(low - BEYOND_DEG, high + BEYOND_DEG + STEP_DEG / 2, STEP_DEG)
    logs = grid_log_densities(curve, angles, fewer.change, fewer.noise) / excess
    logs -= np.maximum(np.maximum(low - angles, angles - high), 0.0) / DECAY_DEG
    share = np.exp(logs - logs.max())
    share /= share.sum()
    near = np.abs(angles - likeliest.angle_deg) < 3.0 * max(deviation, STEP_DEG)
    if deviation < NORMAL_DEG and share[near].sum() > ONE_MODE:
        return replace(likeliest, deviation_deg=deviation)
    mean = float(share @ angles)
    spread = math.sqrt(float(share @ (angles - mean) ** 2))
    return replace(likeliest, angle_deg=mean, deviation_deg=max(spread, NORMAL_DEG))
