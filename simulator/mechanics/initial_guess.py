"""Initial guess for 3D presses: an axisymmetric press on an unbounded stack."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RegularGridInterpolator

from eitskin.simulator.mechanics.axisymmetric_press import AxisymmetricPress, Indentation
from eitskin.simulator.mechanics.layer_stack import Stack
from eitskin.simulator.scene.indenters import Indenter
from eitskin.simulator.scene.touch import Touch

Array = NDArray[np.float64]

_CELLS = 6  # over the radius of an indenter
_AXIS = 1e-9  # [m]


@dataclass(frozen=True, slots=True, eq=False)
class UnboundedPress:
    """Axisymmetric press on an unbounded stack, at the position of a touch.

    Attributes:
        touch: gives the position of the axis.
        press: the axisymmetric solution.
    """

    touch: Touch
    press: Indentation

    @classmethod
    def on(cls, stack: Stack, touch: Touch, force: float) -> "UnboundedPress":
        """Press at `touch` with a force [N]; raises SolidError where the stack cannot carry it."""
        return cls(touch, _solved(stack, touch.indenter, force))

    def displacement(self, points: Array) -> Array:
        """Displacements (n, 3) of points (n, 3) over the base [m]."""
        across, r = self._across(points)
        u = self._interpolated(1, self.press.displacement, r, points[:, 2])
        radial = u[:, :1] * across / np.maximum(r, _AXIS)[:, None]
        return np.concatenate([radial, u[:, 1:]], axis=1)

    def mean_stress(self, points: Array, layer: int) -> Array:
        """Mean stress (n,) [Pa] of a layer at points (n, 3) over the base [m]."""
        values = self.press.mean_stress[layer]
        inside = np.flatnonzero(np.isfinite(values[0]))
        part = slice(inside[0], inside[-1] + 1)
        heights = np.clip(points[:, 2], *self.press.z[::2][inside[[0, -1]]])
        return self._interpolated(2, values[:, part], self._across(points)[1], heights, part)

    def _across(self, points: Array) -> tuple[Array, Array]:
        across = points[:, :2] - np.array([self.touch.x, self.touch.y])
        return across, np.linalg.norm(across, axis=1)

    def _interpolated(
        self, every: int, values: Array, r: Array, z: Array, part: slice = slice(None)
    ) -> Array:
        """Values given on every `every`-th radius and height, interpolated; zero farther out."""
        lines = (self.press.r[::every], self.press.z[::every][part])
        field = RegularGridInterpolator(lines, values, bounds_error=False, fill_value=None)
        found: Array = field(np.stack([r, z], axis=1))
        found[r > lines[0][-1]] = 0.0
        return found


@lru_cache(maxsize=32)
def _solved(stack: Stack, indenter: Indenter, force: float) -> Indentation:
    return AxisymmetricPress(stack, indenter, finest=indenter.rims[1] / _CELLS).to_force(force)
