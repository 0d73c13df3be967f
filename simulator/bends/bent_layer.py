"""Bent layer: a smooth Deformation through nodal displacements of a clamped stack."""

import numpy as np
from numpy.typing import NDArray

from eitskin.errors import ConfigurationError
from eitskin.geometry.deformation.kinematics import Deformation, Gradients, Points
from eitskin.simulator.deformation.field import CubicSplines, Field

Array = NDArray[np.float64]

_SAME = 1e-9  # [m]


class BentLayer(Deformation):
    """Layer of a bent sensor, a Deformation of the gel.

    Cubic splines along x and y and a polynomial along z interpolate the nodal displacements of a
    quarter, mirrored to all four: positions and deformation gradients are continuous. Beyond the
    layer, where presses push gel, positions are extrapolated linearly.

    Attributes:
        angle_deg: between the plates.
        energy: stored in the whole sensor [J].
        moment: of each plate about the axis, the derivative of the energy by the angle in radians
            [N m].
    """

    def __init__(
        self,
        nodes: tuple[Array, Array, Array],
        values: Array,
        centre: Array,
        thickness: float,
        angle_deg: float,
        energy: float,
        moment: float,
    ) -> None:
        """Interpolate the displacements.

        Args:
            nodes: of a quarter along each axis, from the middle of the layer [m]; along z from the
                bottom face to the top face.
            values: displacements of the nodes [m], (nx, ny, nz, 3).
            centre: middle of the layer [m], (3,).
            thickness: of the whole stack [m].
            angle_deg, energy, moment: see the attributes.
        """
        self.angle_deg, self.energy, self.moment = angle_deg, energy, moment
        self._centre, self._thickness = centre, thickness
        self._ends = np.array([each[-1] for each in nodes])
        # u_x is odd and the others are even along x; likewise u_y along y.
        for axis in range(2):
            half = len(nodes[axis]) - 1
            values = np.take(values, np.abs(np.arange(-half, half + 1)), axis)
            odd = np.moveaxis(values, axis, 0)[..., axis]
            odd[:half] *= -1.0
            odd[half] = 0.0
        bases = [CubicSplines(np.concatenate([-each[:0:-1], each])) for each in nodes[:2]]
        levels = nodes[2] / nodes[2][-1]
        height = 2.0 * float(self._ends[2])
        self._field = Field.from_values(values, (bases[0], bases[1]), height, levels)

    def mapped(self, points: Points) -> tuple[Points, Gradients]:
        """Positions and gradients, continuous everywhere."""
        x, inside = self._within(points)
        columns = inside.reshape(-1, 1, 3) + np.array([0.0, 0.0, self._ends[2]])
        moved = self._field.moved(columns).reshape(12, *x.shape[:-1])
        positions: Points = self._centre + x + np.moveaxis(moved[:3], 0, -1)
        slope, beyond = moved[3:].reshape(3, 3, *x.shape[:-1]), x - inside
        if np.any(beyond):
            positions = positions + np.einsum("ij...,...j->...i", slope, beyond)
        moved[3::4] += 1.0  # the diagonal
        return positions, np.moveaxis(slope, (0, 1), (-2, -1))

    def _within(self, points: Points) -> tuple[Points, Points]:
        """Points from the middle of the layer, and the nearest points of the layer."""
        x = np.asarray(points, dtype=float) - self._centre
        outside = np.abs(x[..., 2]) > 0.5 * self._thickness + _SAME
        outside |= np.abs(x[..., 1]) > self._ends[1] + 0.5 * self._thickness
        if np.any(outside):
            raise ConfigurationError(
                f"{int(outside.sum())} of {outside.size} points lie beside the bent sensor, whose "
                f"gel is {2 * self._ends[1]:g} m wide and whose stack is {self._thickness:g} m "
                "thick; a rolled sensor needs a kinematic fixture, Hinge(...) or FreeArc(...)"
            )
        return x, np.clip(x, -self._ends, self._ends)
