"""The angle of an untouched sensor from its curve, by maximum likelihood."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eitskin.training.joint import lapack
from eitskin.training.joint.bend_curve import BendCurve
from eitskin.training.joint.channel_faults import EVIDENCE, Fault, PossibleFaults, likeliest
from eitskin.training.joint.objective import excess

Array = NDArray[np.float64]

GRID = 36  # angles from which the nearest is taken to start with
STEPS = 6  # of Fisher's scoring at most
SETTLED_DEG = 3e-3
SUSPECT = 3.0  # standard deviations of the misfit above which a fault is looked for
MOST_FAULTS = 2
BEYOND_DEG = 5.0  # how far outside of the angles learned from an estimate may lie


def angle_error(curve: BendCurve, angle_deg: float, noise: Array) -> float:
    """Standard error [deg] with which one frame's angle is known, where noise is (C, C)."""
    slope = curve.slope(angle_deg)
    covariance = noise + curve.uncertainty(angle_deg)
    information = float(slope @ lapack.solved(covariance, slope))
    return 1.0 / math.sqrt(information)


@dataclass(frozen=True, slots=True, eq=False)
class AngleEstimate:
    """The angle of one frame.

    Attributes:
        angle_deg, deviation_deg: and its standard error [deg].
        excess: of the misfit above its expectation, in standard deviations.
        faults: why measurements were left out.
    """

    angle_deg: float
    deviation_deg: float
    excess: float
    faults: tuple[Fault, ...] = ()


def checked_angle(
    curve: BendCurve, change: Array, noise: Array, possible: PossibleFaults
) -> AngleEstimate:
    """The angle of one frame, less the measurements that contradict all others.

    A contact that has changed since the reference was taken bends the sensor, in appearance, by
    degrees. Where no angle explains a frame, the fault that explains most of what is left is taken
    out, and the angle estimated again.
    """
    told: tuple[Fault, ...] = ()
    while True:
        angle, deviation = estimate_angle(curve, change, noise)
        good = np.flatnonzero(np.isfinite(change))
        whitening = lapack.whitening(_among(noise + curve.uncertainty(angle), good))
        value, slope = curve.tangent(angle)
        left = whitening @ (change - value)[good]
        found = AngleEstimate(angle, deviation, excess(float(left @ left), len(good) - 1), told)
        if found.excess < SUSPECT or len(told) == MOST_FAULTS:
            return found
        known = (whitening @ slope[good])[:, None]
        directions = whitening @ possible.changes[good]
        fault, gain = likeliest(left, known, directions, possible)
        rest = np.delete(good, np.isin(good, fault.members))
        if gain < EVIDENCE or len(rest) < len(change) // 2:
            return found
        change = change.copy()
        change[list(fault.members)] = np.nan
        told = (*told, fault)


def estimate_angle(curve: BendCurve, change: Array, noise: Array) -> tuple[float, float]:
    """Angle [deg] and its standard error [deg] of one frame.

    Args:
        curve: of the specimen.
        change: of log V from the flat sensor (C,); NaN where a measurement is bad.
        noise: its covariance (C, C), where the curve is certain.

    Fisher's scoring: the frame minus the curve at the present angle is regressed on the curve's
    slope there, in the metric of noise and the curve's own uncertainty at that angle.
    """
    good = np.flatnonzero(np.isfinite(change))
    N = _among(noise, good)
    angles, values = curve.grid(GRID)
    away = (change - values)[:, good] @ lapack.whitening(N).T
    angle = float(angles[np.einsum("ij,ij->i", away, away).argmin()])
    (low, high), information = curve.angle_deg, 0.0
    for _ in range(STEPS):
        value, slope = curve.tangent(angle)
        slope, left = slope[good], (change - value)[good]
        weighted = lapack.solved(N + _among(curve.uncertainty(angle), good), slope)
        information = float(weighted @ slope)
        step = float(weighted @ left) / information
        angle = min(max(angle + step, low - BEYOND_DEG), high + BEYOND_DEG)
        if abs(step) < SETTLED_DEG:
            break
    return angle, 1.0 / math.sqrt(information)


def _among(covariance: Array, good: NDArray[np.intp]) -> Array:
    """The part (n, n) of a covariance (C, C) that belongs to n of the measurements, in order."""
    return covariance if len(good) == len(covariance) else covariance[good[:, None], good]
