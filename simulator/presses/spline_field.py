"""Spline fields on a box: cubic splines in the plane, Legendre polynomials over the height."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import NDArray

from eitskin.simulator.mechanics.cubic_splines import CubicSplines, in_plane
from eitskin.simulator.presses.smooth_field import Box

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class SplineField:
    """Field on a box, which may vary within some cells of the plane much more than elsewhere.

    Points beyond the box have the values of its faces.

    Attributes:
        nodes: of the splines along x and along y, (nx,) and (ny,) [m].
        height: of the box, from 0 [m].
        coefficients: of k components, (nx, ny, nz, k).
    """

    nodes: tuple[Array, Array]
    height: float
    coefficients: Array

    @classmethod
    def of(
        cls, field: Callable[[Array], Array], nodes: tuple[Array, Array], height: float, degree: int
    ) -> "SplineField":
        """Interpolate `field`, which gives (..., k) at points (..., 3) [m]."""
        levels = legendre.leggauss(degree + 1)[0]
        z = 0.5 * height * (levels + 1.0)
        values = field(np.stack(np.meshgrid(*nodes, z, indexing="ij"), axis=-1))
        along, across = (CubicSplines(each).fit for each in nodes)
        upright = np.linalg.inv(legendre.legvander(levels, degree))
        fitted = np.einsum("ai,bj,cl,ijlk->abck", along, across, upright, values, optimize=True)
        return cls(nodes, height, np.ascontiguousarray(fitted))

    @property
    def box(self) -> Box:
        """Box of the field."""
        (x, *_, x_end), (y, *_, y_end) = (each.tolist() for each in self.nodes)
        return Box((x, y, 0.0), (x_end, y_end, self.height))

    @property
    def splines(self) -> tuple[CubicSplines, CubicSplines]:
        """Splines along x and along y."""
        along, across = self.nodes
        return CubicSplines(along), CubicSplines(across)

    def values(self, columns: Array) -> Array:
        """All components (k, h, n) at columns of points (n, h, 3) [m]."""
        heights, _ = self.over_height(columns[..., 2])
        return np.asarray(np.einsum("nzk,nhz->khn", self._in_plane(columns)[:, 0], heights))

    def moved(self, columns: Array) -> Array:
        """First three components and their derivatives by x, y, z, (12, h, n)."""
        sums = self._in_plane(columns)[..., :3]
        heights, rates = self.over_height(columns[..., 2])
        found = np.empty((4, 3, columns.shape[1], len(columns)))
        both = ((0, heights), (1, heights), (2, heights), (0, rates))
        for each, (part, height) in zip(found, both, strict=True):
            each[:] = np.einsum("nzk,nhz->khn", sums[:, part], height)
        gradient = found[1:].swapaxes(0, 1).reshape(9, *found.shape[2:])
        return np.concatenate([found[0], gradient])

    def _in_plane(self, columns: Array) -> Array:
        """Polynomials over the height, and their slopes by x and y, (n, 3, nz, k)."""
        ends = np.array([(nodes[0], nodes[-1]) for nodes in self.nodes])
        points = np.clip(columns[:, 0, :2], ends[:, 0], ends[:, 1])
        shape = self.coefficients.shape
        flat = self.coefficients.reshape(*shape[:2], -1)
        return in_plane(self.splines, flat, points).reshape(len(points), 3, *shape[2:])

    def over_height(self, z: Array) -> tuple[Array, Array]:
        """Legendre polynomials (..., nz) at heights z (...), and their derivatives [1/m]."""
        degree = self.coefficients.shape[2] - 1
        s = np.clip(2.0 * z / self.height - 1.0, -1.0, 1.0)
        values = np.asarray(legendre.legvander(s, degree), dtype=np.float64)
        slope = legendre.legder(np.eye(degree + 1))
        rates: Array = values[..., : len(slope)] @ slope * (2.0 / self.height)
        return values, rates
