"""Twist and roll of a sensor about its long axis x."""

import math
from dataclasses import dataclass

import numpy as np

from eitskin.errors import ConfigurationError
from eitskin.geometry.deformation.flexure import Flexure
from eitskin.geometry.deformation.kinematics import Gradients, Points
from eitskin.geometry.design.sensor import SensorDesign


@dataclass(frozen=True, slots=True)
class Twist:
    """Twist: rotation of one end against the other about the sensor's long axis.

    Attributes:
        angle_deg: of the end at large x against the end at x = 0, right-handed about x.
    """

    angle_deg: float

    def __post_init__(self) -> None:
        if not math.isfinite(self.angle_deg):
            raise ConfigurationError(f"twist angle_deg must be finite, got {self.angle_deg}")

    def deformation(self, design: SensorDesign) -> "Twisted":
        """Deformation of a twisted design, its middle at rest."""
        return Twisted(design.centre, math.radians(self.angle_deg) / design.outline.length)


@dataclass(frozen=True, slots=True)
class Twisted:
    """Torsion without warping: each cross-section turns rigidly about x, in proportion to X.

    x' = R(tau X) x and F = R + tau e_x x (R x) e_X: shear only, det F = 1 (Saint-Venant's torsion
    without warping).

    Attributes:
        centre: point of the axis without rotation [m].
        rate: tau [rad/m].
    """

    centre: tuple[float, float, float]
    rate: float

    def positions(self, points: Points) -> Points:
        """Deformed positions [m], (..., 3), of flat points [m], (..., 3)."""
        X, Y, Z = np.moveaxis(points - self.centre, -1, 0)
        cos, sin = np.cos(self.rate * X), np.sin(self.rate * X)
        return np.stack([X, cos * Y - sin * Z, sin * Y + cos * Z], axis=-1) + self.centre

    def gradient(self, points: Points) -> Gradients:
        """Deformation gradient, (..., 3, 3); det F = 1 everywhere."""
        X, Y, Z = np.moveaxis(points - self.centre, -1, 0)
        cos, sin = np.cos(self.rate * X), np.sin(self.rate * X)
        F = np.zeros((*points.shape, 3))
        F[..., 0, 0] = 1.0
        F[..., 1, 1], F[..., 1, 2] = cos, -sin
        F[..., 2, 1], F[..., 2, 2] = sin, cos
        F[..., 1, 0] = -self.rate * (sin * Y + cos * Z)
        F[..., 2, 0] = self.rate * (cos * Y - sin * Z)
        return F


@dataclass(frozen=True, slots=True)
class Roll:
    """Roll: pure bending of the whole width into an arc about x.

    Attributes:
        angle_deg: between the two long edges; positive is convex on the touched side.
    """

    angle_deg: float

    def __post_init__(self) -> None:
        if not abs(self.angle_deg) <= 360.0:
            raise ConfigurationError(
                f"roll angle_deg must be from -360 to 360, where the edges meet, got "
                f"{self.angle_deg}"
            )

    def deformation(self, design: SensorDesign) -> "Rolled":
        """Deformation of a rolled design: Rivlin's flexure (1949) of the whole width."""
        outline, theta = design.outline, math.radians(self.angle_deg)
        x, y, z = design.centre
        c = theta / outline.width
        stretch = (1.0 + (c * design.encapsulated_thickness) ** 2) ** 0.25
        return Rolled(Flexure((y, x, z), outline.width, theta, stretch))


@dataclass(frozen=True, slots=True)
class Rolled:
    """Flexure with x and y exchanged."""

    flexure: Flexure

    def positions(self, points: Points) -> Points:
        """Deformed positions [m], (..., 3), of flat points [m], (..., 3)."""
        moved: Points = self.flexure.positions(points[..., [1, 0, 2]])[..., [1, 0, 2]]
        return moved

    def gradient(self, points: Points) -> Gradients:
        """Deformation gradient, (..., 3, 3); det F = 1 everywhere."""
        swap = [1, 0, 2]
        F: Gradients = self.flexure.gradient(points[..., swap])[..., swap, :][..., swap]
        return F
