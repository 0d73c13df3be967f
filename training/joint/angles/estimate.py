"""Maximum-likelihood estimate of the bend angle of an untouched sensor."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eitskin.training.joint import lapack
from eitskin.training.joint.bend_curve import BendCurve
from eitskin.training.joint.channel_faults import (
    FAULT_THRESHOLD,
    MOST_FAULTS,
    SUSPICIOUS_SIGMA,
    ChannelFault,
    PossibleFaults,
    most_likely_fault,
)
from eitskin.training.joint.combinations import CombinedChange
from eitskin.training.joint.objective import BEYOND_DEG, misfit_sigma

Array = NDArray[np.float64]

GRID = 36  # angles among which the initial one is chosen
STEPS = 6  # of Fisher scoring at most
TOLERANCE_DEG = 3e-3


@dataclass(frozen=True, slots=True, eq=False)
class AngleEstimate:
    """Estimated bend angle of one frame.

    Attributes:
        angle_deg, deviation_deg: angle and its standard error [deg].
        misfit_sigma: misfit above its expectation, in standard deviations.
        faults: whose measurements were left out.
    """

    angle_deg: float
    deviation_deg: float
    misfit_sigma: float
    faults: tuple[ChannelFault, ...] = ()


def angle_standard_error(curve: BendCurve, angle_deg: float, noise: Array) -> float:
    """Standard error [deg] of the angle of one frame, from the Fisher information.

    Args:
        curve: of the specimen.
        angle_deg: of the bend [deg].
        noise: covariance of the frame's change (K, K).
    """
    slope = curve.slope(angle_deg)
    covariance = noise + curve.uncertainty(angle_deg)
    information = float(slope @ lapack.solve(covariance, slope))
    return 1.0 / math.sqrt(information)


def robust_angle(
    curve: BendCurve, combined: CombinedChange, possible: PossibleFaults
) -> AngleEstimate:
    """Estimate the angle of one frame, leaving out measurements that contradict the others.

    A contact that has changed since the reference was taken shifts the estimate by degrees. Where
    no angle fits the frame, the measurements of the fault that explains most of the residual are
    left out and the angle is estimated again.

    Args:
        curve: of the specimen.
        combined: of the change from the flat sensor.
        possible: faults that are considered.
    """
    faults: tuple[ChannelFault, ...] = ()
    while True:
        angle, deviation = estimate_angle(curve, combined.change, combined.noise)
        whitening = lapack.whitening(combined.noise + curve.uncertainty(angle))
        value, slope = curve.value_and_slope(angle)
        scale = math.sqrt(combined.frames)
        rest = combined.rest / scale
        residual = np.concatenate([whitening @ (combined.change - value), rest])
        sigma = misfit_sigma(float(residual @ residual), combined.count - 1)
        found = AngleEstimate(angle, deviation, sigma, faults)
        if sigma < SUSPICIOUS_SIGMA or len(faults) == MOST_FAULTS:
            return found
        jacobian = np.pad(whitening @ slope, (0, len(rest)))[:, None]
        seen, left = possible.seen_by(combined)
        directions = np.concatenate([whitening @ seen, left / scale])
        fault, gain = most_likely_fault(residual, jacobian, directions, possible)
        fewer = combined.without(fault.members)
        if gain < FAULT_THRESHOLD or fewer.count < len(fewer.good) // 2:
            return found
        combined, faults = fewer, (*faults, fault)


def estimate_angle(curve: BendCurve, change: Array, noise: Array) -> tuple[float, float]:
    """Angle [deg] and its standard error [deg] of one frame, by Fisher scoring.

    Every step regresses the residual on the curve's slope, in the metric of the noise and of the
    curve's own uncertainty at the present angle.

    Args:
        curve: of the specimen.
        change: from the flat sensor (K,).
        noise: covariance of the change (K, K), without the curve's uncertainty.
    """
    angles, values = curve.grid(GRID)
    white = (change - values) @ lapack.whitening(noise).T
    angle = float(angles[np.einsum("ij,ij->i", white, white).argmin()])
    (low, high), information = curve.angle_deg, 0.0
    for _ in range(STEPS):
        value, slope = curve.value_and_slope(angle)
        weighted = lapack.solve(noise + curve.uncertainty(angle), slope)
        information = float(weighted @ slope)
        step = float(weighted @ (change - value)) / information
        angle = min(max(angle + step, low - BEYOND_DEG), high + BEYOND_DEG)
        if abs(step) < TOLERANCE_DEG:
            break
    return angle, 1.0 / math.sqrt(information)
