"""Flexure of a layer about y, of any curvature profile."""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from eitskin.errors import ConfigurationError
from eitskin.geometry.deformation.kinematics import Deformation, Gradients, Points

Array = NDArray[np.float64]

if TYPE_CHECKING:
    from scipy.interpolate import CubicHermiteSpline


_NODES = 200


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
