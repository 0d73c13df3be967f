"""Spline fields on a box: cubic splines in the plane, Legendre polynomials over the height."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import NDArray

from eitskin.simulator.mechanics.cubic_splines import CubicSplines, numbers_of_products, summed
from eitskin.simulator.presses.smooth_field import Box

Array = NDArray[np.float64]

_AT_ONCE = 20_000  # columns, so that gathered values stay small


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

    def values(self, columns: Array) -> Array:
        """All components (k, h, n) at columns of points (n, h, 3) [m]."""
        return self._in_parts(columns, self._values)

    def moved(self, columns: Array) -> Array:
        """First three components and their derivatives by x, y, z, (12, h, n)."""
        return self._in_parts(columns, self._moved)

    def _in_parts(self, columns: Array, evaluated: Callable[[Array], Array]) -> Array:
        starts = range(0, max(len(columns), 1), _AT_ONCE)
        parts = [evaluated(columns[start : start + _AT_ONCE]) for start in starts]
        return parts[0] if len(parts) == 1 else np.concatenate(parts, axis=-1)

    def _values(self, columns: Array) -> Array:
        (value,) = self._in_plane(columns[:, 0], slopes=False)
        heights, _ = self._over_height(columns[..., 2])
        return np.asarray(np.einsum("nzk,nhz->khn", value, heights))

    def _moved(self, columns: Array) -> Array:
        value, *slopes = (each[..., :3] for each in self._in_plane(columns[:, 0], slopes=True))
        heights, rates = self._over_height(columns[..., 2])
        found = np.empty((4, 3, columns.shape[1], len(columns)))
        found[0] = np.einsum("nzk,nhz->khn", value, heights)
        for k, slope in enumerate(slopes, 1):
            found[k] = np.einsum("nzk,nhz->khn", slope, heights)
        found[3] = np.einsum("nzk,nhz->khn", value, rates)
        gradient = found[1:].swapaxes(0, 1).reshape(9, *found.shape[2:])
        return np.concatenate([found[0], gradient])

    def _in_plane(self, points: Array, slopes: bool) -> list[Array]:
        """Polynomials over the height (n, nz, k) at points (n, 3), and their slopes by x and y."""
        x, y = (
            np.clip(points[:, axis], nodes[0], nodes[-1]) for axis, nodes in enumerate(self.nodes)
        )
        (i, a, da), (j, b, db) = (
            CubicSplines(nodes).functions(at) for nodes, at in zip(self.nodes, (x, y), strict=True)
        )
        shape = self.coefficients.shape
        numbers = numbers_of_products(i, j, shape[1])
        flat = self.coefficients.reshape(shape[0] * shape[1], -1)
        pairs = [(a, b), (da, b), (a, db)] if slopes else [(a, b)]
        return [summed(numbers, *pair, flat).reshape(len(x), *shape[2:]) for pair in pairs]

    def _over_height(self, z: Array) -> tuple[Array, Array]:
        """Legendre polynomials (..., nz) at heights z (...), and their derivatives [1/m]."""
        degree = self.coefficients.shape[2] - 1
        s = np.clip(2.0 * z / self.height - 1.0, -1.0, 1.0)
        values = np.asarray(legendre.legvander(s, degree), dtype=np.float64)
        slope = legendre.legder(np.eye(degree + 1))
        rates: Array = values[..., : len(slope)] @ slope * (2.0 / self.height)
        return values, rates
