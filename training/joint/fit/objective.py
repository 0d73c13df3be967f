"""MAP objective of one frame: squared whitened residuals plus the prior, and its minimisation.

The unknowns are a bend angle and the positions and forces of some touches:

    misfit = |W (change - bend curve - touch responses)|^2 + prior,   W^T W = covariance^-1

Changes, curves and responses are those of K combinations of measurements (`Combinations`).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from types import ModuleType

import numpy as np
from numpy.typing import NDArray

from eitskin.compiled import compiled
from eitskin.training.joint.bend_curve import BendCurve
from eitskin.training.joint.combinations import CombinedChange
from eitskin.training.joint.fit import lapack
from eitskin.training.joint.fit.linearisation import Linearisation, Unknowns
from eitskin.training.joint.fit.quadratic_model import (
    GOOD,
    GROWTH,
    POOR,
    RADIUS,
    SHRINKING,
    QuadraticModel,
)
from eitskin.training.joint.prior import ANGLE_UNIT, TOUCH_UNITS, TouchPrior
from eitskin.training.joint.touch_response import SpecimenResponse

Array = NDArray[np.float64]

KERNELS = "eitskin.training.joint.fit.fit_kernels"
BEYOND_DEG = 5.0  # by which an angle may lie outside of those the bend curve was learned from
OPTIMISM = 10.0
"""Most that is hoped for, in decreases of the misfit that its quadratic model promises."""
STILL_DEG = 0.01  # motion below which the uncertainty of the bend curve is negligible


@dataclass(frozen=True, slots=True, eq=False)
class TouchObjective:
    """Objective of one frame against its reference, for one specimen.

    Attributes:
        combined: of the change since the reference.
        reference_deg: bend angle at which the reference was taken [deg].
        reference_bend: value of the bend curve at that angle (K,).
        response: of the specimen to touches.
        curve: of the specimen's bending.
        prior: of touches.
        kernels: `fit_kernels` where they are wanted, installed, and can evaluate the response.
    """

    combined: CombinedChange
    reference_deg: float
    reference_bend: Array
    response: SpecimenResponse
    curve: BendCurve
    prior: TouchPrior
    kernels: ModuleType | None = field(init=False, repr=False)
    _arrays: tuple[tuple[Array, ...], tuple[Array, ...]] = field(init=False, repr=False)
    _spread: tuple[Array | float, ...] = field(init=False, repr=False)  # `SPREAD` of the kernels

    @classmethod
    def of(
        cls,
        combined: CombinedChange,
        reference_deg: float,
        response: SpecimenResponse,
        curve: BendCurve,
        prior: TouchPrior,
    ) -> "TouchObjective":
        """The objective of a combined."""
        bend = curve.value(reference_deg)
        return cls(combined, reference_deg, bend, response, curve, prior)

    def __post_init__(self) -> None:
        """Arrange the arrays that the kernels take, where these are wanted."""
        weights, curve, prior = self.response.stacked, self.curve, self.prior
        kernels = compiled(KERNELS) if weights is not None else None
        object.__setattr__(self, "kernels", kernels)
        if weights is None or kernels is None:
            return
        low, high = curve.angle_deg
        numbers = [self.response.response.unit, self.reference_deg, low - BEYOND_DEG]
        numbers += [high + BEYOND_DEG, prior.separation]
        frame = self.combined.change + self.reference_bend, np.array(numbers), prior.box
        object.__setattr__(self, "_arrays", ((*weights, curve.coefficients), frame))
        response, combinations = self.response.response, self.combined.combinations
        latent_output = np.ascontiguousarray(response.latent_output)
        spread = (self.combined.noise, curve.blocks, combinations.lateness, latent_output)
        both = combinations.both_ways
        object.__setattr__(self, "_spread", (*spread, *both, response.mismatch))

    def without_measurements(self, measurements: Sequence[int]) -> "TouchObjective":
        """The objective with some measurements left out."""
        return replace(self, combined=self.combined.without(measurements))

    def residual(self, unknowns: Unknowns) -> Array:
        """Measured minus modelled change (K,)."""
        bend = self.curve.value(unknowns.angle_deg)
        residual: Array = self.combined.change - bend + self.reference_bend
        if len(unknowns.touches):
            residual -= self.response(unknowns.touches, unknowns.angle_deg).sum(axis=0)
        return residual

    def linearised(self, unknowns: Unknowns) -> Linearisation:
        """Residual and Jacobian at these unknowns."""
        if self.kernels is not None:
            touches = np.ascontiguousarray(unknowns.touches)
            point = self.kernels.linearise(touches, unknowns.angle_deg, *self._arrays)
            return Linearisation.of(point)
        touches, angle = unknowns.touches, unknowns.angle_deg
        change = self.combined.change
        rows = np.empty((2 + touches.size, len(change)))
        value, slope = self.curve.value_and_slope(angle)
        np.subtract(change + self.reference_bend, value, out=rows[0])
        np.multiply(slope, ANGLE_UNIT, out=rows[1])
        if not len(touches):
            return Linearisation(unknowns, rows, touches, touches)
        modelled, hidden = self.response.with_derivatives(touches, angle, TOUCH_UNITS)
        changes = modelled[0]
        rows[0] -= np.add.reduce(changes)
        rows[2:].reshape(len(touches), 3, -1)[:] = modelled[1:].transpose(1, 0, 2)
        return Linearisation(unknowns, rows, changes, hidden)

    def whitening(self, at: Linearisation) -> Array:
        """L^-1 (K, K) of the residual's covariance L L^T."""
        return lapack.whitening(self.covariance(at))

    def covariance(self, at: Linearisation) -> Array:
        """Covariance (K, K) of the residual.

        The sum of those of the noise, of the bend curve's change since the reference, and of the
        touch response.
        """
        if self.kernels is not None:
            summed: Array = self.kernels.covariance(at.point, self._arrays[1], self._spread)
            return summed
        covariance, unknowns = self.combined.noise, at.unknowns
        moved = unknowns.angle_deg - self.reference_deg
        if abs(moved) > STILL_DEG:
            covariance = covariance + self.curve.uncertainty(unknowns.angle_deg, self.reference_deg)
            covariance += self.scan_skew(at.bend_slope, moved)
        if len(unknowns.touches):
            covariance = covariance + self.response.uncertainty(unknowns.touches, at.hidden)
            mismatch = self._mismatch_variance(at.changes)
            self.combined.combinations.add_independent(covariance, mismatch)
        return covariance

    def _mismatch_variance(self, changes: Array) -> Array:
        """Variance (C,) of each measurement's error of the response, by touches' changes (k, K)."""
        mismatch = self.response.response.mismatch
        return self.combined.combinations.share_variance(changes, mismatch)

    def remainder_scale(self, at: Linearisation) -> Array:
        """Standard deviation (C,) of `CombinedChange.rest`, in its units."""
        combined = self.combined
        if combined.combinations.basis is None:
            return np.ones(0)
        variance = np.full(len(combined.measured), combined.frames)
        if len(at.unknowns.touches):
            variance += self._mismatch_variance(at.changes) / combined.combinations.noise**2
        scale: Array = np.sqrt(variance)
        return scale

    def scan_skew(self, slope: Array, moved_deg: float) -> Array:
        """Covariance (K, K) of measuring one after the other while the sensor bends.

        The first and the last of a frame's measurements see different angles. The speed is
        unknown; the motion since the previous frame bounds it.

        Args:
            slope: derivative by the angle (K,) [1/deg].
            moved_deg: motion since the reference [deg].
        """
        late = moved_deg * self.combined.combinations.late(slope)
        covariance: Array = late[:, None] * late
        return covariance

    def misfit(self, at: Linearisation, whitening: Array) -> float:
        """Value of the objective, in the metric of `whitening`."""
        return self.quadratic(at, whitening).misfit

    def quadratic(self, at: Linearisation, whitening: Array) -> QuadraticModel:
        """Misfit, gradient and Hessian, in the metric of `whitening`."""
        if self.kernels is not None:
            metric = np.ascontiguousarray(whitening.T)
            return QuadraticModel.of(*self.kernels.quadratic(at.point, metric, self._arrays[1]))
        white = at.rows @ whitening.T
        # Inner products of residual and Jacobian: misfit, gradient and Hessian are its blocks.
        products = white @ white.T
        unknowns = at.unknowns
        self.prior.add_to(products, unknowns.touches, self.reference_deg - unknowns.angle_deg)
        return QuadraticModel.of(products, white)

    def held(self, unknowns: Unknowns, gradient: Array) -> NDArray[np.bool_]:
        """Which unknowns are at a bound that their gradient (n,), downhill, would cross (n,)."""
        touches, prior = unknowns.touches, self.prior
        below = np.concatenate([[False], (touches <= prior.low).ravel()])
        above = np.concatenate([[False], (touches >= prior.high).ravel()])
        held: NDArray[np.bool_] = (below & (gradient < 0.0)) | (above & (gradient > 0.0))
        return held

    def stepped(self, unknowns: Unknowns, step: Array) -> Unknowns:
        """Unknowns after a step (n,) in unit steps, clipped to their bounds."""
        low, high = self.curve.angle_deg
        angle = min(
            max(unknowns.angle_deg + ANGLE_UNIT * float(step[0]), low - BEYOND_DEG),
            high + BEYOND_DEG,
        )
        moved = unknowns.touches + step[1:].reshape(-1, 3) * TOUCH_UNITS
        clipped = np.minimum(np.maximum(moved, self.prior.low), self.prior.high)
        return Unknowns(clipped, angle)

    def minimised(
        self, start: Linearisation, whitening: Array, steps: int, tolerance: float, goal: float
    ) -> tuple[Linearisation, QuadraticModel]:
        """End of the iterations of `levenberg_marquardt`."""
        if self.kernels is not None:
            metric = np.ascontiguousarray(whitening.T)
            found = self.kernels.minimise(
                start.point, metric, *self._arrays, steps, tolerance, goal
            )
            return Linearisation.of(found[0]), QuadraticModel.of(*found[1:])
        at, now, radius = start, self.quadratic(start, whitening), RADIUS
        for _ in range(steps):
            step = now.step(radius, self.held(at.unknowns, now.gradient))
            promised = now.promised(step)
            if promised < tolerance or now.misfit - OPTIMISM * promised > goal:
                break
            moved = self.linearised(self.stepped(at.unknowns, step))
            trial = self.quadratic(moved, whitening)
            gain, length = now.misfit - trial.misfit, float(np.abs(step).max())
            if gain < POOR * promised:
                radius = SHRINKING * length
            elif gain > GOOD * promised:
                radius = max(radius, GROWTH * length)
            if gain > 0.0:
                at, now = moved, trial
        return at, now


def misfit_sigma(misfit: float, degrees_of_freedom: int) -> float:
    """Misfit above its expectation, in standard deviations of the chi-square distribution."""
    return (misfit - degrees_of_freedom) / math.sqrt(2.0 * max(degrees_of_freedom, 1))


@dataclass(frozen=True, slots=True, eq=False)
class MapEstimate:
    """MAP estimate of the unknowns for a given number of touches.

    Attributes:
        objective: that it minimises.
        at: the model linearised at the estimate.
        quadratic: the objective about the estimate; its inverse Hessian is the covariance, in unit
            steps.
        whitening: metric of the residual in which the estimate was sought (K, K).
    """

    objective: TouchObjective
    at: Linearisation
    quadratic: QuadraticModel
    whitening: Array

    @property
    def unknowns(self) -> Unknowns:
        """The estimate."""
        return self.at.unknowns

    @property
    def misfit(self) -> float:
        """Value of the objective."""
        return self.quadratic.misfit

    def minimum(self, tolerance: float) -> Unknowns:
        """Unknowns after the step at which the fit ended, which promised less than `tolerance`.

        A fit does not evaluate that step. Where it ended for another reason, the estimate itself.
        """
        held = self.objective.held(self.unknowns, self.quadratic.gradient)
        step = self.quadratic.step(RADIUS, held)
        if self.quadratic.promised(step) > tolerance:
            return self.unknowns
        return self.objective.stepped(self.unknowns, step)

    @property
    def degrees_of_freedom(self) -> int:
        """Number of residuals minus number of unknowns, at least one."""
        return max(self.objective.combined.told - len(self.quadratic.gradient), 1)

    @property
    def misfit_sigma(self) -> float:
        """Misfit above its expectation, in standard deviations."""
        return misfit_sigma(self.misfit, self.degrees_of_freedom)

    def whole(self) -> "tuple[Array, float, int]":
        """Whitened remainder of the measurements, and misfit and degrees of freedom with it.

        The remainder, which no bend and no touch explains, tells faults (C,); it has no elements
        where nothing can remain.
        """
        combined = self.objective.combined
        rest = combined.rest / self.objective.remainder_scale(self.at)
        further = combined.count - combined.told
        return rest, self.misfit + float(rest @ rest), self.degrees_of_freedom + further

    @property
    def improbability(self) -> float:
        """Minus twice the logarithm of the density of frame and touches, but for a constant."""
        whitening = self.objective.whitening(self.at)
        width = 2.0 * float(np.sum(np.log(np.diagonal(whitening))))
        return self.objective.misfit(self.at, whitening) - width

    @property
    def whole_sigma(self) -> float:
        """Misfit with the remainder above its expectation, in standard deviations."""
        return misfit_sigma(*self.whole()[1:])


def levenberg_marquardt(
    objective: TouchObjective,
    start: Linearisation,
    steps: int,
    tolerance: float,
    whitening: Array | None = None,
    goal: float = math.inf,
) -> MapEstimate:
    """Minimise the objective from `start`.

    A step stays within a trust region, which shrinks where it gains much less than promised.
    Iterations end after `steps`, where the next one promises less than `tolerance` of misfit, or
    where the goal is out of reach: where `OPTIMISM` times the promise would leave more.

    Args:
        objective: that is minimised.
        start: the model where the search begins.
        steps: most iterations.
        tolerance: of the misfit.
        whitening: metric of the residual (K, K); that of the start by default.
        goal: misfit above which the result is of no use.
    """
    if whitening is None:
        whitening = objective.whitening(start)
    at, now = objective.minimised(start, whitening, steps, tolerance, goal)
    return MapEstimate(objective, at, now, whitening)
