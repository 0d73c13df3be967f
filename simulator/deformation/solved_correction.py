"""Correction of dents in a finite stack as it was solved: a field on the grid of its mesh."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RegularGridInterpolator
from scipy.spatial import cKDTree

from eitskin.simulator.deformation.solution_store import Arrays
from eitskin.simulator.mechanics.box_fields import QuadraticField
from eitskin.simulator.mechanics.fitted_plan import UNIT, unfit

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Correction:
    """Correction of dents in the finite stack.

    Attributes:
        displacement: c in the whole stack, heights over the base [m].
        mean_stress: function of points, q in the gel [Pa], heights over the base.
        bottom: height of the gel's lower face over the base [m].
        sunk: length by which each indenter sinks deeper than in the unbounded stack; of a footprint
            its depth, (presses,) [m].
        holding: state of each contact: force [N], largest mean pressure of a cell [Pa], and part
            of a footprint that touches, (presses, 3). For dents those of the correction alone.
        unknowns: unknowns of the solid, from which a neighbouring correction may start; none where
            it was stored.
        fit: shift of places on the grid of c and q by fitting to the rims; None for boxes.
    """

    displacement: QuadraticField
    mean_stress: RegularGridInterpolator
    bottom: float
    sunk: Array
    holding: Array
    unknowns: Array
    fit: QuadraticField | None = None

    @classmethod
    def from_arrays(cls, arrays: Arrays) -> "Correction":
        """Correction as it was stored."""
        x, y, z = (arrays[f"lines {axis}"] for axis in "xyz")
        return cls(
            QuadraticField((x, y, z), arrays["displacement"]),
            _interpolator([arrays[f"stress {axis}"] for axis in "xyz"], arrays["mean_stress"]),
            float(arrays["bottom"]),
            arrays["sunk"],
            arrays["holding"],
            np.zeros(0),
            QuadraticField((x, y, UNIT), arrays["fit"]) if "fit" in arrays else None,
        )

    def arrays(self) -> Arrays:
        """Arrays by name, as they are stored."""
        stress = self.mean_stress
        return {
            **{f"lines {k}": a for k, a in zip("xyz", self.displacement.lines, strict=True)},
            **{f"stress {k}": a for k, a in zip("xyz", stress.grid, strict=True)},
            "displacement": self.displacement.values,
            "mean_stress": stress.values,
            "bottom": np.array(self.bottom),
            "sunk": self.sunk,
            "holding": self.holding,
            **({} if self.fit is None else {"fit": self.fit.values}),
        }

    def thinning(self, x: float, y: float) -> float:
        """Thinning of the gel at (x, y) [m]: 1 - thickness over undeformed thickness."""
        heights = self.mean_stress.grid[2][[0, -1]]
        places, _ = self._places(np.column_stack([[x, x], [y, y], heights - self.bottom]))
        ends = self.displacement(places)[:, 2]
        return float((ends[0] - ends[1]) / np.diff(heights)[0])

    def in_gel(self, points: Array) -> Array:
        """c [m] and q [Pa], (..., 4), at points of the gel over its bottom, (..., 3) [m]."""
        places, _ = self._places(points)
        return np.concatenate(
            [self.displacement(places), self.mean_stress(places)[..., None]], axis=-1
        )

    def values(self, columns: Array) -> Array:
        """c [m] and q [Pa], (4, h, n), at columns of points (n, h, 3) [m]."""
        return np.ascontiguousarray(self.in_gel(columns).transpose(2, 1, 0))

    def displacement_and_gradient(self, columns: Array) -> Array:
        """c and its derivatives by x, y, z, (12, h, n), at columns of points (n, h, 3) [m]."""
        places, slope = self._places(columns)
        slopes = self.displacement.derivative(places)
        slopes = slopes if slope is None else slopes @ slope
        slopes = slopes.reshape(*columns.shape[:2], 9)
        moved: Array = np.concatenate([self.displacement(places), slopes], axis=-1)
        return moved.transpose(2, 1, 0)

    def _places(self, points: Array) -> tuple[Array, Array | None]:
        """Places on the grid of points over the gel's bottom, and their derivative."""
        over_base: Array = points + np.array([0.0, 0.0, self.bottom])
        return (over_base, None) if self.fit is None else unfit(self.fit, over_base)


def on_grid(points: Array, values: Array, lines: Sequence[Array]) -> Array:
    """Values (n, k) at points (n, 3) of a grid, as (nx, ny, nz, k).

    Where the grid has no node, next to a body that does not fill it, stands the nearest node's
    value of the same height.
    """
    numbers = [
        np.searchsorted(0.5 * (line[1:] + line[:-1]), points[:, axis])
        for axis, line in enumerate(lines)
    ]
    grid_values = np.full((*(len(line) for line in lines), values.shape[1]), np.nan)
    grid_values[tuple(numbers)] = values
    filled = np.zeros(grid_values.shape[:2], dtype=bool)
    filled[numbers[0], numbers[1]] = True
    if not filled.all():
        plane = np.stack(np.meshgrid(lines[0], lines[1], indexing="ij"), axis=-1)
        nearest = cKDTree(plane[filled]).query(plane[~filled])[1]
        grid_values[~filled] = grid_values[filled][nearest]
    return grid_values


def gel_interpolator(values: Array, lines: tuple[Array, Array, Array]) -> RegularGridInterpolator:
    """Interpolator of values on the grid, which are NaN outside the gel."""
    inside_gel = np.isfinite(values)
    axes = [np.flatnonzero(inside_gel.any(axis=tuple({0, 1, 2} - {axis}))) for axis in range(3)]
    inside = tuple(slice(found[0], found[-1] + 1) for found in axes)
    grid = [line[part] for line, part in zip(lines, inside, strict=True)]
    return _interpolator(grid, values[inside])


def _interpolator(grid: Sequence[Array], values: Array) -> RegularGridInterpolator:
    """Trilinear interpolator that goes on linearly beyond the grid."""
    return RegularGridInterpolator(tuple(grid), values, bounds_error=False, fill_value=None)
