"""Model of one specimen: its response, its touch candidates, and its bend angle when untouched.

Three estimators give the angle: the bend curve of any sensor, that of a sensor of the usual clamp,
and networks, where there are some. `SpecimenModel.angle` combines them.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit

from eitskin.compiled import implementation
from eitskin.training.joint.bend_curve import BEYOND_DEG, BendCurve
from eitskin.training.joint.channel_faults import (
    FAULT_THRESHOLD,
    MAX_FAULTS,
    SUSPICIOUS_SIGMA,
    ChannelFault,
    PossibleFaults,
)
from eitskin.training.joint.combinations import CombinedChange
from eitskin.training.joint.fit_kernels import KERNELS
from eitskin.training.joint.networks import AngleNetworks
from eitskin.training.joint.objective import misfit_sigma, solution, whitening_matrix
from eitskin.training.joint.touch_response import SpecimenResponse, TouchResponse
from eitskin.training.joint.touch_search import TouchCandidates

Array = NDArray[np.float64]

GRID = 36  # angles among which the initial one is chosen
POSTERIOR_STEP_DEG = 1.0  # of the angles over which posteriors are summed
DECAY_DEG = 1.0  # beyond the angles learned, in which the prior falls by a factor of e
NORMAL_DEG = 0.4
"""Standard error below which a single mode counts as normal: sums of this step do not resolve it,
and curves are straight over so few degrees."""
ONE_MODE = 0.99  # least share of the posterior within three standard errors
CONTRADICTION = 3.0  # standard errors between angles that contradict each other
BLEND_START_DEG = 5.0
"""Angle below which the bend curve counts the more, the nearer: it meets zero exactly."""
BLEND_END_DEG = 20.0
"""Angle by a bend curve beyond which it does not count where networks see no bend: curves of any
clamp are so wide there that a large bend explains almost any frame."""
LOG_ODDS = math.log(1.0 / 50.0)
"""Logarithm of the odds that a sensor bends as usual, before any of its frames is seen: the usual
clamp counts as one of some fifty, however many of the training specimens it holds."""
RIVAL = 2.0 * math.log(20.0)  # of improbabilities; what is likelier by less does not settle it
MIN_BEND_DEVIATIONS = 2.0  # standard errors below which no bend is claimed, and no fault looked for
TEMPER = 0.7
"""Power of the evidence for the usual clamp in standard errors: a clamp near it fits as well."""
MOVED_DEG = 1.0  # by which a fit must differ from its flat reference to need a second one
MAX_ANGLES = 8  # estimates of angles that are kept
STEP_DEG = 10.0  # of the angles at which touch candidates are kept


@dataclass(frozen=True, slots=True, eq=False)
class AngleEstimate:
    """Estimated bend angle of one frame.

    Attributes:
        angle_deg, deviation_deg: angle and its standard error [deg].
        misfit_sigma: misfit above its expectation, in standard deviations.
        faults: whose measurements were left out.
        log_evidence: logarithm of the density of the frame, whatever its angle, but for a constant
            (Laplace's approximation).
        usual: probability that the sensor bends as usual.
        usual_curve: number of the usual curve that it then has.
        rival: faults of a flat sensor that explain the frame about as well, in words.
        by_curve: angle and standard error [deg] by the bend curve, where networks show the angle.
    """

    angle_deg: float
    deviation_deg: float
    misfit_sigma: float
    faults: tuple[ChannelFault, ...] = ()
    log_evidence: float = 0.0
    usual: float = 0.0
    usual_curve: int = 0
    by_curve: tuple[float, float] | None = None
    rival: str = ""

    @property
    def from_flat(self) -> tuple[float, float]:
        """Angle and standard error [deg] by which bent is reported from flat."""
        return self.by_curve or (self.angle_deg, self.deviation_deg)

    @property
    def left_out(self) -> list[int]:
        """Numbers of the measurements that were left out."""
        return [member for fault in self.faults for member in fault.members]


def estimate_angle(
    curve: BendCurve, change: Array, noise: Array, start_deg: float | None = None
) -> tuple[float, float]:
    """Angle [deg] and its standard error [deg] of one frame, by Fisher scoring.

    Args:
        curve: curve of the specimen.
        change: change from the flat sensor (K,).
        noise: covariance of the change (K, K), without the curve's uncertainty.
        start_deg: first angle of the search [deg]; the best of a grid in the metric of the noise.
    """
    angle, information, _, _ = _score_angle(curve, change, noise, start_deg)
    return angle, 1.0 / math.sqrt(information)


def _score_angle(
    curve: BendCurve, change: Array, noise: Array, start_deg: float | None
) -> tuple[float, float, Array, float]:
    """`score_angle` of the kernels from an angle or the best of a grid."""
    kernels, change = implementation(KERNELS), np.ascontiguousarray(change)
    noise = np.ascontiguousarray(noise)
    if start_deg is None:
        angles, values = curve.grid(GRID)
        white, _ = kernels.whiten(noise, change - values)
        start_deg = float(angles[np.einsum("ij,ij->i", white, white).argmin()])
    low, high = curve.angle_deg
    limits = low - BEYOND_DEG, high + BEYOND_DEG
    scored: tuple[float, float, Array, float] = kernels.score_angle(
        curve.coefficients, curve.blocks, change, noise, start_deg, limits
    )
    return scored


def angle_standard_error(curve: BendCurve, angle_deg: float, noise: Array) -> float:
    """Standard error [deg] of the angle of one frame with covariance (K, K), by Fisher's bound."""
    slope = curve.slope(angle_deg)
    information = float(slope @ solution(noise + curve.uncertainty(angle_deg), slope))
    return 1.0 / math.sqrt(information)


def grid_log_densities(
    curve: BendCurve, angles: Array, values: Array, combined: CombinedChange
) -> Array:
    """Logarithms of the densities of a frame at angles (n,) [deg], but for a constant (n,).

    The curve has the values (n, K) there.
    """
    spreads, kernels = curve.uncertainties(angles), implementation(KERNELS)
    densities: Array = kernels.log_densities(combined.change, values, combined.noise, spreads)
    return densities


def robust_angle(
    curves: Sequence[BendCurve], combined: CombinedChange, possible: PossibleFaults
) -> AngleEstimate:
    """Estimate the angle of one frame, leaving out measurements that contradict the others.

    A contact that has changed since the reference was taken shifts the estimate by degrees. Where
    no angle fits the frame, the measurements of the fault that explains most of the residual are
    left out and the angle is estimated again. Where there are several curves, all leave out one
    more fault at a time, until one of them ends; the likeliest of those that end counts.
    """
    nothing = AngleEstimate(0.0, 0.0, 0.0)
    tried = [(replace(nothing, usual_curve=n), combined) for n in range(len(curves))]
    while True:
        fits = [(*_estimate(curves[one.usual_curve], fewer, one), fewer) for one, fewer in tried]
        tried = []
        for estimate, residual, slope, fewer in sorted(fits, key=lambda fit: -fit[0].log_evidence):
            if estimate.misfit_sigma < SUSPICIOUS_SIGMA or len(estimate.faults) == MAX_FAULTS:
                return estimate
            spread = curves[estimate.usual_curve].uncertainty(estimate.angle_deg)
            whitening, scale = whitening_matrix(fewer.noise + spread), math.sqrt(fewer.frames)
            fault, gain = possible.likeliest(fewer, whitening, scale, residual, slope[:, None])
            fewest = fewer.drop(fault.members)
            if gain < FAULT_THRESHOLD or fewest.count < len(fewest.good) // 2:
                return estimate
            tried.append((replace(estimate, faults=(*estimate.faults, fault)), fewest))


def _estimate(
    curve: BendCurve, combined: CombinedChange, before: AngleEstimate
) -> tuple[AngleEstimate, Array, Array]:
    """`estimate_angle` with its misfit, and the residual and the curve's slope (K,) whitened.

    The curve's number and the faults are those of an estimate before. A fit that may have ended at
    a local minimum is begun again.
    """

    def fit(start_deg: float | None) -> tuple[AngleEstimate, Array, Array]:
        angle, information, (residual, slope), width = _score_angle(
            curve, combined.change, combined.noise, start_deg
        )
        deviation = 1.0 / math.sqrt(information)
        residual = np.concatenate([residual, combined.rest / math.sqrt(combined.frames)])
        misfit = float(residual @ residual)
        fitted = replace(
            before,
            angle_deg=angle,
            deviation_deg=deviation,
            misfit_sigma=misfit_sigma(misfit, combined.count - 1),
            log_evidence=math.log(deviation) - width - 0.5 * misfit,
        )
        return fitted, residual, slope

    first = fit(None)
    if first[0].misfit_sigma < SUSPICIOUS_SIGMA:
        return first
    angles, values = curve.grid(GRID)
    start = float(angles[grid_log_densities(curve, angles, values, combined).argmax()])
    if abs(start - first[0].angle_deg) <= angles[1] - angles[0]:
        return first
    return max(first, fit(start), key=lambda fitted: fitted[0].log_evidence)


def mixture_moments(
    first: tuple[float, float], second: tuple[float, float], share: float
) -> tuple[float, float]:
    """Mean and standard deviation of a mixture of two distributions with those given.

    The second has the `share`.
    """
    mean = (1.0 - share) * first[0] + share * second[0]
    square = (1.0 - share) * (first[1] ** 2 + (first[0] - mean) ** 2)
    square += share * (second[1] ** 2 + (second[0] - mean) ** 2)
    return mean, math.sqrt(square)


def blend_angles(curve: tuple[float, float], networks: tuple[float, float]) -> tuple[float, float]:
    """Angle and its standard error [deg] from those by the bend curve and by the networks.

    Near zero the curve counts; the networks alone do from `BLEND_START_DEG` on their own on, or
    `BLEND_END_DEG` by the curve.
    """
    far = (abs(curve[0]) - BLEND_START_DEG) / (BLEND_END_DEG - BLEND_START_DEG)
    share = min(max(abs(networks[0]) / BLEND_START_DEG, far), 1.0)
    angle, deviation = np.add(np.multiply(1.0 - share, curve), np.multiply(share, networks))
    return float(angle), float(deviation)


def posterior_angle(
    curve: BendCurve, combined: CombinedChange, likeliest: AngleEstimate
) -> AngleEstimate:
    """Mean and standard deviation of the angle.

    Before it is measured, any angle learned is as likely as another, and those beyond are less so.

    The variance of everything that the frame is weighed by grows with the misfit per degree of
    freedom, where this exceeds one (Birge 1932): a curve that explains no frame well shows less of
    the angle than it says.
    """
    freedom = max(combined.count - len(likeliest.left_out) - 1, 1)
    misfit = freedom + likeliest.misfit_sigma * math.sqrt(2.0 * freedom)
    excess = max(misfit / freedom, 1.0)
    deviation = likeliest.deviation_deg * math.sqrt(excess)
    fewer = combined.drop(likeliest.left_out) if likeliest.faults else combined
    low, high = curve.angle_deg
    angles = np.arange(
        low - BEYOND_DEG, high + BEYOND_DEG + POSTERIOR_STEP_DEG / 2, POSTERIOR_STEP_DEG
    )
    logs = grid_log_densities(curve, angles, curve.value(angles), fewer) / excess
    logs -= np.maximum(np.maximum(low - angles, angles - high), 0.0) / DECAY_DEG
    share = np.exp(logs - logs.max())
    share /= share.sum()
    near = np.abs(angles - likeliest.angle_deg) < 3.0 * max(deviation, POSTERIOR_STEP_DEG)
    if deviation < NORMAL_DEG and share[near].sum() > ONE_MODE:
        return replace(likeliest, deviation_deg=deviation)
    mean = float(share @ angles)
    spread = math.sqrt(float(share @ (angles - mean) ** 2))
    return replace(likeliest, angle_deg=mean, deviation_deg=max(spread, NORMAL_DEG))


@dataclass(eq=False)
class SpecimenModel:
    """The learned model for one specimen.

    Attributes:
        features: features of the specimen (P,).
        response: response to touches.
        curve: curve of bending.
        faults: faults that are considered.
        problems: reasons to doubt the model, in words.
        networks: networks of the angle, with the features that they are given; None without.
        usual: bend curves, one of which is the specimen's should it bend as usual; none where
            nothing is usual or the curve is known.
        second: another response that it may have, as to touches on plates, and the features that
            this is given; None where none was learned or the response is known.
    """

    features: Array
    response: SpecimenResponse
    curve: BendCurve
    faults: PossibleFaults
    problems: tuple[str, ...] = ()
    networks: tuple[AngleNetworks, Array] | None = None
    usual: tuple[BendCurve, ...] = ()
    second: tuple[TouchResponse, Array] | None = None
    _angles: dict[bytes, AngleEstimate] = field(default_factory=dict, init=False)
    _candidates: dict[int, TouchCandidates] = field(default_factory=dict, init=False)

    @cached_property
    def other(self) -> "SpecimenModel | None":
        """The model with the other response, if there is one."""
        if self.second is None:
            return None
        response, features = self.second
        return replace(self, response=response.for_specimen(features), second=None)

    def angle(self, combined: CombinedChange) -> AngleEstimate:
        """Bend angle of an untouched frame by its change from the flat sensor.

        The latest estimates are kept, because a reference stays the same while a touch lasts.
        """
        key = combined.change.tobytes() + combined.noise.tobytes()
        if key not in self._angles:
            bend = self._angle(combined)
            if len(self._angles) == MAX_ANGLES:
                self._angles.pop(next(iter(self._angles)))
            self._angles[key] = self._flat_but_for_a_contact(combined, bend) or bend
        return self._angles[key]

    def likeliest_usual(self, change: Array, noise: Array) -> BendCurve:
        """The usual curve by which a change (K,) with covariance (K, K) is likeliest."""

        def log_evidence(curve: BendCurve) -> float:
            _, information, (residual, _), width = _score_angle(curve, change, noise, None)
            return -0.5 * math.log(information) - width - 0.5 * float(residual @ residual)

        return max(self.usual, key=log_evidence)

    def bends_since(self, reference: AngleEstimate, angle_deg: float) -> bool:
        """Whether a frame at an angle shows how a sensor bends that was flat in its reference."""
        flat = bool(self.usual) and reference.angle_deg == 0.0
        return flat and abs(angle_deg) >= MOVED_DEG

    def _flat_but_for_a_contact(
        self, combined: CombinedChange, bend: AngleEstimate
    ) -> AngleEstimate | None:
        """Estimate of a flat sensor with changed contacts or a measurement, where it is likelier.

        A contact that changes moves its channels as some clamp's bend does. Both are weighed by the
        evidence, the bend uniform over the angles learned.
        """
        if abs(bend.angle_deg) < MIN_BEND_DEVIATIONS * bend.deviation_deg:
            return None
        fewer = combined.drop(bend.left_out) if bend.faults else combined
        low, high = self.curve.angle_deg
        bent = -2.0 * (bend.log_evidence + math.log(math.sqrt(2.0 * math.pi) / (high - low)))
        nothing = np.zeros((1, len(combined.change)))
        faulty = self.faults.alone(fewer, nothing, bent + RIVAL, ages=True)
        if faulty is None:
            return None
        if faulty.improbability >= bent:
            return replace(bend, rival=faulty.names)
        estimate = self._angle(faulty.rest)
        return replace(estimate, faults=(*bend.faults, *faulty.faults, *estimate.faults))

    def _angle(self, combined: CombinedChange) -> AngleEstimate:
        """Angle of a sensor that bends as usual or in any other way, by the evidence for each.

        Mean and standard error are those of the mixture, faults and misfit of the likelier one.
        """
        if not self.usual:
            return self._angle_of_any(combined)
        usual = robust_angle(self.usual, combined, self.faults)
        # Densities of the same measurements are compared; faults have the price of being found.
        fewer = combined.drop(usual.left_out) if usual.faults else combined
        other = self._angle_of_any(fewer)
        log_odds = LOG_ODDS - 0.5 * FAULT_THRESHOLD * len(usual.faults)
        evidence = usual.log_evidence - other.log_evidence
        share, doubted = expit(np.array([1.0, TEMPER]) * evidence + log_odds).tolist()
        if usual.faults and share < 0.5:
            return self._angle_of_any(combined)
        by_other, by_usual = ((one.angle_deg, one.deviation_deg) for one in (other, usual))
        angle, _ = mixture_moments(by_other, by_usual, share)
        mean, spread = mixture_moments(by_other, by_usual, doubted)
        deviation = math.hypot(spread, mean - angle)
        likelier = usual if share > 0.5 else other
        by_both = {"angle_deg": angle, "deviation_deg": deviation, "usual": share}
        return replace(likelier, usual_curve=usual.usual_curve, **by_both)

    def _angle_of_any(self, combined: CombinedChange) -> AngleEstimate:
        """Angle by the curve, and by the networks where all measurements are good.

        Where the curve leaves out a measurement that the networks take for the bend of some clamp,
        nothing shows which of both is right.
        """
        estimate = robust_angle([self.curve], combined, self.faults)
        if self.networks is None:
            return posterior_angle(self.curve, combined, estimate)
        if not combined.good.all():
            return estimate
        networks, features = self.networks
        by_networks = networks.estimate(combined.change, features, math.sqrt(combined.drift))
        by_curve = (estimate.angle_deg, estimate.deviation_deg)
        apart = abs(by_networks[0] - by_curve[0]) / math.hypot(by_networks[1], by_curve[1])
        if estimate.faults and apart < CONTRADICTION:
            return estimate
        if estimate.faults:
            angle, deviation = mixture_moments(by_curve, by_networks, 0.5)
        else:
            angle, deviation = blend_angles(by_curve, by_networks)
        lost = abs(by_networks[0]) < BLEND_START_DEG and abs(by_curve[0]) >= BLEND_END_DEG
        curve_estimate = None if estimate.faults or lost else by_curve
        return replace(estimate, angle_deg=angle, deviation_deg=deviation, by_curve=curve_estimate)

    def candidates(self, angle_deg: float, places: Array) -> TouchCandidates:
        """Touch candidates at places (n, 2) [m] and the step nearest to an angle [deg]."""
        step = round(angle_deg / STEP_DEG)
        if step not in self._candidates:
            response, output = self.response.response, self.response.output
            change = response.candidate_output(places, step * STEP_DEG) @ output.T
            self._candidates[step] = TouchCandidates(places, response.ranges.middle_force, change)
        return self._candidates[step]
