"""A press on the touched side and how the layer deforms under it, in closed form."""

import math
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicHermiteSpline

from eitskin.geometry import ConfigurationError
from eitskin.geometry.deformation import Gradients, Points

Array = NDArray[np.float64]

MAX_FORCE = 12.0
FITTED_RADIUS = 0.0075
_REACH = 6.0  # in units of the kernel's width b; beyond it the thickness is unchanged


@dataclass(frozen=True, slots=True)
class Cylinder:
    """A flat-ended cylindrical indenter; radius [m]."""

    radius: float = FITTED_RADIUS

    def __post_init__(self) -> None:
        """Check the radius."""
        if not (math.isfinite(self.radius) and self.radius > 0):
            raise ConfigurationError(
                f"indenter radius must be a positive length in m, got {self.radius}"
            )


@dataclass(frozen=True, slots=True)
class Touch:
    """A press at (x, y) of the flat sensor.

    Attributes:
        x, y: centre of the indenter [m].
        force: normal force [N].
        indenter: its shape.
    """

    x: float
    y: float
    force: float = 10.0
    indenter: Cylinder = field(default_factory=Cylinder)

    def __post_init__(self) -> None:
        """Check what the closed form covers."""
        if not (math.isfinite(self.x) and math.isfinite(self.y)):
            raise ConfigurationError(f"touch place must be finite, got ({self.x}, {self.y})")
        if not 0.0 < self.force <= MAX_FORCE:
            raise ConfigurationError(
                f"touch force must be above 0 and at most {MAX_FORCE:g} N, where the closed form "
                f"was fitted, got {self.force} N"
            )
        if abs(self.indenter.radius - FITTED_RADIUS) > 1e-9:
            raise ConfigurationError(
                f"the closed form is fitted for an indenter radius of {FITTED_RADIUS:g} m, got "
                f"{self.indenter.radius:g} m"
            )


@dataclass(frozen=True, slots=True, eq=False)
class DentKernel:
    """Axisymmetric, isochoric deformation of a layer whose thickness changes by w(r).

        w = h/h0 - 1 = -A (1 - r^2/b^2) exp(-r^2/b^2)

    Every height moves by w z, and the radial displacement u keeps all volumes:
    (r + u)^2 = r^2 + 2 int_0^r s (1/(1 + w) - 1) ds.

    Attributes:
        amplitude: A, thinning on the axis [-].
        width: b [m].
    """

    amplitude: float
    width: float
    radial: CubicHermiteSpline

    @classmethod
    @lru_cache(maxsize=4096)
    def of_force(cls, force: float) -> "DentKernel":
        """The kernel for a press of `force` [N] by the 15 mm cylinder.

        A = 0.036 F + 0.0012 F^2 and b = 12.8 mm - 0.16 mm F (F in N) pass through the fits at
        5 N (0.21, 12.0 mm) and 10 N (0.48, 11.2 mm), and through no dent at no force.
        """
        amplitude = 0.036 * force + 0.0012 * force**2
        width = 0.0128 - 0.00016 * force
        r = np.linspace(0.0, _REACH * width, 401)
        nodes, weights = np.polynomial.legendre.leggauss(4)
        step = r[1] - r[0]
        s = r[:-1, None] + 0.5 * (nodes + 1.0) * step
        excess = s * (1.0 / (1.0 + _thickness_change(s, amplitude, width)[0]) - 1.0)
        swept = np.concatenate([[0.0], np.cumsum(excess @ weights) * 0.5 * step])
        slope = r * (1.0 / (1.0 + _thickness_change(r, amplitude, width)[0]) - 1.0)
        return cls(amplitude, width, CubicHermiteSpline(r, swept, slope))

    def displacement(self, r: Array) -> tuple[Array, Array, Array]:
        """u / r, w and dw/dr at distance r [m]; the first tends to its limit on the axis."""
        w, slope = _thickness_change(r, self.amplitude, self.width)
        swept = self.radial(np.minimum(r, _REACH * self.width))
        square = np.maximum(r, 1e-6 * self.width) ** 2
        hoop = np.sqrt(1.0 + 2.0 * swept / square)
        hoop = np.where(r < 1e-4 * self.width, 1.0 / np.sqrt(1.0 + w), hoop)
        return hoop - 1.0, w, slope


def _thickness_change(r: Array, amplitude: float, width: float) -> tuple[Array, Array]:
    """The change w(r) and its derivative dw/dr."""
    t = (r / width) ** 2
    bell = np.where(t < _REACH**2, amplitude * np.exp(-t), 0.0)
    return -(1.0 - t) * bell, 2.0 * r / width**2 * (2.0 - t) * bell


@dataclass(frozen=True, slots=True)
class Dents:
    """The deformation of the flat layer by presses, displacements superposed.

    One press keeps volume exactly; several do up to the product of their strains where they
    overlap. The rim is not felt: the kernel is that of an unbounded layer.
    """

    touches: tuple[Touch, ...]

    def positions(self, points: Points) -> Points:
        """Deformed places [m], (..., 3), of flat points [m], (..., 3)."""
        moved = points.copy()
        for touch in self.touches:
            across = points[..., :2] - (touch.x, touch.y)
            hoop, w, _ = DentKernel.of_force(touch.force).displacement(
                np.hypot(across[..., 0], across[..., 1])
            )
            moved[..., :2] += hoop[..., None] * across
            moved[..., 2] += w * points[..., 2]
        return moved

    def gradient(self, points: Points) -> Gradients:
        """Deformation gradient, (..., 3, 3)."""
        F = np.zeros((*points.shape, 3))
        F[..., 0, 0] = F[..., 1, 1] = F[..., 2, 2] = 1.0
        for touch in self.touches:
            dx, dy = points[..., 0] - touch.x, points[..., 1] - touch.y
            r = np.hypot(dx, dy)
            hoop, w, slope = DentKernel.of_force(touch.force).displacement(r)
            # d(r + u)/dr from volume: (1 + u') (1 + u/r) (1 + w) = 1.
            stretch = 1.0 / ((1.0 + hoop) * (1.0 + w)) - 1.0
            azimuth = np.arctan2(dy, dx)  # zero on the axis, where every direction is radial
            cos, sin = np.cos(azimuth), np.sin(azimuth)
            F[..., 0, 0] += stretch * cos**2 + hoop * sin**2
            F[..., 1, 1] += stretch * sin**2 + hoop * cos**2
            shear = (stretch - hoop) * cos * sin
            F[..., 0, 1] += shear
            F[..., 1, 0] += shear
            F[..., 2, 0] += points[..., 2] * slope * cos
            F[..., 2, 1] += points[..., 2] * slope * sin
            F[..., 2, 2] += w
        return F
