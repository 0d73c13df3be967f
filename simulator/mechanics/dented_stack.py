"""Equilibrium of a pressed stack in 3D, as a deformation of the sensor."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eitskin.errors import ConfigurationError
from eitskin.geometry.deformation.kinematics import Gradients, Points
from eitskin.simulator.mechanics.press_window import PressWindow
from eitskin.simulator.mechanics.quadratic_field import QuadraticField

Array = NDArray[np.float64]

_SAME = 1e-9  # [m]


@dataclass(frozen=True, slots=True, eq=False)
class DentedStack:
    """Equilibrium of a pressed stack, a Deformation of gel and encapsulation.

    Attributes:
        displacement: of the solved part, from the origin of its windows, at heights over the
            lower face of the gel [m].
        windows: computational windows along x and y; beyond them nothing moves.
        sensor: least and largest x, y and z of the encapsulated sensor, (2, 3) [m].
        forces: on each indenter [N].
        depths: of the indenters' lowest points under the undeformed top [m].
        contact_areas: on the deformed face [m2].
        peak_pressures: on the deformed face, at the quadrature points [Pa].
        thinnings: 1 - thickness over undeformed thickness of the gel on each axis.
        volume_ratio: deformed over undeformed volume of the gel that is solved.
        energy: strain energy and penalty energy of the contacts [J].
        base_force: vertical force on the base and at the cuts [N].
    """

    displacement: QuadraticField
    windows: tuple[PressWindow, PressWindow]
    sensor: Array
    forces: Array
    depths: Array
    contact_areas: Array
    peak_pressures: Array
    thinnings: Array
    volume_ratio: float
    energy: float
    base_force: float

    @property
    def mean_pressures(self) -> Array:
        """Forces over contact areas [Pa]."""
        return self.forces / self.contact_areas

    def positions(self, points: Points) -> Points:
        """Deformed positions [m], (..., 3), of flat points [m], (..., 3)."""
        place, sides, solved = self._solved(points)
        moved = sides * self.displacement(place)
        return points + np.where(solved[..., None], moved, 0.0)

    def gradient(self, points: Points) -> Gradients:
        """Deformation gradient, (..., 3, 3); it jumps between cells of the mesh, slightly."""
        place, sides, solved = self._solved(points)
        slope = sides[..., :, None] * self.displacement.derivative(place) * sides[..., None, :]
        F: Gradients = np.eye(3) + np.where(solved[..., None, None], slope, 0.0)
        return F

    def _solved(self, points: Points) -> tuple[Points, Array, NDArray[np.bool_]]:
        """Points mirrored to the solved part, signs of mirroring, and whether in the windows."""
        x = np.array(points, dtype=float)
        outside = np.any((x < self.sensor[0] - _SAME) | (x > self.sensor[1] + _SAME), axis=-1)
        if np.any(outside):
            raise ConfigurationError(
                f"{int(outside.sum())} of {outside.size} points lie outside the pressed sensor, "
                f"which reaches from {self.sensor[0]} to {self.sensor[1]} m"
            )
        sides, solved = np.ones_like(x), np.ones(x.shape[:-1], dtype=bool)
        for axis, window in enumerate(self.windows):
            solved &= (x[..., axis] >= window.low) & (x[..., axis] <= window.high)
            x[..., axis], sides[..., axis] = window.local(x[..., axis])
        return x, sides, solved
