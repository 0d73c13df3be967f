"""MAP objective of one frame: squared whitened residuals plus the prior, and its minimisation.

The unknowns are a bend angle and the positions and forces of some touches:

    misfit = |W (change - bend curve - touch responses)|^2 + prior,   W^T W = covariance^-1

Changes, curves and responses are those of K combinations of measurements (`Combinations`).
"""

import math
from dataclasses import dataclass, field
from functools import cached_property
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack

from eitskin.compiled import implementation
from eitskin.training.joint.bend_curve import BEYOND_DEG, BendCurve
from eitskin.training.joint.combinations import CombinedChange
from eitskin.training.joint.fit_kernels import KERNELS, RADIUS, TOUCH_UNITS
from eitskin.training.joint.touch_response import SpecimenResponse, TouchPrior

Array = NDArray[np.float64]

TOUCH_THRESHOLD = 25.0
"""Least decrease of the misfit by a touch. The decrease by a touch that is not there is the largest
of some fifty chi-square variables of three degrees of freedom, above this once in 1000 frames."""
FURTHER_THRESHOLD = 20.0
"""The same of a touch near others: above this once in 100 frames. Several touches are missed more
often than one is made up."""


class Unknowns(NamedTuple):
    """Values of the unknowns.

    Attributes:
        touches: x [m], y [m] and force [N] of each (k, 3).
        angle_deg: angle of the bend [deg].
    """

    touches: Array
    angle_deg: float

    def without_touch(self, number: int) -> "Unknowns":
        """The same values less one touch."""
        others = np.concatenate([self.touches[:number], self.touches[number + 1 :]])
        return Unknowns(others, self.angle_deg)

    def with_touches(self, touches: Array) -> "Unknowns":
        """The same values and further touches (n, 3)."""
        return Unknowns(np.concatenate([self.touches, touches]), self.angle_deg)


class Linearisation(NamedTuple):
    """The model linearised at some unknowns, not whitened.

    Attributes:
        touches, angle_deg: the unknowns.
        rows: the residual, then the derivative of the model by a unit step of each of the n
            unknowns (1 + n, K).
        changes: changes by each touch (k, K).
        hidden: output of the response network, from which its uncertainty follows (k, hidden).
    """

    touches: Array
    angle_deg: float
    rows: Array
    changes: Array
    hidden: Array

    @property
    def unknowns(self) -> Unknowns:
        """Where the model is linearised."""
        return Unknowns(self.touches, self.angle_deg)

    @property
    def residual(self) -> Array:
        """Measured minus modelled change (K,)."""
        residual: Array = self.rows[0]
        return residual


@dataclass(frozen=True, slots=True, eq=False)
class TouchObjective:
    """Objective of one frame against its reference, for one specimen.

    Attributes:
        combined: combinations of the change since the reference.
        reference_deg: bend angle at which the reference was taken [deg].
        response: response of the specimen to touches.
        curve: curve of the specimen's bending.
        prior: prior of touches.
        reference_bend: value of the bend curve at that angle (K,).
        kernels: functions of `fit_kernels`, compiled where they are wanted.
    """

    combined: CombinedChange
    reference_deg: float
    response: SpecimenResponse
    curve: BendCurve
    prior: TouchPrior
    reference_bend: Array = field(init=False, repr=False)
    kernels: ModuleType = field(init=False, repr=False)
    sensor: tuple[Array, ...] = field(init=False, repr=False)  # as the kernels take it
    frame: tuple[Array, Array, Array] = field(init=False, repr=False)
    spread: tuple[Any, ...] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        """Arrange the arrays that the kernels take."""
        curve, prior, response = self.curve, self.prior, self.response.response
        bend, (low, high) = curve.value(self.reference_deg), curve.angle_deg
        limits = [low - BEYOND_DEG, high + BEYOND_DEG, prior.separation]
        numbers = np.array([response.unit, self.reference_deg, *limits])
        combinations = self.combined.combinations
        latent = np.ascontiguousarray(response.latent_output)
        spread = (self.combined.noise, curve.blocks, combinations.lateness, latent)
        none = np.zeros((0, 0))
        ways = (
            (none, none)
            if combinations.basis is None
            else (combinations.forward, combinations.back)
        )
        for name, value in {
            "reference_bend": bend,
            "kernels": implementation(KERNELS),
            "sensor": (*self.response.stacked, curve.coefficients),
            "frame": (self.combined.change + bend, numbers, prior.box),
            "spread": (*spread, *ways, response.mismatch),
        }.items():
            object.__setattr__(self, name, value)

    def linearise(self, unknowns: Unknowns) -> Linearisation:
        """Residual and Jacobian at these unknowns."""
        touches = np.ascontiguousarray(unknowns.touches)
        point = self.kernels.linearise(touches, unknowns.angle_deg, self.sensor, self.frame)
        return Linearisation(*point)

    def covariance(self, at: Linearisation) -> Array:
        """Covariance (K, K) of the residual.

        The sum of those of the noise, of the bend curve's change since the reference, of measuring
        one after the other while the sensor bends, and of the touch response.
        """
        covariance: Array = self.kernels.covariance(tuple(at), self.frame, self.spread)
        return covariance

    def whitening(self, at: Linearisation) -> Array:
        """L^-1 (K, K) of the residual's covariance L L^T."""
        return whitening_matrix(self.covariance(at))

    def remainder_scale(self, at: Linearisation) -> Array:
        """Standard deviation (C,) of `CombinedChange.rest`, in its units."""
        combined, combinations = self.combined, self.combined.combinations
        errors = self.response.response.mismatch * at.changes @ combinations.back
        scale: Array = np.sqrt(combined.frames + np.sum((errors / combinations.noise) ** 2, axis=0))
        return scale

    def quadratic(self, at: Linearisation, whitening: Array) -> "MapEstimate":
        """Misfit, gradient and Hessian, in the metric of `whitening`."""
        metric = np.ascontiguousarray(whitening.T)
        quadratic = self.kernels.quadratic(tuple(at), metric, self.frame)
        return MapEstimate(self, at, whitening, *quadratic)

    def misfit(self, at: Linearisation, whitening: Array) -> float:
        """Value of the objective, in the metric of `whitening`."""
        return self.quadratic(at, whitening).misfit

    def apply_step(self, unknowns: Unknowns, step: Array) -> Unknowns:
        """Unknowns after a step (n,) in unit steps, clipped to their bounds."""
        return Unknowns(*self.kernels.apply_step(*unknowns, step, self.frame))


def whitening_matrix(covariance: Array) -> Array:
    """Whitening matrix L^-1 (n, n), lower triangular, of a covariance L L^T (n, n).

    By LAPACK directly, as `solution`: `numpy.linalg` checks, copies and sets error states at every
    call, which takes several times as long as the factorisation of so small a matrix.
    """
    lower, failed = lapack.dpotrf(covariance.T, lower=1)
    _check_definite(failed)
    inverse: Array = lapack.dtrtri(lower, lower=1, overwrite_c=1)[0]
    return inverse


def solution(matrix: Array, right: Array) -> Array:
    """Solution x of A x = b for a positive definite A (n, n) and b (n,) or (n, m)."""
    x: Array
    _, x, failed = lapack.dposv(matrix.T, right, lower=1)
    _check_definite(failed)
    return x


def inverse(matrix: Array) -> Array:
    """Inverse (n, n) of a positive definite matrix."""
    root = whitening_matrix(matrix)
    product: Array = root.T @ root
    return product


def _check_definite(failed: int) -> None:
    """Raise LinAlgError where LAPACK has met a minor that is not positive."""
    if failed:
        raise np.linalg.LinAlgError(
            f"expected a positive definite matrix, got one whose minor {failed} is not positive"
        )


def misfit_sigma(misfit: float, degrees_of_freedom: int) -> float:
    """Misfit above its expectation, in standard deviations of the chi-square distribution."""
    return (misfit - degrees_of_freedom) / math.sqrt(2.0 * max(degrees_of_freedom, 1))


def price(touches: int) -> float:
    """Decrease of the misfit that is asked of so many touches together."""
    return TOUCH_THRESHOLD + FURTHER_THRESHOLD * (touches - 1) if touches else 0.0


@dataclass(frozen=True, eq=False)
class MapEstimate:
    """Estimate of the unknowns for a given number of touches, and the objective about it.

    Its quadratic (Gauss-Newton) model is in unit steps: of the angle, then x, y, force of each
    touch. The inverse Hessian is the covariance.

    Attributes:
        objective: objective that it minimises.
        at: the model linearised at the estimate.
        whitening: metric of the residual in which the estimate was sought (K, K).
        products: misfit, minus half its gradient and half its Hessian, as blocks (1 + n, 1 + n).
        white: residual and derivatives of the model, whitened (1 + n, K).
    """

    objective: TouchObjective
    at: Linearisation
    whitening: Array
    products: Array
    white: Array

    @property
    def unknowns(self) -> Unknowns:
        """The estimate."""
        return Unknowns(self.at.touches, self.at.angle_deg)

    @property
    def misfit(self) -> float:
        """Sum of squares of the whitened residual and of the prior's terms."""
        return float(self.products[0, 0])

    @property
    def hessian(self) -> Array:
        """Half the Gauss-Newton Hessian (n, n)."""
        return np.asarray(self.products[1:, 1:])

    def minimum(self, tolerance: float) -> Unknowns:
        """Unknowns after the step at which the fit ended, which promised less than `tolerance`.

        A fit does not evaluate that step. Where it ended for another reason, the estimate itself.
        """
        objective, at = self.objective, self.unknowns
        step, promised = objective.kernels.trust_step(
            self.products, at.touches, objective.frame, RADIUS
        )
        return at if promised > tolerance else objective.apply_step(at, step)

    @property
    def degrees_of_freedom(self) -> int:
        """Number of residuals minus number of unknowns, at least one."""
        return max(self.objective.combined.rank + 1 - len(self.products), 1)

    @property
    def misfit_sigma(self) -> float:
        """Misfit above its expectation, in standard deviations."""
        return misfit_sigma(self.misfit, self.degrees_of_freedom)

    @cached_property
    def whole(self) -> tuple[Array, float, int]:
        """Whitened remainder of the measurements, and misfit and degrees of freedom with it.

        The remainder, which no bend and no touch explains, shows faults (C,).
        """
        combined = self.objective.combined
        rest = combined.rest / self.objective.remainder_scale(self.at)
        further = combined.count - combined.rank
        return rest, self.misfit + float(rest @ rest), self.degrees_of_freedom + further

    @property
    def whole_sigma(self) -> float:
        """Misfit with the remainder above its expectation, in standard deviations."""
        return misfit_sigma(*self.whole[1:])

    @cached_property
    def own_whitening(self) -> Array:
        """Metric of the residual (K, K) at the estimate; that of its start may differ."""
        return self.objective.whitening(self.at)

    @cached_property
    def improbability(self) -> float:
        """Minus twice the logarithm of the model's posterior density, but for a constant.

        Every touch is as improbable as its threshold says.
        """
        whitening = self.own_whitening
        width = 2.0 * float(np.sum(np.log(np.diagonal(whitening))))
        return self.objective.misfit(self.at, whitening) - width + price(len(self.at.touches))

    @cached_property
    def whole_improbability(self) -> float:
        """The same, with the remainder."""
        remainder = self.whole[0]
        return self.improbability + float(remainder @ remainder)

    def beats(self, first: "MapEstimate", log_odds: float) -> bool:
        """Whether it is likelier than a first one, at odds before both are seen."""
        return first.whole_improbability - self.whole_improbability > -2.0 * log_odds

    @cached_property
    def gains(self) -> Array:
        """Rise of the misfit, to second order, were each touch's force zero (k,)."""
        variance = np.diagonal(inverse(self.hessian))
        gains: Array = (self.at.touches[:, 2] / TOUCH_UNITS[2]) ** 2 / variance[3::3]
        return gains

    def misfit_decrease(self, before: "MapEstimate") -> float:
        """Decrease of the misfit from an earlier estimate, in the metric of this one."""
        return self.objective.misfit(before.at, self.whitening) - self.misfit


def levenberg_marquardt(
    objective: TouchObjective,
    start: Unknowns | Linearisation,
    steps: int,
    tolerance: float,
    whitening: Array | None = None,
    goal: float = math.inf,
) -> MapEstimate:
    """Minimise the objective from `start`.

    A step stays within a trust region, which shrinks where it gains much less than promised.
    Iterations end after `steps`, where the next one promises less than `tolerance` of misfit, or
    where the misfit `goal` is out of reach: where `OPTIMISM` times the promise would leave more.
    The metric of the residual, `whitening` (K, K), is that of the start by default.
    """
    at = objective.linearise(start) if isinstance(start, Unknowns) else start
    if whitening is None:
        whitening = objective.whitening(at)
    arrays = np.ascontiguousarray(whitening.T), objective.sensor, objective.frame
    at, *quadratic = objective.kernels.minimise(tuple(at), *arrays, steps, tolerance, goal)
    return MapEstimate(objective, Linearisation(*at), whitening, *quadratic)
