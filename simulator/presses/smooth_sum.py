"""Sums of polynomial fields on boxes, evaluated together on grids of columns."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eitskin.simulator.presses.smooth_field import SmoothField

Array = NDArray[np.float64]

# Nodes of a grid, per column and in all, up to which the grid is evaluated.
_PER_COLUMN, _SMALL = 4, 2_000


@dataclass(frozen=True, slots=True, eq=False)
class SmoothSum:
    """Sum of polynomial fields whose boxes have the same sides along y.

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
    """Grid of columns of equal heights.

    Attributes:
        x, y, z: positions on the lines and of the heights [m].
        columns: number of each column's node, along y first, (n,).
    """

    x: Array
    y: Array
    z: Array
    columns: NDArray[np.int64]

    @classmethod
    def of(cls, columns: Array) -> "_Grid | None":
        """Grid of columns (n, h, 3); None where they lie on none, or their heights differ."""
        heights = columns[..., 2]
        if not (heights == heights[:1]).all():
            return None
        x, of_x = np.unique(columns[:, 0, 0], return_inverse=True)
        y, of_y = np.unique(columns[:, 0, 1], return_inverse=True)
        if len(x) * len(y) > max(_PER_COLUMN * len(columns), _SMALL):
            return None
        return cls(x, y, heights[0], of_x * len(y) + of_y)

    def moved(self, fields: tuple[SmoothField, ...]) -> Array:
        """Displacement and its derivatives by x, y, z at the columns, (12, h, n)."""
        most = max(fields, key=lambda field: field.coefficients.shape[1])
        # Polynomials along y, of the values and the derivatives by x and z, on the lines along x.
        lines = np.zeros((3, len(self.x), 3 * len(self.z), most.coefficients.shape[1]))
        for field in fields:
            x, heights = field.basis(0, self.x), field.basis(2, self.z)
            count = field.coefficients.shape[1]
            upright = [
                np.einsum("abck,hc->akhb", field.coefficients[..., :3], each).reshape(
                    len(x[0].T), -1
                )
                for each in heights
            ]
            parts = x.values @ upright[0], x.slopes @ upright[0], x.values @ upright[1]
            for line, part in zip(lines, parts, strict=True):
                line[..., :count] += part.reshape(len(self.x), -1, count)
        across = most.basis(1, self.y)
        shape = (len(self.x), 3, len(self.z), len(self.y))
        found = np.empty((4, 3, len(self.z), len(self.columns)))
        both = ((0, across.values), (1, across.values), (0, across.slopes), (2, across.values))
        for each, (part, basis) in zip(found, both, strict=True):
            whole = (lines[part] @ basis.T).reshape(shape).transpose(1, 2, 0, 3)
            each[:] = whole.reshape(3, len(self.z), -1)[..., self.columns]
        gradient = found[1:].swapaxes(0, 1)
        return np.concatenate([found[0], gradient.reshape(9, *found.shape[2:])])
