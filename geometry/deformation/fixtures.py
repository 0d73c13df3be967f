"""Fixtures that bend a sensor about y, roll and twist about its long axis x, and their limits."""

import math
from abc import ABC, abstractmethod
from dataclasses import InitVar, dataclass, replace
from typing import Literal

import numpy as np

from eitskin.bounds import LONGEST, require_in_range, require_positive
from eitskin.errors import ConfigurationError
from eitskin.geometry.deformation.kinematics import Deformation, Flexure, Gradients, Points
from eitskin.geometry.design.sensor import SensorDesign, warn_of_grid

_SEARCH_STEP = 5  # deg, of the search for the last possible angle


@dataclass(frozen=True, slots=True)
class Bend:
    """Bend of the sensor about y.

    Attributes:
        angle_deg: angle between the two ends; positive is convex on the touched side.

    Example:
        >>> from eitskin import Bend, Scene
        >>> Scene(bend=Bend(30.0)).bend.angle_deg
        30.0
    """

    angle_deg: float

    def __post_init__(self) -> None:
        """Check the number; the largest possible angle depends on fixture and sensor."""
        if not math.isfinite(self.angle_deg):
            raise ConfigurationError(f"angle_deg must be a finite number, got {self.angle_deg}")


@dataclass(frozen=True, slots=True)
class Clamp:
    """Two plates that hold the sensor's ends and turn about one axis under its middle.

    The plates hold the faces of the encapsulation beyond half the span from the middle, without
    slip; each turns by half the angle. `Simulator` bends the sensor by a 3D solution at finite
    strain. Only rectangular sensors can be clamped.

    Attributes:
        span: free length between the plates, centred on the sensor [m].
        offset: depth of the axis below the mid-plane of the conductive layer [m].
        compliance: gap per traction of the bond between plate and face [m/Pa]; 0 for a rigid bond.
        faces: faces held by the plates.

    Example:
        >>> from eitskin.geometry import Clamp
        >>> Clamp(span=0.030, faces="bottom").offset
        0.008
    """

    span: float = 0.040
    offset: float = 0.008
    compliance: float = 0.0
    faces: Literal["both", "bottom"] = "both"
    solved_span: InitVar[float | None] = None
    solved_offset: InitVar[float | None] = None

    def __post_init__(self, solved_span: float | None, solved_offset: float | None) -> None:
        if solved_span is not None or solved_offset is not None:
            warn_of_grid("Clamp(solved_span=..., solved_offset=...)")
        if not (math.isfinite(self.span) and self.span > 0.0):
            raise ConfigurationError(f"clamp span must be a positive length in m, got {self.span}")
        if not math.isfinite(self.offset):
            raise ConfigurationError(f"clamp offset must be finite, in m, got {self.offset}")
        if not (math.isfinite(self.compliance) and self.compliance >= 0.0):
            raise ConfigurationError(
                f"clamp compliance must be zero or positive, in m/Pa, got {self.compliance}"
            )
        if self.faces not in ("both", "bottom"):
            raise ConfigurationError(f"clamp faces must be 'both' or 'bottom', got {self.faces!r}")

    @property
    def bent_length(self) -> float:
        """Length of the free part of the flat sensor [m]."""
        return self.span


class _Kinematic(ABC):
    """Fixture whose bends are flexures in closed form."""

    __slots__ = ()

    @property
    @abstractmethod
    def bent_length(self) -> float:
        """Length of the bent part of the flat sensor [m]."""

    @abstractmethod
    def _flexure(self, design: SensorDesign, theta: float) -> Flexure:
        """Flexure by an angle [rad], possible or not."""

    def _check_profile(self, transition: float, contraction: float) -> None:
        half = 0.5 * self.bent_length
        require_in_range("transition, to half the bent length,", transition, 0.0, half, "m")
        require_in_range("contraction, of a plate to that of a beam,", contraction, 0.0, 1.0)

    def flexure(self, design: SensorDesign, bend: Bend) -> Flexure:
        """Flexure of the bent sensor.

        Raises ConfigurationError, naming the last possible angle, for an angle out of reach.
        """
        length = design.outline.length
        if self.bent_length > length:
            raise ConfigurationError(
                f"the bent length of {self.bent_length:g} m must not exceed the sensor's length of "
                f"{length:g} m"
            )

        def possible(degrees: float) -> bool:
            theta = math.radians(degrees)
            return abs(degrees) <= 360.0 and _possible(self._flexure(design, theta), design)

        if possible(bend.angle_deg):
            return self._flexure(design, math.radians(bend.angle_deg))
        sign = math.copysign(1.0, bend.angle_deg)
        good, bad = 0.0, min(abs(bend.angle_deg), 361.0)
        for step in range(_SEARCH_STEP, math.ceil(bad), _SEARCH_STEP):
            if not possible(sign * step):
                bad = float(step)
                break
            good = float(step)
        while bad - good > 1e-7:
            middle = 0.5 * (good + bad)
            good, bad = (middle, bad) if possible(sign * middle) else (good, middle)
        last = sign * math.floor(good * 10.0 + 1e-6) / 10.0
        raise ConfigurationError(
            f"a bend of {bend.angle_deg:g} deg is not possible with {self}; the last possible "
            f"angle in this direction is {last:.1f} deg. Bend less, bend over a greater length, or "
            "change the fixture"
        )


@dataclass(frozen=True, slots=True)
class Hinge(_Kinematic):
    """Kinematic hinge: two plates clamp the ends and turn about one axis under the middle.

    The ends turn rigidly by +-theta/2 about the axis at distance d below mid-layer; their
    distance sets the stretch of the arc between them. For constant curvature over the span s,

        lambda_0 = (theta/2) cot(theta/2) + d theta / s.

    Attributes:
        span: free length between the clamps, centred on the sensor [m].
        offset: depth d of the hinge axis below the mid-plane of the conductive layer [m].
        give: length by which the bend reaches into each clamp; soft layers give between stiff
            plates [m].
        transition: flat length over which the curvature rises, at each end of the bend [m].
        contraction: contraction of the width, 0 as a plate to 1 as a beam; see Flexure.

    A closed form, which nothing but an explicit choice selects: the default is a plate between
    rigid ends, whose bend signal is off by 87 % from the 3D solution; `give=0.002,
    contraction=0.8` fits that of the reference stack best.

    Example:
        >>> from eitskin.geometry import Hinge
        >>> Hinge(give=0.002, contraction=0.8).span
        0.04
    """

    span: float = 0.040
    offset: float = 0.008
    give: float = 0.0
    transition: float = 0.0
    contraction: float = 0.0

    def __post_init__(self) -> None:
        require_positive("hinge span", self.span, "m")
        require_in_range("hinge offset", self.offset, -LONGEST, LONGEST, "m")
        require_in_range("hinge give", self.give, 0.0, LONGEST, "m")
        self._check_profile(self.transition, self.contraction)

    @property
    def bent_length(self) -> float:
        return self.span + 2.0 * self.give

    def _flexure(self, design: SensorDesign, theta: float) -> Flexure:
        centre, half = design.centre, 0.5 * theta
        length = self.bent_length
        clamp = 0.5 * length
        flexure = Flexure(centre, length, theta, 1.0, self.transition, self.contraction)
        straight, more = (
            float(replace(flexure, stretch=s, contraction=0.0).centre_line(np.array(clamp))[0])
            for s in (1.0, 2.0)
        )
        # The extent of the centre line along x is linear in the stretch; its end is the clamp's.
        chord = clamp * math.cos(half) + self.offset * math.sin(half)
        flexure = replace(flexure, stretch=1.0 + (chord - straight) / (more - straight))
        down = float(flexure.centre_line(np.array(clamp))[1])
        height = -clamp * math.sin(half) + self.offset * (math.cos(half) - 1.0)
        return replace(flexure, rise=height + down)


@dataclass(frozen=True, slots=True)
class FreeArc(_Kinematic):
    """Pure bending without a fixture: moments bend a part of the sensor's length into an arc.

    Without forces at the ends, lambda_0^2 = sqrt(1 + (c h)^2) for a stack of thickness h, as for
    a uniform neo-Hookean block (Rivlin 1949).

    Attributes:
        length: flat length of the arc, centred on the sensor [m].
        transition, contraction: flat length and contraction of the width, as in `Hinge`.

    Example:
        >>> from eitskin.geometry import FreeArc
        >>> FreeArc(length=0.100).length
        0.1
    """

    length: float
    transition: float = 0.0
    contraction: float = 0.0

    def __post_init__(self) -> None:
        require_positive("arc length", self.length, "m")
        self._check_profile(self.transition, self.contraction)

    @property
    def bent_length(self) -> float:
        return self.length

    def _flexure(self, design: SensorDesign, theta: float) -> Flexure:
        c = theta / (self.length - self.transition)
        stretch = _free_stretch(c * design.encapsulated_thickness)
        return Flexure(
            design.centre, self.length, theta, stretch, self.transition, self.contraction
        )


def _free_stretch(bend: float) -> float:
    """Stretch of the middle of a layer that moments alone bend, by curvature times thickness."""
    return float((1.0 + bend**2) ** 0.25)


# Tables with the keys of several fixtures stand for the first, as in files of version 0.1.
Fixture = Hinge | FreeArc | Clamp


def _possible(flexure: Flexure, design: SensorDesign) -> bool:
    """Whether all fibres keep a positive length and the inner face does not cross the middle."""
    half = 0.5 * design.encapsulated_thickness
    inner = -math.copysign(half, flexure.angle)
    X = np.linspace(0.0, 0.5 * design.outline.length, 400)[1:]
    face = np.stack([X, np.zeros_like(X), np.full_like(X, inner)], axis=-1) + flexure.centre
    if flexure.stretch <= 0.0 or flexure.stretch**2 + 2.0 * flexure.curvature * inner <= 0.0:
        return False
    try:
        x = flexure.positions(face)[:, 0] - flexure.centre[0]
    except ConfigurationError:  # fibres may be shortest where the curvature rises
        return False
    return bool(x.min() > -1e-9)


@dataclass(frozen=True, slots=True)
class Twist:
    """Twist: rotation of one end against the other about the sensor's long axis.

    Attributes:
        angle_deg: angle of the end at large x against the end at x = 0, right-handed about x.

    Example:
        >>> from eitskin import Scene
        >>> from eitskin.geometry import Twist
        >>> Scene(twist=Twist(10.0)).twist.angle_deg
        10.0
    """

    angle_deg: float

    def __post_init__(self) -> None:
        if not math.isfinite(self.angle_deg):
            raise ConfigurationError(f"twist angle_deg must be finite, got {self.angle_deg}")

    def deformation(self, design: SensorDesign) -> "TwistedMap":
        """Deformation of a twisted design, its middle at rest."""
        return TwistedMap(design.centre, math.radians(self.angle_deg) / design.outline.length)


@dataclass(frozen=True, slots=True)
class TwistedMap(Deformation):
    """Torsion without warping: each cross-section turns rigidly about x, in proportion to X.

    x' = R(tau X) x and F = R + tau e_x x (R x) e_X: shear only, det F = 1 (Saint-Venant's torsion
    without warping).

    Attributes:
        centre: point of the axis without rotation [m].
        rate: tau [rad/m].
    """

    centre: tuple[float, float, float]
    rate: float

    def map_points(self, points: Points) -> tuple[Points, Gradients]:
        """Positions and gradients; det F = 1 everywhere."""
        X, Y, Z = np.moveaxis(points - self.centre, -1, 0)
        cos, sin = np.cos(self.rate * X), np.sin(self.rate * X)
        y, z = cos * Y - sin * Z, sin * Y + cos * Z
        F = np.zeros((*points.shape, 3))
        F[..., 0, 0] = 1.0
        F[..., 1, 1], F[..., 1, 2] = cos, -sin
        F[..., 2, 1], F[..., 2, 2] = sin, cos
        F[..., 1, 0], F[..., 2, 0] = -self.rate * z, self.rate * y
        return np.stack([X, y, z], axis=-1) + self.centre, F


@dataclass(frozen=True, slots=True)
class Roll:
    """Roll: pure bending of the whole width into an arc about x.

    Attributes:
        angle_deg: angle between the two long edges; positive is convex on the touched side.

    Example:
        >>> from eitskin import Scene
        >>> from eitskin.geometry import Roll
        >>> Scene(roll=Roll(20.0)).roll.angle_deg
        20.0
    """

    angle_deg: float

    def __post_init__(self) -> None:
        if not abs(self.angle_deg) <= 360.0:
            raise ConfigurationError(
                f"roll angle_deg must be from -360 to 360, where the edges meet, got "
                f"{self.angle_deg}"
            )

    def deformation(self, design: SensorDesign) -> "RolledMap":
        """Deformation of a rolled design: Rivlin's flexure (1949) of the whole width."""
        outline, theta = design.outline, math.radians(self.angle_deg)
        x, y, z = design.centre
        c = theta / outline.width
        stretch = _free_stretch(c * design.encapsulated_thickness)
        return RolledMap(Flexure((y, x, z), outline.width, theta, stretch))


@dataclass(frozen=True, slots=True)
class RolledMap(Deformation):
    """Flexure with x and y exchanged."""

    flexure: Flexure

    def map_points(self, points: Points) -> tuple[Points, Gradients]:
        """Positions and gradients; det F = 1 everywhere."""
        swap = [1, 0, 2]
        moved, F = self.flexure.map_points(points[..., swap])
        return moved[..., swap], F[..., swap, :][..., swap]
