"""Cubic splines on nodes along one axis, and sums of products of two of them."""

from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline, make_interp_spline
from scipy.sparse import csr_array

from eitskin.compiled import compiled

Array = NDArray[np.float64]
Indices = NDArray[np.int32]

_DEGREE = 3
_FUNCTIONS = _DEGREE + 1  # that do not vanish at a point
_AT_ONCE = 20_000  # points, so that gathered values stay small
_EACH = np.arange(_FUNCTIONS, dtype=np.int32)  # as sparse products take them


class CubicSplines:
    """B-splines of degree 3 that interpolate values at nodes, without a knot at the second node.

    Source: de Boor, A Practical Guide to Splines, chapters IX, X and XIII.

    Attributes:
        nodes: rising, four or more, (n,).
        knots: where the pieces of the splines meet, (n + 4,).
    """

    def __init__(self, nodes: Array) -> None:
        """Place the knots."""
        self.nodes = nodes
        inner, ends = nodes[2:-2], (np.full(_FUNCTIONS, nodes[0]), np.full(_FUNCTIONS, nodes[-1]))
        self.knots: Array = np.concatenate([ends[0], inner, ends[1]])

    @cached_property
    def fit(self) -> Array:
        """Coefficients of the splines by the values at the nodes, (n, n)."""
        return np.asarray(make_interp_spline(self.nodes, np.eye(len(self.nodes)), k=_DEGREE).c)

    def at(self, x: Array) -> Array:
        """All splines at points (m,), those beyond the nodes moved to the next, (m, n)."""
        first, near, _ = self.functions(np.clip(x, self.nodes[0], self.nodes[-1]))
        found = np.zeros((len(x), len(self.nodes)))
        np.put_along_axis(found, first[:, None] + _EACH, near, axis=1)
        return found

    def functions(self, x: Array) -> tuple[Indices, Array, Array]:
        """Number of the first spline at points (m,), values and slopes of the four, (m, 4).

        Points beyond the nodes belong to the outermost intervals.
        """
        t, last = self.knots, len(self.nodes) - 1
        cell = np.clip(np.searchsorted(t, x, side="right") - 1, _DEGREE, last)
        right = [t[cell + k] - x for k in range(1, _FUNCTIONS)]
        left = [x - t[cell + 1 - k] for k in range(1, _FUNCTIONS)]
        lower: list[Array] = []
        values = [np.ones_like(x)]
        for degree in range(1, _FUNCTIONS):
            lower, values = values, [np.zeros_like(x)]
            for r in range(degree):
                part = lower[r] / (right[r] + left[degree - r - 1])
                values[-1] = values[-1] + right[r] * part
                values.append(left[degree - r - 1] * part)
        rates = [_DEGREE * lower[r] / (right[r] + left[_DEGREE - r - 1]) for r in range(_DEGREE)]
        zero = np.zeros_like(x)
        slopes = [
            before - after for before, after in zip([zero, *rates], [*rates, zero], strict=True)
        ]
        first: Indices = (cell - _DEGREE).astype(np.int32)
        return first, np.stack(values, axis=-1), np.stack(slopes, axis=-1)


@lru_cache(maxsize=64)
def cubic_splines(nodes: tuple[float, ...]) -> CubicSplines:
    """Splines on nodes, made once."""
    return CubicSplines(np.array(nodes))


def spline_weights(nodes: Array, at: float) -> Array:
    """Weights of the values at nodes in their cubic spline at one position, (n,)."""
    return np.array(_cardinal_splines(tuple(nodes.tolist()))(at))


@lru_cache(maxsize=64)
def _cardinal_splines(nodes: tuple[float, ...]) -> CubicSpline:
    return CubicSpline(nodes, np.eye(len(nodes)))


def in_plane(
    splines: tuple[CubicSplines, CubicSplines], coefficients: Array, points: Array
) -> Array:
    """Sums of products of splines, and their slopes by x and by y, (m, 3, k).

    Args:
        splines: along x and along y.
        coefficients: of the products, (nx, ny, k).
        points: (m, 2); those beyond the nodes belong to the outermost intervals.
    """
    along, across = splines
    found = np.empty((len(points), 3, coefficients.shape[2]))
    kernels = compiled("eitskin.simulator.mechanics.spline_kernels")
    if kernels is not None:
        solid = (np.ascontiguousarray(each, np.float64) for each in (coefficients, points))
        kernels.sums(along.knots, across.knots, *solid, found)
        return found
    flat = coefficients.reshape(-1, coefficients.shape[2])
    for start in range(0, len(points), _AT_ONCE):
        part = slice(start, start + _AT_ONCE)
        i, a, da = along.functions(points[part, 0])
        j, b, db = across.functions(points[part, 1])
        numbers = _numbers_of_products(i, j, coefficients.shape[1])
        for k, (one, other) in enumerate(((a, b), (da, b), (a, db))):
            found[part, k] = _summed(numbers, one, other, flat)
    return found


def _numbers_of_products(i: Indices, j: Indices, across: int) -> Indices:
    """Numbers (m, 16) of the products of splines that do not vanish, `across` along the second."""
    offsets = across * _EACH[:, None] + _EACH
    return np.asarray((across * i + j)[:, None] + offsets.ravel())


def _summed(numbers: Indices, a: Array, b: Array, coefficients: Array) -> Array:
    """Sums (m, k) of products of splines a and b (m, 4) times coefficients (products, k)."""
    weights = (a[:, :, None] * b[:, None, :]).ravel()
    ends = np.arange(0, numbers.size + 1, _FUNCTIONS**2, dtype=np.int32)
    matrix = csr_array((weights, numbers.ravel(), ends), shape=(len(a), len(coefficients)))
    return np.asarray(matrix @ coefficients)
