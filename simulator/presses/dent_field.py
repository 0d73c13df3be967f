"""Dent of a press as a field of the whole unbounded stack."""

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from eitskin.simulator.mechanics.axisymmetric_press import Indentation
from eitskin.simulator.mechanics.box_fields import shape_functions
from eitskin.simulator.presses.contact_frame import ContactFrame
from eitskin.simulator.scene.indenters import Indenter

Array = NDArray[np.float64]

_AXIS = 1e-9  # [m]
_AT_ONCE = 8_000  # points, so that gathered splines stay small


class FieldValues(NamedTuple):
    """Displacement (n, 3) [m], its gradient (n, 3, 3) and mean stress (n,) [Pa] at n points."""

    displacement: Array
    gradient: Array
    mean_stress: Array


class _Splines(NamedTuple):
    """Splines over the radius: of the displacement, and of each layer's mean stress."""

    moved: CubicSpline
    stressed: list[tuple[Array, CubicSpline]]


@lru_cache(maxsize=8)
def _splines(press: Indentation) -> _Splines:
    r, heights = press.r[::2], press.z[::2]
    layers = [
        (heights[np.isfinite(grid[0])], grid[:, np.isfinite(grid[0])]) for grid in press.mean_stress
    ]
    return _Splines(
        CubicSpline(press.r, press.displacement, axis=0),
        [(z, CubicSpline(r, grid, axis=0)) for z, grid in layers],
    )


@dataclass(frozen=True, slots=True, eq=False)
class DentField:
    """Axisymmetric press on an unbounded stack, about a vertical axis through (x, y).

    Splines over the radius, quadratic elements over the height; zero beyond the largest radius.

    Attributes:
        x, y: position of the axis [m].
        indenter: that presses.
        press: the axisymmetric solution.
        frame: of a bent stack, to which the dent is turned; None on a flat one.
    """

    x: float
    y: float
    indenter: Indenter
    press: Indentation
    frame: ContactFrame | None = None

    @property
    def contact_radius(self) -> float:
        """Undeformed radius of the contact [m]: of the point that moves to its deformed radius."""
        moved = self.press.r + self.press.displacement[:, -1, 0]
        return float(np.interp(self.press.contact_radius, moved, self.press.r))

    def at(self, points: Array) -> FieldValues:
        """Values at points (n, 3), heights over the base of the stack [m]."""
        return self.turned(self.level(points))

    def level(self, points: Array) -> FieldValues:
        """Values at points (n, 3) in directions of the flat stack, as the dent was solved."""
        if self.frame is not None:
            points = self.frame.stretched(points)
        parts = [
            self._part(points[start : start + _AT_ONCE])
            for start in range(0, max(len(points), 1), _AT_ONCE)
        ]
        return FieldValues(*(np.concatenate(each) for each in zip(*parts, strict=True)))

    def turned(self, level: FieldValues) -> FieldValues:
        """Values of the flat stack turned to the frame."""
        if self.frame is None:
            return level
        u, G, p = level
        return FieldValues(self.frame.turned(u), self.frame.gradient(G), p)

    def nominal(self, stress: Array) -> Array:
        """Stress [Pa] (..., 3, 3) of the dent as solved, turned to its frame."""
        return stress if self.frame is None else self.frame.nominal(stress)

    def _part(self, points: Array) -> FieldValues:
        dx, dy = points[:, 0] - self.x, points[:, 1] - self.y
        distance = np.maximum(np.hypot(dx, dy), _AXIS)
        c, s = np.where(distance > _AXIS, dx / distance, 1.0), dy / distance
        r = np.minimum(distance, self.press.r[-1])
        radial, upward, outward, rising = self._motion(r, points[:, 2])
        hoop = radial[:, 0] / distance
        G = np.empty((len(points), 3, 3))
        G[:, 0, 0] = outward[:, 0] * c * c + hoop * s * s
        G[:, 1, 1] = outward[:, 0] * s * s + hoop * c * c
        G[:, 0, 1] = G[:, 1, 0] = (outward[:, 0] - hoop) * c * s
        G[:, 0, 2], G[:, 1, 2] = rising[:, 0] * c, rising[:, 0] * s
        G[:, 2, 0], G[:, 2, 1] = outward[:, 1] * c, outward[:, 1] * s
        G[:, 2, 2] = rising[:, 1]
        u = np.stack([radial[:, 0] * c, radial[:, 0] * s, upward[:, 0]], axis=1)
        felt = distance <= self.press.r[-1]
        p = self._mean_stress(r, points[:, 2])
        return FieldValues(u * felt[:, None], G * felt[:, None, None], p * felt)

    def _motion(self, r: Array, z: Array) -> tuple[Array, Array, Array, Array]:
        """Radial (n, 1) and upward (n, 1) displacement, and both derivatives by r and by z."""
        spline = _splines(self.press).moved
        nodes, (values, slopes) = shape_functions(self.press.z[::2], z)
        rows = np.arange(len(r))[:, None]
        u, du = spline(r)[rows, nodes], spline(r, 1)[rows, nodes]
        moved = np.einsum("nac,na->nc", u, values)
        outward, rising = np.einsum("nac,na->nc", du, values), np.einsum("nac,na->nc", u, slopes)
        return moved[:, :1], moved[:, 1:], outward, rising

    def _mean_stress(self, r: Array, z: Array) -> Array:
        """Mean stress [Pa], (n,): linear over the height within each layer."""
        found = np.empty(len(r))
        layer = self.press.stack.layer_at(z)
        for k, (heights, spline) in enumerate(_splines(self.press).stressed):
            here = np.flatnonzero(layer == k)
            cell = np.clip(np.searchsorted(heights, z[here]) - 1, 0, len(heights) - 2)
            t = (z[here] - heights[cell]) / np.diff(heights)[cell]
            values = spline(r[here])
            rows = np.arange(len(here))
            found[here] = (1.0 - t) * values[rows, cell] + t * values[rows, cell + 1]
        return found
