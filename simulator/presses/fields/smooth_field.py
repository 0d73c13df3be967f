"""Polynomial fields on a box: Chebyshev polynomials in the plane, Legendre over the height."""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.polynomial import chebyshev, legendre
from numpy.typing import NDArray

Array = NDArray[np.float64]

_AT_ONCE = 1_000  # columns that do not lie on a grid
_LAYERS = 8  # of columns of different heights, up to which each layer is evaluated by itself
_PER_GRID = 4  # nodes of a grid per column, up to which the grid is evaluated


class Box(NamedTuple):
    """Box by its lowest and highest corner (x, y, z) [m]."""

    low: tuple[float, float, float]
    high: tuple[float, float, float]


class Basis(NamedTuple):
    """Polynomials and their derivatives at positions along one axis, (positions, count) each."""

    values: Array
    slopes: Array


@dataclass(frozen=True, slots=True, eq=False)
class SmoothField:
    """Field on a box as a product of Chebyshev (x, y) and Legendre (z) polynomials.

    Along x the polynomials are those of s, x = middle + half length * sinh(k s) / sinh(k), which
    resolves the middle of the box as finely as is wanted; k = 0 leaves x as it is. The field is
    zero beyond the ends of x, and keeps its value beyond the other faces of the box.

    Attributes:
        box: domain of the field.
        coefficients: of k components, (nx, ny, nz, k).
        stretch: k.
    """

    box: Box
    coefficients: Array
    stretch: float = 0.0

    @classmethod
    def of(
        cls,
        field: Callable[[Array], Array],
        box: Box,
        counts: tuple[int, int, int],
        stretch: float = 0.0,
    ) -> "SmoothField":
        """Interpolate `field`, which gives (..., k) at points (..., 3) [m]."""
        empty = cls(box, np.zeros((*counts, 0)), stretch)
        nodes = [*(chebyshev.chebpts1(n) for n in counts[:2]), legendre.leggauss(counts[2])[0]]
        along = [empty._along(axis, at) for axis, at in enumerate(nodes)]
        values = field(np.stack(np.meshgrid(*along, indexing="ij"), axis=-1))
        for axis, at in enumerate(nodes):
            inverse = np.linalg.inv(_polynomials(axis, at, counts[axis]))
            values = np.moveaxis(np.tensordot(inverse, values, axes=(1, axis)), 0, axis)
        return replace(empty, coefficients=np.ascontiguousarray(values))

    def shifted(self, x: float) -> "SmoothField":
        """The same field, moved along x [m]."""
        low, high = self.box
        return replace(self, box=Box((low[0] + x, *low[1:]), (high[0] + x, *high[1:])))

    def scaled(self, factor: float) -> "SmoothField":
        """The field times a factor."""
        return replace(self, coefficients=factor * self.coefficients)

    def raised(self, factor: float) -> "SmoothField":
        """The displacement field of a box `factor` times as high."""
        low, high = self.box
        box = Box((*low[:2], factor * low[2]), (*high[:2], factor * high[2]))
        upward = np.ones(self.coefficients.shape[-1])
        upward[2] = factor
        return replace(self, box=box, coefficients=self.coefficients * upward)

    def mirrored(self, axis: int, at: float) -> "SmoothField":
        """Mirror image in the plane x or y = `at` [m], of displacements and further scalars."""
        coefficients = self.coefficients * _mirror(axis, self.coefficients)
        low, high = list(self.box.low), list(self.box.high)
        low[axis], high[axis] = 2.0 * at - high[axis], 2.0 * at - low[axis]
        box = Box((low[0], low[1], low[2]), (high[0], high[1], high[2]))
        return SmoothField(box, coefficients, self.stretch)

    def values(self, columns: Array) -> Array:
        """All components (k, h, n) at columns of points (n, h, 3) [m]."""
        (found,) = self._evaluated(columns, ((0, 0, 0),), slice(None))
        return found

    def moved(self, columns: Array) -> Array:
        """First three components and their derivatives by x, y, z, (12, h, n)."""
        orders = ((0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1))
        u, *slopes = self._evaluated(columns, orders, slice(3))
        gradient = np.stack(slopes, axis=1)
        return np.concatenate([u, gradient.reshape(9, *u.shape[1:])])

    def _evaluated(
        self, columns: Array, orders: tuple[tuple[int, int, int], ...], part: slice
    ) -> list[Array]:
        """Derivatives of these orders of some components, (k, h, n) each."""
        n, h = columns.shape[:2]
        layers = _layers(columns[..., 2])
        if len(layers) == 1:
            return self._in_layer(columns, orders, part)
        if not layers:
            single = self._at_points(columns.reshape(-1, 3), orders, part)
            return [one.reshape(-1, n, h).swapaxes(1, 2) for one in single]
        count = self.coefficients[..., part].shape[-1]
        found = [np.empty((count, h, n)) for _ in orders]
        for layer in layers:
            parts = self._in_layer(columns[layer], orders, part)
            for whole, values in zip(found, parts, strict=True):
                whole[..., layer] = values
        return found

    def _in_layer(
        self, columns: Array, orders: tuple[tuple[int, int, int], ...], part: slice
    ) -> list[Array]:
        """As `_evaluated`, at columns of equal heights."""
        n, h = columns.shape[:2]
        heights = self.basis(2, columns[0, :, 2] if n else np.zeros(h))
        coefficients = self.coefficients[..., part]
        # Polynomials in the plane for the values (0) and upward derivatives (1) at each height.
        planes = [
            np.ascontiguousarray(np.tensordot(coefficients, each, (2, 1)).transpose(2, 3, 0, 1))
            for each in heights[: 1 + max(k for *_, k in orders)]
        ]
        x, where_x = np.unique(columns[:, 0, 0], return_inverse=True)
        y, where_y = np.unique(columns[:, 0, 1], return_inverse=True)
        if len(x) * len(y) <= _PER_GRID * n:
            grid = _in_plane(planes, self.basis(0, x), self.basis(1, y), orders)
            return [(along @ across.T)[..., where_x, where_y] for along, across in grid]
        found = [np.empty((*planes[0].shape[:2], n)) for _ in orders]
        for start in range(0, n, _AT_ONCE):
            near = slice(start, start + _AT_ONCE)
            x, y = columns[near, 0, 0], columns[near, 0, 1]
            parts = _in_plane(planes, self.basis(0, x), self.basis(1, y), orders)
            for values, (along, across) in zip(found, parts, strict=True):
                values[..., near] = np.einsum("mhnb,nb->mhn", along, across)
        return found

    def _at_points(
        self, points: Array, orders: tuple[tuple[int, int, int], ...], part: slice
    ) -> list[Array]:
        """Derivatives of these orders of some components at points (n, 3), (k, n) each."""
        c = self.coefficients[..., part]
        slabs, count = c.reshape(len(c), -1), c.shape[-1]
        found = [np.empty((count, len(points))) for _ in orders]
        for start in range(0, len(points), _AT_ONCE):
            some = slice(start, start + _AT_ONCE)
            x, y, z = (self.basis(axis, points[some, axis]) for axis in range(3))
            columns = [
                (each @ slabs).reshape(-1, c.shape[1], c.shape[2] * count)
                for each in x[: 1 + max(i for i, *_ in orders)]
            ]
            for values, (i, j, k) in zip(found, orders, strict=True):
                upright = (y[j][:, None] @ columns[i]).reshape(-1, c.shape[2], count)
                values[:, some] = np.einsum("nck,nc->kn", upright, z[k])
        return found

    def _along(self, axis: int, s: Array) -> Array:
        """Positions [m] at coordinates s from -1 to 1."""
        low, high = self.box.low[axis], self.box.high[axis]
        if axis == 0 and self.stretch:
            s = np.sinh(self.stretch * s) / math.sinh(self.stretch)
        return 0.5 * (low + high) + 0.5 * (high - low) * s

    def basis(self, axis: int, positions: Array) -> Basis:
        """Polynomials along an axis, and their derivatives, at positions (n,) [m]."""
        low, high = self.box.low[axis], self.box.high[axis]
        s = (2.0 * positions - low - high) / (high - low)
        rate = np.full(s.shape, 2.0 / (high - low))
        outside = np.abs(s) > 1.0 + 1e-9
        s = np.clip(s, -1.0, 1.0)
        if axis == 0 and self.stretch:
            scale = math.sinh(self.stretch)
            rate *= scale / (self.stretch * np.sqrt(1.0 + (s * scale) ** 2))
            s = np.arcsinh(s * scale) / self.stretch
        count = self.coefficients.shape[axis]
        values = _polynomials(axis, s, count)
        slopes = values @ _differentiation(axis, count) * rate[:, None]
        slopes[outside] = 0.0
        if axis == 0:
            values[outside] = 0.0
        return Basis(values, slopes)


def _mirror(axis: int, coefficients: Array) -> Array:
    """Factors of coefficients (nx, ny, nz, k) that mirror a field along x (0) or y (1)."""
    return _signs(axis, coefficients.shape[axis], coefficients.shape[-1], coefficients.dtype.char)


@lru_cache(maxsize=64)
def _signs(axis: int, count: int, components: int, kind: str) -> Array:
    """Signs of odd polynomials and of displacements along the axis, in the precision of fields."""
    signs = np.ones((1, 1, 1, components))
    signs[..., axis] = -1.0
    shape = [1, 1, 1, 1]
    shape[axis] = -1
    return (signs * ((-1.0) ** np.arange(count)).reshape(shape)).astype(kind)


def together(fields: Iterable[SmoothField]) -> list[SmoothField]:
    """Fields of the same sum, those on one box and of one degree added up to one."""
    alike: dict[tuple[object, ...], SmoothField] = {}
    for field in fields:
        key = (field.box, field.stretch, field.coefficients.shape)
        same = alike.get(key)
        total = field.coefficients if same is None else same.coefficients + field.coefficients
        alike[key] = replace(field, coefficients=total)
    return list(alike.values())


def _layers(heights: Array) -> list[NDArray[np.bool_]]:
    """Columns of equal heights (n, h), as in a layer of cells; none where few columns are alike."""
    if (heights == heights[:1]).all():
        return [np.ones(len(heights), dtype=bool)]
    lowest, number = np.unique(heights[:, 0], return_inverse=True)
    if len(lowest) > _LAYERS:
        return []
    layers = [number == k for k in range(len(lowest))]
    alike = all((heights[layer] == heights[layer][:1]).all() for layer in layers)
    return layers if alike else []


def _polynomials(axis: int, s: Array, count: int) -> Array:
    """Polynomials along an axis at coordinates s (n,), (n, count)."""
    if axis == 2:
        return np.asarray(legendre.legvander(s, count - 1))
    return np.asarray(chebyshev.chebvander(s, count - 1))


@lru_cache(maxsize=64)
def _differentiation(axis: int, count: int) -> Array:
    """Matrix from values of polynomials, as a row, to values of their derivatives."""
    derive = legendre.legder if axis == 2 else chebyshev.chebder
    found = np.zeros((count, count))
    for k in range(1, count):
        slope = derive(np.eye(count)[k])
        found[: len(slope), k] = slope
    return found


def _in_plane(
    planes: list[Array], x: Basis, y: Basis, orders: Sequence[tuple[int, int, int]]
) -> list[tuple[Array, Array]]:
    """Polynomials along y (k, h, positions, b) at positions x, and their basis, for each order."""
    along = {(i, k): x[i] @ planes[k] for i, _, k in orders}
    return [(along[i, k], y[j]) for i, j, k in orders]
