"""Contacts on a bent stack: the bent state, and the tangent of its top under an indenter."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_BESIDE = 1e-4  # [m]; gradients of a solution in boxes jump between them


class BentState(Protocol):
    """Equilibrium of the whole bent stack, in the coordinates of the design."""

    def __hash__(self) -> int:
        """Hash, under which solved presses are kept."""
        ...

    def positions(self, points: Array) -> Array:
        """Bent positions [m], (..., 3), of flat points [m], (..., 3)."""
        ...

    def gradient(self, points: Array) -> Array:
        """Deformation gradient, (..., 3, 3)."""
        ...

    def mean_stress(self, points: Array) -> Array:
        """Mean stress of the mixed form [Pa], (...), without the part that acts directly."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class ContactFrame:
    """Tangent frame of the bent top of a stack at a point under an indenter.

    A dent u_d of the flat, unbounded stack adds R u_d(x, y) to a bend, with x and y from the
    indenter's axis multiplied by the stretches of the top: the contact has its size in the bent
    sensor, and the force on the indenter is that of the dent, along the normal.

    Attributes:
        x, y: flat position of the axis [m].
        place: bent position of the touched point [m], (3,).
        rotation: R, its columns the tangents along x and y and the normal, (3, 3).
        stretches: of the top along both tangents, (2,).
    """

    x: float
    y: float
    place: Array
    rotation: Array
    stretches: Array

    @classmethod
    def at(cls, bent: BentState, x: float, y: float, top: float) -> "ContactFrame":
        """Frame of the top, at height `top` over the gel's lower face [m], under (x, y) [m]."""
        beside = _BESIDE * np.array([[-1.0, -1.0], [-1.0, 1.0], [1.0, -1.0], [1.0, 1.0]])
        touched = np.array([x, y, top])
        around = np.concatenate([touched[:2] + beside, np.full((4, 1), top)], axis=1)
        F = bent.gradient(around).mean(axis=0)
        along, normal = F[:, 0] / np.linalg.norm(F[:, 0]), np.cross(F[:, 0], F[:, 1])
        normal /= np.linalg.norm(normal)
        rotation = np.stack([along, np.cross(normal, along), normal], axis=1)
        stretches = np.linalg.norm(F[:, :2], axis=0)
        return cls(x, y, bent.positions(touched), rotation, stretches)

    @property
    def normal(self) -> Array:
        """Normal of the bent top, (3,)."""
        return np.asarray(self.rotation[:, 2])

    def stretched(self, points: Array) -> Array:
        """Points (..., 3) [m] with their distances from the axis as in the bent top."""
        axis = np.array([self.x, self.y, 0.0])
        return np.asarray(axis + (points - axis) * self._scale)

    def turned(self, vectors: Array) -> Array:
        """Vectors (..., 3) of a dent in the directions of the bent top."""
        return np.asarray(vectors @ self.rotation.T)

    def gradient(self, gradient: Array) -> Array:
        """Displacement gradient (..., 3, 3) of the turned dent by flat positions."""
        return np.asarray(self.rotation @ gradient * self._scale)

    def nominal(self, stress: Array) -> Array:
        """First Piola-Kirchhoff stress (..., 3, 3) [Pa] of the turned dent by flat areas."""
        return np.asarray(self.rotation @ stress * (np.prod(self._scale) / self._scale))

    def flattened(self, points: Array) -> Array:
        """Positions (n, 3) [m] of points (n, 3) of the top that is pressed flat."""
        away = self.stretched(points) - np.array([self.x, self.y, 0.0])
        away[:, 2] = 0.0
        return np.asarray(self.place + self.turned(away))

    @property
    def _scale(self) -> Array:
        return np.array([*self.stretches, 1.0])
