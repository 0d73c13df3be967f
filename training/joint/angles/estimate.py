"""Maximum-likelihood estimate of the bend angle of an untouched sensor."""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit

from eitskin.training.joint.bend_curve import BEYOND_DEG, BendCurve
from eitskin.training.joint.combinations import CombinedChange
from eitskin.training.joint.fit import lapack
from eitskin.training.joint.fit.channel_faults import (
    FAULT_THRESHOLD,
    MOST_FAULTS,
    SUSPICIOUS_SIGMA,
    ChannelFault,
    PossibleFaults,
    most_likely_fault,
)
from eitskin.training.joint.fit.objective import misfit_sigma

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
        log_evidence: logarithm of the density of the frame, whatever its angle, but for a constant
            (Laplace's approximation).
        usual: probability that the sensor bends as usual (`usual.py`).
        by_curve: angle and standard error [deg] by the bend curve, where networks tell the angle.
    """

    angle_deg: float
    deviation_deg: float
    misfit_sigma: float
    faults: tuple[ChannelFault, ...] = ()
    log_evidence: float = 0.0
    usual: float = 0.0
    by_curve: tuple[float, float] | None = None

    @property
    def from_flat(self) -> tuple[float, float]:
        """Angle and standard error [deg] by which bent is told from flat."""
        return self.by_curve or (self.angle_deg, self.deviation_deg)

    @property
    def left_out(self) -> list[int]:
        """Numbers of the measurements that were left out."""
        return [member for fault in self.faults for member in fault.members]


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
        found, residual, whitening = _judged(
            curve, combined, estimate_angle(curve, combined.change, combined.noise)
        )
        if found.misfit_sigma >= SUSPICIOUS_SIGMA:  # perhaps at a local minimum
            likeliest = likeliest_angle(curve, combined.change, combined.noise)
            again = estimate_angle(curve, combined.change, combined.noise, likeliest)
            other = _judged(curve, combined, again)
            if other[0].log_evidence > found.log_evidence:
                found, residual, whitening = other
        found = replace(found, faults=faults)
        if found.misfit_sigma < SUSPICIOUS_SIGMA or len(faults) == MOST_FAULTS:
            return found
        jacobian = whitening @ curve.slope(found.angle_deg)
        jacobian = np.pad(jacobian, (0, len(residual) - len(jacobian)))[:, None]
        seen, left = possible.seen_by(combined)
        directions = np.concatenate([whitening @ seen, left / math.sqrt(combined.frames)])
        fault, gain = most_likely_fault(residual, jacobian, directions, possible)
        fewer = combined.without(fault.members)
        if gain < FAULT_THRESHOLD or fewer.count < len(fewer.good) // 2:
            return found
        combined, faults = fewer, (*faults, fault)


def _judged(
    curve: BendCurve, combined: CombinedChange, estimate: tuple[float, float]
) -> tuple[AngleEstimate, Array, Array]:
    """An estimate with its misfit and evidence, the whitened residual, and its metric (K, K)."""
    angle, deviation = estimate
    whitening = lapack.whitening(combined.noise + curve.uncertainty(angle))
    rest = combined.rest / math.sqrt(combined.frames)
    residual = np.concatenate([whitening @ (combined.change - curve.value(angle)), rest])
    misfit = float(residual @ residual)
    width = 2.0 * float(np.sum(np.log(np.diagonal(whitening))))
    evidence = 0.5 * (width - misfit) + math.log(deviation)
    sigma = misfit_sigma(misfit, combined.count - 1)
    return AngleEstimate(angle, deviation, sigma, (), evidence), residual, whitening


def grid_log_densities(curve: BendCurve, angles: Array, change: Array, noise: Array) -> Array:
    """Logarithms of the densities of a change at angles (n,) [deg], but for a constant (n,).

    Further arguments are those of `estimate_angle`.
    """
    factors = np.linalg.cholesky(noise + curve.uncertainties(angles))
    residuals = (change - curve.value(angles))[:, :, None]
    white = np.linalg.solve(factors, residuals)[:, :, 0]
    widths = np.log(np.diagonal(factors, axis1=1, axis2=2)).sum(axis=1)
    return np.asarray(-widths - 0.5 * np.sum(white**2, axis=1))


def likeliest_angle(curve: BendCurve, change: Array, noise: Array) -> float:
    """The likeliest of a grid of angles [deg]; arguments as of `estimate_angle`."""
    angles, _ = curve.grid(GRID)
    return float(angles[grid_log_densities(curve, angles, change, noise).argmax()])


def estimate_angle(
    curve: BendCurve, change: Array, noise: Array, start_deg: float | None = None
) -> tuple[float, float]:
    """Angle [deg] and its standard error [deg] of one frame, by Fisher scoring.

    Every step regresses the residual on the curve's slope, in the metric of the noise and of the
    curve's own uncertainty at the present angle.

    Args:
        curve: of the specimen.
        change: from the flat sensor (K,).
        noise: covariance of the change (K, K), without the curve's uncertainty.
        start_deg: where the search begins [deg]; at the angle of a grid that fits best in the
            metric of the noise by default.
    """
    if start_deg is None:
        angles, values = curve.grid(GRID)
        white = (change - values) @ lapack.whitening(noise).T
        start_deg = float(angles[np.einsum("ij,ij->i", white, white).argmin()])
    angle = start_deg
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


def mixed(other: AngleEstimate, usual: AngleEstimate, log_odds: float) -> AngleEstimate:
    """Mean and standard error of an angle under two hypotheses, by their evidence.

    Faults and misfit are those of the likelier one.

    Args:
        other: estimate for a sensor of any clamp.
        usual: estimate for one that bends as usual, of the same measurements.
        log_odds: logarithm of the odds of the second before the frame is seen.
    """
    share = float(expit(usual.log_evidence - other.log_evidence + log_odds))
    parts = ((other.angle_deg, other.deviation_deg), (usual.angle_deg, usual.deviation_deg))
    angle, deviation = mixture_moments(*parts, share)
    likelier = usual if share > 0.5 else other
    return replace(likelier, angle_deg=angle, deviation_deg=deviation, usual=share)


def mixture_moments(
    first: tuple[float, float], second: tuple[float, float], share: float
) -> tuple[float, float]:
    """Mean and standard deviation of a mixture of two distributions with those given.

    Args:
        first, second: means and standard deviations.
        share: of the second.
    """
    mean = (1.0 - share) * first[0] + share * second[0]
    square = (1.0 - share) * (first[1] ** 2 + (first[0] - mean) ** 2)
    square += share * (second[1] ** 2 + (second[0] - mean) ** 2)
    return mean, math.sqrt(square)
