"""Bending about y by the kinematic model: constant curvature over a hinge's span."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eitskin.geometry.deformation import Gradients, Points
from eitskin.geometry.errors import ConfigurationError
from eitskin.geometry.sensor import SensorDesign


@dataclass(frozen=True, slots=True)
class Hinge:
    """Two plates that clamp the sensor's ends and turn about one axis under its middle.

    Attributes:
        span: free length between the clamps, centred on the sensor [m].
        offset: of the hinge axis below the mid-plane of the conductive layer [m].
    """

    span: float = 0.040
    offset: float = 0.008

    def __post_init__(self) -> None:
        """Check the numbers."""
        if not (math.isfinite(self.span) and self.span > 0):
            raise ConfigurationError(f"hinge span must be a positive length in m, got {self.span}")
        if not math.isfinite(self.offset):
            raise ConfigurationError(f"hinge offset must be finite, in m, got {self.offset}")


@dataclass(frozen=True, slots=True)
class Bend:
    """How far the sensor is bent.

    Attributes:
        angle_deg: between the two ends; positive is convex on the touched side.
    """

    angle_deg: float

    def __post_init__(self) -> None:
        """Check the number; whether the angle can be reached depends on hinge and sensor."""
        if not math.isfinite(self.angle_deg):
            raise ConfigurationError(f"angle_deg must be a finite number, got {self.angle_deg}")


@dataclass(frozen=True, slots=True)
class HingeBend:
    """The deformation of a sensor on a hinge (Rivlin flexure, plane strain, isochoric).

    Over the span the layer has constant curvature c = theta / s per flat length, and with Z the
    flat height above mid-layer lambda^2 = lambda_0^2 + 2 c Z, F = diag(lambda, 1, 1/lambda) in
    the turned frame (Rivlin 1949). The ends turn rigidly by +-theta/2 about the hinge axis at
    distance d below mid-layer; their distance sets the arc:
    lambda_0 = (theta/2) cot(theta/2) + d theta / s.

    At the clamps F jumps from its bent value to a rotation: positions agree there at mid-layer
    and are apart by at most |Z| |2 / (lambda + lambda_0) - 1| elsewhere.

    Raises ConfigurationError, naming the last possible angle, where some fibre of the
    encapsulated sensor would be compressed to nothing or the ends would cross.
    """

    design: SensorDesign
    hinge: Hinge
    bend: Bend

    def __post_init__(self) -> None:
        """Check that the angle can be reached."""
        length = self.design.outline.length
        if self.hinge.span > length:
            raise ConfigurationError(
                f"the hinge's span of {self.hinge.span:g} m must not exceed the sensor's length "
                f"of {length:g} m"
            )
        if not self._possible(self.theta):
            limit = self._last_possible_angle_deg()
            raise ConfigurationError(
                f"a bend of {self.bend.angle_deg:g} deg is not possible with {self.hinge}; the "
                f"last possible angle in this direction is {limit:.1f} deg. Bend less, widen the "
                "span, or change the offset"
            )

    @property
    def theta(self) -> float:
        """Bend angle [rad]."""
        return math.radians(self.bend.angle_deg)

    @property
    def curvature(self) -> float:
        """Turning per flat length over the span, c = theta / s [1/m]."""
        return self.theta / self.hinge.span

    @property
    def mid_stretch(self) -> float:
        """lambda_0, the stretch along x at mid-layer within the span."""
        return self._mid_stretch(self.theta)

    def positions(self, points: Points) -> Points:
        """Deformed places [m], (..., 3), of flat points [m], (..., 3)."""
        x, y, Z, inside, turn, stretch = self._local(points)
        lam0, c, s, d = self.mid_stretch, self.curvature, self.hinge.span, self.hinge.offset
        cos, sin = np.cos(turn), np.sin(turn)
        # Within the span; every term stays regular as theta -> 0. np.sinc(t) = sin(pi t)/(pi t).
        depth = 2.0 * Z / (stretch + lam0)
        arc_x = lam0 * x * np.sinc(turn / np.pi) + depth * sin
        sagitta = 0.5 * lam0 * c * x**2 * np.sinc(turn / (2.0 * np.pi)) ** 2
        arc_z = depth * cos - sagitta - 0.5 * s * math.tan(self.theta / 4.0)
        # Outside: rigid rotation by +-theta/2 about the hinge axis.
        arm_x = x * cos + (Z + d) * sin
        arm_z = -x * sin + (Z + d) * cos - d
        moved = np.empty_like(points)
        moved[..., 0] = np.where(inside, arc_x, arm_x) + 0.5 * self.design.outline.length
        moved[..., 1] = y
        moved[..., 2] = np.where(inside, arc_z, arm_z) + 0.5 * self.design.thickness
        return moved

    def gradient(self, points: Points) -> Gradients:
        """Deformation gradient, (..., 3, 3); det F = 1 everywhere."""
        _, _, _, _, turn, stretch = self._local(points)
        cos, sin = np.cos(turn), np.sin(turn)
        F = np.zeros((*points.shape, 3))
        F[..., 0, 0], F[..., 2, 0] = stretch * cos, -stretch * sin
        F[..., 1, 1] = 1.0
        F[..., 0, 2], F[..., 2, 2] = sin / stretch, cos / stretch
        return F

    def _local(
        self, points: Points
    ) -> tuple[Points, Points, Points, NDArray[np.bool_], Points, Points]:
        """x from the middle, y, height above mid-layer, inside the span, turning, stretch."""
        x = points[..., 0] - 0.5 * self.design.outline.length
        Z = points[..., 2] - 0.5 * self.design.thickness
        inside = np.abs(x) <= 0.5 * self.hinge.span
        turn = self.curvature * np.clip(x, -0.5 * self.hinge.span, 0.5 * self.hinge.span)
        squared = np.where(inside, self.mid_stretch**2 + 2.0 * self.curvature * Z, 1.0)
        if np.any(squared <= 0.0):
            raise ConfigurationError(
                f"a point at height {Z[squared <= 0.0].flat[0]:g} m above mid-layer lies outside "
                "the bent sensor; keep points within the encapsulated thickness"
            )
        return x, points[..., 1], Z, inside, turn, np.sqrt(squared)

    def _mid_stretch(self, theta: float) -> float:
        half = theta / 2.0
        cotangent_term = half / math.tan(half) if half else 1.0
        return cotangent_term + self.hinge.offset * theta / self.hinge.span

    def _possible(self, theta: float) -> bool:
        """Whether every fibre keeps a positive stretch and the ends do not cross."""
        if abs(theta) >= 2.0 * math.pi:
            return False
        lam0 = self._mid_stretch(theta)
        inner = -math.copysign(0.5 * self.design.encapsulated_thickness, theta)
        if lam0 <= 0.0 or lam0**2 + 2.0 * theta / self.hinge.span * inner <= 0.0:
            return False
        # The inner face of the right-hand end, from clamp to tip, must stay right of the middle.
        cos, sin = math.cos(theta / 2.0), math.sin(theta / 2.0)
        ends = (0.5 * self.hinge.span, 0.5 * self.design.outline.length)
        return all(x * cos + (inner + self.hinge.offset) * sin > 0.0 for x in ends)

    def _last_possible_angle_deg(self) -> float:
        sign = math.copysign(1.0, self.theta)
        good = 0.0
        bad = next(a for a in range(1, 361) if not self._possible(sign * math.radians(a)))
        good, bad_angle = bad - 1.0, float(bad)
        for _ in range(30):
            middle = 0.5 * (good + bad_angle)
            if self._possible(sign * math.radians(middle)):
                good = middle
            else:
                bad_angle = middle
        return sign * math.floor(good * 10.0) / 10.0
