"""Sums of polynomial fields on boxes, evaluated together on grids of columns."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eitskin.simulator.presses.smooth_field import SmoothField

Array = NDArray[np.float64]

_PER_COLUMN = 4  # nodes of a grid per column, up to which the grid is evaluated
_FEW = 2_000  # columns that need not lie on a grid, so that their polynomials stay small


@dataclass(frozen=True, slots=True, eq=False)
class SmoothSum:
    """Sum of polynomial fields whose boxes have the same sides along y and z.

    Columns of quadrature points lie on the lines of a grid: fields are added up on the lines along
    x, evaluated along y once for all, and read at the columns at last.

    Attributes:
        fields: one or more.
    """

    fields: tuple[SmoothField, ...]

    def values(self, columns: Array) -> Array:
        """Displacement [m] and mean stress [Pa], (4, h, n), at columns of points (n, h, 3) [m]."""
        return np.asarray(sum(field.values(columns) for field in self.fields))

    def moved(self, columns: Array) -> Array:
        """Displacement and its derivatives by x, y, z, (12, h, n)."""
        grid = _Grid.of(columns)
        if grid is None:
            return np.asarray(sum(field.moved(columns) for field in self.fields))
        return grid.moved(self.fields)


@dataclass(frozen=True, slots=True, eq=False)
class _Grid:
    """Columns of equal heights on the nodes of a grid, or each on a line of its own along y.

    Attributes:
        x, y, z: positions of the lines and of the heights [m].
        columns: number of each column's node, along y first, (n,); None for lines of their own.
    """

    x: Array
    y: Array
    z: Array
    columns: NDArray[np.int64] | None

    @classmethod
    def of(cls, columns: Array) -> "_Grid | None":
        """Grid of columns (n, h, 3); None where many lie on none, or where heights differ."""
        heights = columns[..., 2]
        if not (heights == heights[:1]).all():
            return None
        x, of_x = np.unique(columns[:, 0, 0], return_inverse=True)
        y, of_y = np.unique(columns[:, 0, 1], return_inverse=True)
        if len(x) * len(y) > _PER_COLUMN * len(columns):
            few = len(columns) <= _FEW
            return cls(columns[:, 0, 0], columns[:, 0, 1], heights[0], None) if few else None
        return cls(x, y, heights[0], of_x * len(y) + of_y)

    def moved(self, fields: tuple[SmoothField, ...]) -> Array:
        """Displacement and its derivatives by x, y, z at the columns, (12, h, n)."""
        most = [max(field.coefficients.shape[axis] for field in fields) for axis in range(3)]
        # Polynomials along y and z, and their derivatives by x, on the lines along x.
        lines = np.zeros((2, most[2], 3, len(self.x), most[1]))
        for field in fields:
            _, ny, nz, _ = field.coefficients.shape
            solved = np.ascontiguousarray(field.coefficients[..., :3].transpose(2, 3, 0, 1))
            for line, along in zip(lines, field.basis(0, self.x), strict=True):
                line[:nz, ..., :ny] += along @ solved
        widest, highest = (
            max(fields, key=lambda field: field.coefficients.shape[axis]) for axis in (1, 2)
        )
        across, upright = widest.basis(1, self.y), highest.basis(2, self.z)
        value = self._at_columns(lines[0], across.values)
        by_x = self._at_columns(lines[1], across.values)
        by_y = self._at_columns(lines[0], across.slopes)
        found = np.empty((12, len(self.z), value.shape[-1]))
        gradient = found[3:].reshape(3, 3, *found.shape[1:])
        for whole, heights, part in (
            (found[:3], upright.values, value),
            (gradient[:, 0], upright.values, by_x),
            (gradient[:, 1], upright.values, by_y),
            (gradient[:, 2], upright.slopes, value),
        ):
            whole[:] = np.tensordot(heights, part, (1, 0)).swapaxes(0, 1)
        return found

    def _at_columns(self, lines: Array, across: Array) -> Array:
        """Values (nz, 3, n) of polynomials along y (nz, 3, lines, ny), by their basis."""
        if self.columns is None:
            return np.asarray(np.einsum("zkxb,xb->zkx", lines, across))
        on_grid = (lines @ across.T).reshape(*lines.shape[:2], -1)
        return np.asarray(on_grid[..., self.columns])
