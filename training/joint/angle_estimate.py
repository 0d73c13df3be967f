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
        noise: covariance of the frame's change of log V (C, C).
    """
    slope = curve.slope(angle_deg)
    covariance = noise + curve.uncertainty(angle_deg)
    information = float(slope @ lapack.solve(covariance, slope))
    return 1.0 / math.sqrt(information)


def robust_angle(
    curve: BendCurve, change: Array, noise: Array, possible: PossibleFaults
) -> AngleEstimate:
    """Estimate the angle of one frame, leaving out measurements that contradict the others.

    A contact that has changed since the reference was taken shifts the estimate by degrees. Where
    no angle fits the frame, the measurements of the fault that explains most of the residual are
    left out and the angle is estimated again.

    Args:
        curve: of the specimen.
        change: of log V from the flat sensor (C,); NaN where a measurement is bad.
        noise: covariance of the change (C, C).
        possible: faults that are considered.
    """
    faults: tuple[ChannelFault, ...] = ()
    while True:
        angle, deviation = estimate_angle(curve, change, noise)
        good = np.flatnonzero(np.isfinite(change))
        whitening = lapack.whitening(_submatrix(noise + curve.uncertainty(angle), good))
        value, slope = curve.value_and_slope(angle)
        residual = whitening @ (change - value)[good]
        sigma = misfit_sigma(float(residual @ residual), len(good) - 1)
        found = AngleEstimate(angle, deviation, sigma, faults)
        if sigma < SUSPICIOUS_SIGMA or len(faults) == MOST_FAULTS:
            return found
        jacobian = (whitening @ slope[good])[:, None]
        directions = whitening @ possible.changes[good]
        fault, gain = most_likely_fault(residual, jacobian, directions, possible)
        rest = np.delete(good, np.isin(good, fault.members))
        if gain < FAULT_THRESHOLD or len(rest) < len(change) // 2:
            return found
        change = change.copy()
        change[list(fault.members)] = np.nan
        faults = (*faults, fault)


def estimate_angle(curve: BendCurve, change: Array, noise: Array) -> tuple[float, float]:
    """Angle [deg] and its standard error [deg] of one frame, by Fisher scoring.

    Every step regresses the residual on the curve's slope, in the metric of the noise and of the
    curve's own uncertainty at the present angle.

    Args:
        curve: of the specimen.
        change: of log V from the flat sensor (C,); NaN where a measurement is bad.
        noise: covariance of the change (C, C), without the curve's uncertainty.
    """
    good = np.flatnonzero(np.isfinite(change))
    N = _submatrix(noise, good)
    angles, values = curve.grid(GRID)
    white = (change - values)[:, good] @ lapack.whitening(N).T
    angle = float(angles[np.einsum("ij,ij->i", white, white).argmin()])
    (low, high), information = curve.angle_deg, 0.0
    for _ in range(STEPS):
        value, slope = curve.value_and_slope(angle)
        slope, residual = slope[good], (change - value)[good]
        weighted = lapack.solve(N + _submatrix(curve.uncertainty(angle), good), slope)
        information = float(weighted @ slope)
        step = float(weighted @ residual) / information
        angle = min(max(angle + step, low - BEYOND_DEG), high + BEYOND_DEG)
        if abs(step) < TOLERANCE_DEG:
            break
    return angle, 1.0 / math.sqrt(information)


def _submatrix(covariance: Array, good: NDArray[np.intp]) -> Array:
    """Rows and columns `good` of a covariance (C, C)."""
    return covariance if len(good) == len(covariance) else covariance[good[:, None], good]
