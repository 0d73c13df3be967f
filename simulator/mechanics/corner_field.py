"""Trilinear interpolation on a grid of boxes, of values that may jump between the boxes."""

from dataclasses import dataclass
from typing import Self

import numpy as np
import skfem
from numpy.typing import NDArray

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class CornerField:
    """Scalar field, linear along each axis within each box.

    Points outside the grid belong to the nearest box.

    Attributes:
        lines: grid lines along x, y and z [m].
        values: of each box at its lower and upper ends along x, y and z, (nx, ny, nz, 2, 2, 2).
    """

    lines: tuple[Array, Array, Array]
    values: Array

    @classmethod
    def of(cls, mesh: skfem.MeshHex, lines: tuple[Array, Array, Array], values: Array) -> Self:
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
            _within(line, x) for line, x in zip(self.lines, flat.T, strict=True)
        )
        found = np.einsum("nabc,na,nb,nc->n", self.values[i, j, k], a, b, c, optimize=True)
        return np.asarray(found).reshape(points.shape[:-1])


def _within(line: Array, x: Array) -> tuple[Indices, Array]:
    """Numbers (n,) of the intervals of points (n,), and weights (n, 2) of their two ends."""
    cell = np.clip(np.searchsorted(line, x, side="right") - 1, 0, len(line) - 2)
    t = (x - line[cell]) / np.diff(line)[cell]
    return cell, np.stack([1.0 - t, t], axis=-1)
