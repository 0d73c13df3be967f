"""Spline field in a frame that is turned about the vertical."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eitskin.simulator.presses.fields.spline_field import SplineField

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class TurnedField:
    """Displacement field in a frame at (x, y), turned about z.

    Attributes:
        field: in its own frame.
        x, y: origin of the frame [m].
        cos, sin: of the angle from the sensor's x axis to the frame's.
    """

    field: SplineField
    x: float
    y: float
    cos: float
    sin: float

    def straightened(self) -> SplineField:
        """The field in the sensor's own frame, where the frame is turned by a right angle or none.

        Such frames are turned exactly: splines on mirrored nodes are the mirrored splines.
        """
        c, s = round(self.cos), round(self.sin)
        along, across = self.field.nodes
        coefficients = self.field.coefficients.copy()
        u, v = coefficients[..., 0].copy(), coefficients[..., 1].copy()
        coefficients[..., 0], coefficients[..., 1] = c * u - s * v, s * u + c * v
        if s:
            coefficients = coefficients.swapaxes(0, 1)
            along, across = across, along
        for axis, way in enumerate((c - s, c + s)):
            if way < 0:
                coefficients = np.flip(coefficients, axis)
        x, y = (
            at + (nodes if way > 0 else -nodes[::-1])
            for at, way, nodes in ((self.x, c - s, along), (self.y, c + s, across))
        )
        return SplineField((x, y), self.field.height, np.ascontiguousarray(coefficients))

    def values(self, columns: Array) -> Array:
        """Displacement [m] and mean stress [Pa], (4, h, n), at columns of points (n, h, 3) [m]."""
        found = self.field.values(self._within(columns))
        found[:2] = np.einsum("ij,jhn->ihn", self._turn[:2, :2], found[:2])
        return found

    def moved(self, columns: Array) -> Array:
        """Displacements and their derivatives by x, y, z, (12, h, n)."""
        length, width, _ = self.field.box.high
        turn = (float(self.x), float(self.y), float(self.cos), float(self.sin))
        compiled = self.field.in_frame(turn, (length, width), columns)
        if compiled is not None:
            return compiled
        found = np.zeros((12, columns.shape[1], len(columns)))
        near = self.near(columns)
        if not near.any():
            return found
        inner = self.field.moved(self._within(columns[near]))
        Q = self._turn
        found[:3, :, near] = np.einsum("ij,jhn->ihn", Q, inner[:3])
        slopes = inner[3:].reshape(3, 3, *inner.shape[1:])
        turned = np.einsum("ij,jkhn,lk->ilhn", Q, slopes, Q, optimize=True)
        found[3:, :, near] = turned.reshape(9, *inner.shape[1:])
        return found

    @property
    def _turn(self) -> Array:
        return np.array([[self.cos, -self.sin, 0.0], [self.sin, self.cos, 0.0], [0.0, 0.0, 1.0]])

    def near(self, columns: Array) -> NDArray[np.bool_]:
        """Columns in the box of the field."""
        at, high = self._within(columns[:, :1])[:, 0], self.field.box.high
        near: NDArray[np.bool_] = (np.abs(at[:, 0]) < high[0]) & (np.abs(at[:, 1]) < high[1])
        return near

    def _within(self, columns: Array) -> Array:
        """Columns in the frame of the field."""
        within = columns - np.array([self.x, self.y, 0.0])
        turned: Array = within @ self._turn
        return turned
