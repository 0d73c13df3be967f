"""Kinematics: deformation map, its composition, flexures, pull-back of conductivity."""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from eitskin.errors import ConfigurationError

if TYPE_CHECKING:
    from scipy.interpolate import CubicHermiteSpline

Points = NDArray[np.float64]
Gradients = NDArray[np.float64]
Array = NDArray[np.float64]

_NODES = 200  # of the curve of a flexure

# Entries xx, yy, zz, xy, xz, yz of a symmetric tensor, and where each of its 3 x 3 is among these.
TENSOR_ROWS = np.array([0, 1, 2, 0, 0, 1])
TENSOR_COLUMNS = np.array([0, 1, 2, 1, 2, 2])
WHOLE_TENSOR = np.array([[0, 3, 4], [3, 1, 5], [4, 5, 2]])


class Deformation(ABC):
    """Map from points of the flat sensor to their deformed positions."""

    __slots__ = ()

    @abstractmethod
    def map_points(self, points: Points) -> tuple[Points, Gradients]:
        """Deformed positions x [m], (..., 3), and gradients F = dx/dX, (..., 3, 3).

        At flat points X [m], (..., 3).
        """

    def map_deformed(self, places: Points, gradients: Gradients) -> tuple[Points, Gradients]:
        """Positions and gradients of points that another deformation moved to places (..., 3) [m].

        By the chain rule F = F_own(places) F, from gradients F (..., 3, 3) so far.
        """
        positions, outer = self.map_points(places)
        outer, inner = _entries(outer), _entries(gradients)
        F = np.asarray(sum(outer[:, j, None] * inner[j] for j in range(3)))
        return positions, np.moveaxis(F, (0, 1), (-2, -1))

    def positions(self, points: Points) -> Points:
        """Deformed positions [m], (..., 3), of flat points [m], (..., 3)."""
        return self.map_points(points)[0]

    def gradient(self, points: Points) -> Gradients:
        """Deformation gradient F = dx/dX, (..., 3, 3), at flat points [m], (..., 3)."""
        return self.map_points(points)[1]


@dataclass(frozen=True, slots=True)
class Composition(Deformation):
    """Composition of two deformations; F = F_second(x_first) F_first."""

    first: Deformation
    second: Deformation

    def map_points(self, points: Points) -> tuple[Points, Gradients]:
        """Positions and gradient by the chain rule."""
        return self.second.map_deformed(*self.first.map_points(points))


@dataclass(frozen=True, slots=True)
class Displaced(Deformation):
    """Deformation by a displacement field, given as a function of the flat points.

    Attributes:
        displacement: u(x) [m], (..., 3), of flat points (..., 3) [m].
        derivative: du/dx, (..., 3, 3); central differences of `displacement` when omitted.
        step: step of those differences [m]; they are exact to about (step / size)^2.
    """

    displacement: Callable[[Points], Points]
    derivative: Callable[[Points], Gradients] | None = None
    step: float = 1e-6

    def map_points(self, points: Points) -> tuple[Points, Gradients]:
        """Positions and gradient; raises ConfigurationError where the body is inside out."""
        if self.derivative is not None:
            slope = self.derivative(points)
        else:
            steps = self.step * np.eye(3)
            ends = [self.displacement(points + e) - self.displacement(points - e) for e in steps]
            slope = np.stack(ends, axis=-1) / (2.0 * self.step)
        F: Gradients = np.eye(3) + slope
        J = np.linalg.det(F)
        if not np.all(J > 0.0):
            raise ConfigurationError(
                "the displacement turns the body inside out or is not a number at "
                f"{int((~(J > 0.0)).sum())} of {J.size} points; make it smaller or smoother"
            )
        return points + self.displacement(points), F


def largest_strain(deformation: Deformation | None, points: Points) -> NDArray[np.float64]:
    """Largest principal logarithmic strain at `points` (n, 3) [m] of the flat sensor, (n,).

    The logarithm of the largest principal stretch (Hencky 1928) is positive wherever an
    incompressible body deforms, because at least one fibre is stretched.
    """
    if deformation is None:
        return np.zeros(len(points))
    F = deformation.gradient(points)
    squares = np.linalg.eigvalsh(np.swapaxes(F, -1, -2) @ F)
    return np.asarray(0.5 * np.log(squares[:, -1]))


def pulled_back_entries(gradients: Gradients) -> NDArray[np.float64]:
    """Pull-back J F^-1 F^-T of a unit conductivity to the flat body, (..., 6).

    Entries xx, yy, zz, xy, xz and yz, computed as adj(C) / J with C = F^T F, without an inverse.
    Source: Kohn et al. 2008 (change of variables in the conductivity equation).

    Raises ConfigurationError where det F is not positive.
    """
    F, n = _entries(gradients), _cofactors(gradients)
    J = F[0, 0] * n[0, 0] + F[1, 0] * n[1, 0] + F[2, 0] * n[2, 0]
    negative = int((~(J > 0.0)).sum())
    if negative:
        raise ConfigurationError(
            "the deformation turns the body inside out or is not a number at "
            f"{negative} of {J.size} points; press or bend less, or presses further from the edge "
            "and from each other"
        )
    # The columns of the cofactors are the rows of J F^-1; their Gram matrix is adj(C).
    S, inverse = np.empty((6, *J.shape)), 1.0 / J
    for entry, (i, j) in enumerate(zip(TENSOR_ROWS, TENSOR_COLUMNS, strict=True)):
        S[entry] = (n[0, i] * n[0, j] + n[1, i] * n[1, j] + n[2, i] * n[2, j]) * inverse
    return np.moveaxis(S, 0, -1)


def area_ratio(gradients: Gradients, normals: NDArray[np.float64]) -> NDArray[np.float64]:
    """Area ratio |J F^-T N|, deformed over flat, of a surface with unit normals N (..., 3), (...).

    Source: Nanson's formula.
    """
    turned = np.einsum("ij...,...j->i...", _cofactors(gradients), normals)
    return np.asarray(np.sqrt(np.einsum("i...,i...->...", turned, turned)))


def _entries(gradients: Gradients) -> Gradients:
    """F with its indices first, (3, 3, ...)."""
    return np.ascontiguousarray(np.moveaxis(gradients, (-2, -1), (0, 1)))


def _cofactors(gradients: Gradients) -> Gradients:
    """J F^-T with its indices first, (3, 3, ...)."""
    F = _entries(gradients)
    cofactors = np.empty_like(F)
    for i in range(3):
        for j in range(3):
            k, m, p, q = (i + 1) % 3, (i + 2) % 3, (j + 1) % 3, (j + 2) % 3
            cofactors[i, j] = F[k, p] * F[m, q] - F[k, q] * F[m, p]
    return cofactors


@dataclass(frozen=True)
class Flexure(Deformation):
    """Flexure whose mid-plane is a curve of curvature c(X) and stretch lambda_0(X).

    With X along the flat layer and Z the flat height above mid-layer, fibres stay on normals of
    the curve, at the depth that preserves volume:

        lambda^2 = lambda_0^2 + 2 c Z / mu,   depth = (lambda - lambda_0) / c,
        F = (lambda t + depth' n) e_X + mu e_y e_y + n e_Z / (lambda mu) + (Y mu') e_y e_X

    with tangent t, normal n and lateral stretch mu(X): Rivlin's flexure (1949), where c, lambda_0
    and mu are constant. det F = 1 for any profile. c and lambda_0 - 1 rise over `transition` from
    zero at the ends of the span, mu - 1 over half of it; outside, the layer moves rigidly. Without
    a transition F jumps at the ends, where positions agree only at mid-layer.

    Attributes:
        centre: middle of the span at mid-layer, (x, y, z) [m].
        span: flat length that bends [m].
        angle: angle between the two ends, positive convex upwards [rad].
        stretch: lambda_0 in the middle of the span.
        transition: flat length over which the curvature rises, at each end of the span [m].
        contraction: beta in mu = lambda_0^(-beta / 2): 0 for a plate of constant width, 1 for a
            beam that contracts equally in width and thickness.
        rise: rise of mid-layer in the middle of the span [m].
    """

    centre: tuple[float, float, float]
    span: float
    angle: float
    stretch: float
    transition: float = 0.0
    contraction: float = 0.0
    rise: float = 0.0

    @property
    def curvature(self) -> float:
        """Curvature c in the middle of the span: rotation per flat length [1/m]."""
        return self.angle / (self.span - self.transition)

    def map_points(self, points: Points) -> tuple[Points, Gradients]:
        """Positions and gradients; det F = 1 everywhere."""
        X, Y, Z = np.moveaxis(points - self.centre, -1, 0)
        along, down = self.centre_line(X)
        turn = self.curvature * self._profile(X)[2]
        mu, mu_slope = self._lateral(X)
        stretch, depth, depth_slope = self._depth(X, Z)
        cos, sin = np.cos(turn), np.sin(turn)
        moved = np.stack([along + depth * sin, mu * Y, self.rise - down + depth * cos], axis=-1)
        F = np.zeros((*points.shape, 3))
        F[..., 0, 0] = stretch * cos + depth_slope * sin
        F[..., 2, 0] = -stretch * sin + depth_slope * cos
        F[..., 1, 0] = Y * mu_slope
        F[..., 1, 1] = mu
        F[..., 0, 2], F[..., 2, 2] = sin / (stretch * mu), cos / (stretch * mu)
        return moved + self.centre, F

    def centre_line(self, X: Array) -> tuple[Array, Array]:
        """Position of mid-layer along x, and depth below its highest point, at flat X [m]."""
        half = 0.5 * self.span
        along, down = self._curve(np.minimum(np.abs(X), half)).T
        beyond = np.maximum(np.abs(X) - half, 0.0)
        end = 0.5 * self.angle
        return np.sign(X) * (along.T + beyond * math.cos(end)), down.T + beyond * math.sin(end)

    @cached_property
    def _curve(self) -> "CubicHermiteSpline":
        """Integrals of lambda_0 cos(turn) and lambda_0 sin(turn) from the middle to the end [m]."""
        from scipy.interpolate import CubicHermiteSpline  # takes half a second

        X = np.linspace(0.0, 0.5 * self.span, _NODES + 1)
        nodes, weights = np.polynomial.legendre.leggauss(6)
        half = 0.5 * (X[1] - X[0])
        at = X[:-1, None] + half * (nodes + 1.0)
        steps = half * np.einsum("nqk,q->nk", self._slopes(at), weights)
        values = np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])
        return CubicHermiteSpline(X, values, self._slopes(X))

    def _slopes(self, X: Array) -> Array:
        w, _, turned = self._profile(X)
        turn = self.curvature * turned
        stretch = 1.0 + (self.stretch - 1.0) * w
        return np.stack([stretch * np.cos(turn), stretch * np.sin(turn)], axis=-1)

    def _profile(self, X: Array) -> tuple[Array, Array, Array]:
        """Profile w(X) of curvature and stretch, its slope [1/m], and its integral over X [m]."""
        half, ramp = 0.5 * self.span, self.transition
        if not ramp:
            inside = np.abs(X) <= half
            return inside.astype(float), np.zeros_like(X), np.clip(X, -half, half)
        a = np.clip((half - np.abs(X)) / ramp, 0.0, 1.0)
        area = np.minimum(np.abs(X), half - ramp) + ramp * (0.5 - a**3 + 0.5 * a**4)
        sign = np.sign(X)
        return a**2 * (3.0 - 2.0 * a), -sign * 6.0 * a * (1.0 - a) / ramp, sign * area

    def _lateral(self, X: Array) -> tuple[Array, Array]:
        """Lateral stretch mu and its slope along X [1/m]."""
        if not self.contraction:
            return np.ones_like(X), np.zeros_like(X)
        a = np.clip(1.0 - 2.0 * np.abs(X) / self.span, 0.0, 1.0)
        base = 1.0 + (self.stretch - 1.0) * a**2 * (3.0 - 2.0 * a)
        slope = (self.stretch - 1.0) * -np.sign(X) * 12.0 * a * (1.0 - a) / self.span
        power = -0.5 * self.contraction
        return base**power, power * base ** (power - 1.0) * slope

    def _depth(self, X: Array, Z: Array) -> tuple[Array, Array, Array]:
        """Stretch lambda of the fibres, their depth [m], and the slope of the depth along X."""
        w, w_slope, _ = self._profile(X)
        mu, mu_slope = self._lateral(X)
        c, c_slope = self.curvature * w, self.curvature * w_slope
        mid, mid_slope = 1.0 + (self.stretch - 1.0) * w, (self.stretch - 1.0) * w_slope
        q, q_slope = Z / mu, -Z * mu_slope / mu**2
        squared = mid**2 + 2.0 * c * q
        if np.any(squared <= 0.0):
            raise ConfigurationError(
                f"a point at height {np.asarray(Z)[squared <= 0.0].flat[0]:g} m above mid-layer "
                "lies outside the bent sensor; keep points within the encapsulated thickness"
            )
        stretch = np.sqrt(squared)
        stretch_slope = (mid * mid_slope + c_slope * q + c * q_slope) / stretch
        total = mid + stretch
        slope = 2.0 * q_slope / total - 2.0 * q * (mid_slope + stretch_slope) / total**2
        return stretch, 2.0 * q / total, slope
