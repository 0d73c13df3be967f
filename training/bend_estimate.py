"""The angle of an untouched sensor from its curve, by maximum likelihood."""

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from eitskin.training.bend_curve import BendCurve

Array = NDArray[np.float64]

GRID = 36  # angles from which the nearest is taken to start with
STEPS = 6  # of Fisher's scoring at most
SETTLED_DEG = 1e-3
BEYOND_DEG = 5.0  # how far outside of the angles learned from an estimate may lie


def angle_error(curve: BendCurve, angle_deg: float, noise: Array) -> float:
    """Standard error [deg] with which one frame's angle is known, where noise is (C, C)."""
    slope = curve.slope(angle_deg)
    covariance = noise + curve.uncertainty(angle_deg)
    return float(1.0 / np.sqrt(slope @ cho_solve(cho_factor(covariance), slope)))


def estimate_angle(curve: BendCurve, change: Array, noise: Array) -> tuple[float, float]:
    """Angle [deg] and its standard error [deg] of one frame.

    Args:
        curve: of the specimen.
        change: of log V from the flat sensor (C,); NaN where a measurement is bad.
        noise: its covariance (C, C), where the curve is certain.

    Fisher's scoring: the frame minus the curve at the present angle is regressed on the curve's
    slope there, in the metric of noise and the curve's own uncertainty at that angle.
    """
    good = np.isfinite(change)
    y, N = change[good], noise[np.ix_(good, good)]
    low, high = curve.angle_deg
    angles = np.linspace(low, high, GRID)
    away = y - curve.value(angles)[:, good]
    angle = float(angles[np.sum(away * cho_solve(cho_factor(N), away.T).T, axis=1).argmin()])
    information = 0.0
    for _ in range(STEPS):
        covariance = N + curve.uncertainty(angle)[np.ix_(good, good)]
        slope = curve.slope(angle)[good]
        weighted = cho_solve(cho_factor(covariance), slope)
        information = float(weighted @ slope)
        step = float(weighted @ (y - curve.value(angle)[good])) / information
        angle = float(np.clip(angle + step, low - BEYOND_DEG, high + BEYOND_DEG))
        if abs(step) < SETTLED_DEG:
            break
    return angle, information**-0.5
