"""Quadratic fields on a grid of boxes, and trilinear ones that may jump between the boxes."""

from dataclasses import dataclass
from typing import Self

import numpy as np
import skfem
from numpy.typing import NDArray

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

_AT_ONCE = 20_000  # points, per chunk, so that gathered values stay small


@dataclass(frozen=True, slots=True, eq=False)
class QuadraticField:
    """Continuous field, quadratic along each axis within each box.

    Points outside the grid belong to the nearest box.

    Attributes:
        lines: grid lines along x, y and z [m].
        values: values at corners and middles of the boxes, (2 nx + 1, 2 ny + 1, 2 nz + 1, k).
    """

    lines: tuple[Array, Array, Array]
    values: Array

    def __call__(self, points: Array) -> Array:
        """Values (..., k) of the field at points (..., 3) [m]."""
        return self._in_parts(points, ((0, 0, 0),))[..., 0]

    def derivative(self, points: Array) -> Array:
        """Derivative of the field along x, y and z, (..., k, 3), exact inside the boxes."""
        return self._in_parts(points, ((1, 0, 0), (0, 1, 0), (0, 0, 1)))

    def _in_parts(self, points: Array, orders: tuple[tuple[int, int, int], ...]) -> Array:
        flat = points.reshape(-1, 3)
        parts = [
            self._evaluate(flat[start : start + _AT_ONCE], orders)
            for start in range(0, max(len(flat), 1), _AT_ONCE)
        ]
        return np.concatenate(parts).reshape(*points.shape[:-1], -1, len(orders))

    def _evaluate(self, points: Array, orders: tuple[tuple[int, int, int], ...]) -> Array:
        """Derivatives of these orders, (points, k, orders)."""
        (i, a), (j, b), (k, c) = (
            shape_functions(line, x) for line, x in zip(self.lines, points.T, strict=True)
        )
        near = self.values[i[:, :, None, None], j[:, None, :, None], k[:, None, None, :]]
        derivatives = np.empty((len(points), self.values.shape[-1], len(orders)))
        for order, (x, y, z) in enumerate(orders):
            plane = np.einsum("nabck,na->nbck", near, a[x])
            derivatives[..., order] = np.einsum("nbck,nb,nc->nk", plane, b[y], c[z], optimize=True)
        return derivatives


def shape_functions(lines: Array, x: Array) -> tuple[Indices, tuple[Array, Array]]:
    """Numbers, shape functions and slopes of three quadratic nodes along one axis, (n, 3) each."""
    cell = np.clip(np.searchsorted(lines, x, side="right") - 1, 0, len(lines) - 2)
    size = np.diff(lines)[cell]
    t = (x - lines[cell]) / size
    values = np.stack([(1 - t) * (1 - 2 * t), 4 * t * (1 - t), t * (2 * t - 1)], axis=-1)
    slopes = np.stack([4 * t - 3, 4 - 8 * t, 4 * t - 1], axis=-1) / size[:, None]
    return 2 * cell[:, None] + np.arange(3), (values, slopes)


@dataclass(frozen=True, slots=True, eq=False)
class CornerField:
    """Scalar field, linear along each axis within each box.

    Points outside the grid belong to the nearest box.

    Attributes:
        lines: grid lines along x, y and z [m].
        values: values of each box at its lower and upper ends along x, y and z, (nx, ny, nz, 2, 2,
            2).
    """

    lines: tuple[Array, Array, Array]
    values: Array

    @classmethod
    def from_corner_values(
        cls, mesh: skfem.MeshHex, lines: tuple[Array, Array, Array], values: Array
    ) -> Self:
        """Arrange values (cells, 8) at the corners of all boxes of a grid."""
        corners = mesh.p[:, mesh.t]  # (3, 8, cells)
        middles = corners.mean(axis=1, keepdims=True)
        cells = [np.searchsorted(line, x) - 1 for line, x in zip(lines, middles[:, 0], strict=True)]
        upper = (corners > middles).astype(np.int64)
        grid = np.empty((*(len(line) - 1 for line in lines), 2, 2, 2))
        grid[tuple(cell[None] for cell in cells) + tuple(upper)] = values.T
        return cls(lines, grid)

    def __call__(self, points: Array) -> Array:
        """Values (...) at points (..., 3) [m]."""
        flat = points.reshape(-1, 3)
        (i, a), (j, b), (k, c) = (
            _locate_interval(line, x) for line, x in zip(self.lines, flat.T, strict=True)
        )
        values = np.einsum("nabc,na,nb,nc->n", self.values[i, j, k], a, b, c, optimize=True)
        return np.asarray(values).reshape(points.shape[:-1])


def _locate_interval(line: Array, x: Array) -> tuple[Indices, Array]:
    """Numbers (n,) of the intervals of points (n,), and weights (n, 2) of their two ends."""
    cell = np.clip(np.searchsorted(line, x, side="right") - 1, 0, len(line) - 2)
    t = (x - line[cell]) / np.diff(line)[cell]
    return cell, np.stack([1.0 - t, t], axis=-1)
