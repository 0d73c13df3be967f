"""Cubic splines on nodes along one axis, and sums of products of two of them."""

from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import make_interp_spline
from scipy.sparse import csr_array

Array = NDArray[np.float64]
Indices = NDArray[np.int32]

_DEGREE = 3
FUNCTIONS = _DEGREE + 1
"""Number of splines that do not vanish at a point."""
_EACH = np.arange(FUNCTIONS, dtype=np.int32)  # as sparse products take them


class CubicSplines:
    """B-splines of degree 3 that interpolate values at nodes, without a knot at the second node.

    Source: de Boor, A Practical Guide to Splines, chapters IX, X and XIII.

    Attributes:
        nodes: rising, four or more, (n,).
    """

    def __init__(self, nodes: Array) -> None:
        """Place the knots."""
        self.nodes = nodes
        inner, ends = nodes[2:-2], (np.full(FUNCTIONS, nodes[0]), np.full(FUNCTIONS, nodes[-1]))
        self._knots = np.concatenate([ends[0], inner, ends[1]])

    @cached_property
    def fit(self) -> Array:
        """Coefficients of the splines by the values at the nodes, (n, n)."""
        return np.asarray(make_interp_spline(self.nodes, np.eye(len(self.nodes)), k=_DEGREE).c)

    def functions(self, x: Array) -> tuple[Indices, Array, Array]:
        """Number of the first spline at points (m,), values and slopes of the four, (m, 4).

        Points beyond the nodes belong to the outermost intervals.
        """
        t, last = self._knots, len(self.nodes) - 1
        cell = np.clip(np.searchsorted(t, x, side="right") - 1, _DEGREE, last)
        right = [t[cell + k] - x for k in range(1, FUNCTIONS)]
        left = [x - t[cell + 1 - k] for k in range(1, FUNCTIONS)]
        lower: list[Array] = []
        values = [np.ones_like(x)]
        for degree in range(1, FUNCTIONS):
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


def numbers_of_products(i: Indices, j: Indices, across: int) -> Indices:
    """Numbers (m, 16) of the products of splines that do not vanish, `across` along the second."""
    offsets = across * _EACH[:, None] + _EACH
    return np.asarray((across * i + j)[:, None] + offsets.ravel())


def summed(numbers: Indices, a: Array, b: Array, coefficients: Array) -> Array:
    """Sums (m, k) of products of splines a and b (m, 4) times coefficients (products, k)."""
    weights = (a[:, :, None] * b[:, None, :]).ravel()
    ends = np.arange(0, numbers.size + 1, FUNCTIONS**2, dtype=np.int32)
    matrix = csr_array((weights, numbers.ravel(), ends), shape=(len(a), len(coefficients)))
    return np.asarray(matrix @ coefficients)
