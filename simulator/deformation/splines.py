"""Cubic splines of one variable: piecewise polynomials, and B-splines.

Written in numpy, with one banded solution: `scipy.interpolate` does the same and takes as long to
load as everything else that a scene of tabulated touches needs of scipy. Source: de Boor, A
Practical Guide to Splines, chapters IV, IX, X and XIII.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import product
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import solve_banded

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
End = Literal["not a knot", "straight", "level"]

_DEGREE = 3


@dataclass(frozen=True, slots=True, eq=False)
class PiecewiseCubic:
    """Cubic polynomials between knots; the first and the last go on beyond the ends.

    Attributes:
        c: coefficients of the powers of the distance from the knot before, from the highest,
            (4, n - 1, ...).
        x: knots, rising, (n,).
    """

    c: Array
    x: Array

    def __call__(self, x: ArrayLike) -> Array:
        """Values at points (m,), (m, ...)."""
        (c3, c2, c1, c0), t = self._pieces(x)
        square = t * t
        return np.asarray(c0 + c1 * t + c2 * square + c3 * (square * t))

    def slopes(self, x: ArrayLike) -> Array:
        """Slopes at points (m,), (m, ...)."""
        (c3, c2, c1, _), t = self._pieces(x)
        return np.asarray(c1 + c2 * t * 2.0 + c3 * (t * t) * 3.0)

    def solve_rising(self, value: float) -> float:
        """Where one function, which rises, has a value between those at the ends."""
        piece = int(np.clip(np.searchsorted(self.c[3], value) - 1, 0, len(self.x) - 2))
        c3, c2, c1, c0 = self.c[:, piece].tolist()
        middle = 0.5 * float(self.x[piece + 1] - self.x[piece])
        # Eigenvalues of the companion matrix, then a step of Newton's method from the one inside.
        powers = np.trim_zeros(np.array([c0 - value, c1, c2, c3]), "b")
        companion = np.eye(len(powers) - 1, k=-1)
        companion[:, -1] = -powers[:-1] / powers[-1]
        roots = np.linalg.eigvals(companion)
        t = min(roots[np.isreal(roots)].real.tolist(), key=lambda root: abs(root - middle))
        square = t * t
        rest = c0 + c1 * t + c2 * square + c3 * (square * t) - value
        t -= rest / (c1 + c2 * t * 2.0 + c3 * square * 3.0)
        return float(self.x[piece] + t)

    def _pieces(self, x: ArrayLike) -> tuple[Array, Array]:
        """Coefficients (4, m, ...) at points (m,), and distances from the knots before."""
        at = np.asarray(x, dtype=np.float64)
        piece = np.clip(np.searchsorted(self.x, at, side="right") - 1, 0, len(self.x) - 2)
        t = at - self.x[piece]
        return self.c[:, piece], t.reshape(t.shape + (1,) * (self.c.ndim - 2))


def cubic_spline(
    nodes: ArrayLike, values: ArrayLike, ends: tuple[End, End] = ("not a knot", "not a knot")
) -> PiecewiseCubic:
    """Cubic spline through values (n, ...) at three or more nodes (n,).

    At its ends it has no knot at the second node, is straight, or level.
    """
    x, y = np.asarray(nodes, dtype=np.float64), np.asarray(values, dtype=np.float64)
    d = np.diff(x)
    h = d.reshape(-1, *(1,) * (y.ndim - 1))
    slope = np.diff(y, axis=0) / h
    A, b = np.zeros((3, len(x))), np.empty_like(y)
    A[0, 2:], A[1, 1:-1], A[2, :-2] = d[:-1], 2.0 * (d[:-1] + d[1:]), d[1:]
    b[1:-1] = 3.0 * (h[1:] * slope[:-1] + h[:-1] * slope[1:])
    rise = y[1] - y[0], y[-1] - y[-2]
    for side, end in enumerate(ends):
        # The outer node, the two pieces next to it, and the entry next to the diagonal.
        node, own, other = (-1, -1, -2) if side else (0, 0, 1)
        beside = (2, -2) if side else (0, 1)
        if end == "not a knot" and len(x) == 3:  # a parabola
            A[1, node], A[beside], b[node] = 1.0, 1.0, 2.0 * slope[own]
        elif end == "not a knot":
            both = d[own] + d[other]
            A[1, node], A[beside] = d[other], both
            steep = (h[own] + 2.0 * both) * h[other] * slope[own]
            b[node] = (steep + h[own] ** 2 * slope[other]) / both
        elif end == "straight":
            A[1, node], A[beside], b[node] = 2.0 * d[own], d[own], 3.0 * rise[side]
        else:
            A[1, node], A[beside], b[node] = 1.0, 0.0, 0.0
    s = solve_banded((1, 1), A, b.reshape(len(x), -1)).reshape(y.shape)
    bent = (s[:-1] + s[1:] - 2.0 * slope) / h
    return PiecewiseCubic(np.stack([bent / h, (slope - s[:-1]) / h - bent, s[:-1], y[:-1]]), x)


class CubicSplines:
    """B-splines of degree 3 that interpolate values at nodes, without a knot at the second node.

    Beyond the nodes they keep their values.

    Attributes:
        nodes: rising, four or more, (n,).
        knots: positions where the pieces of the splines meet, (n + 4,).
    """

    def __init__(self, nodes: Array) -> None:
        """Place the knots."""
        self.nodes = nodes
        first, last = np.full(_DEGREE + 1, nodes[0]), np.full(_DEGREE + 1, nodes[-1])
        self.knots: Array = np.concatenate([first, nodes[2:-2], last])

    @cached_property
    def fit(self) -> Array:
        """Coefficients of the splines by the values at the nodes, (n, n)."""
        return _spline_fit(tuple(self.nodes.tolist()))

    @property
    def ends(self) -> tuple[float, float]:
        """Ends of the interval."""
        return float(self.nodes[0]), float(self.nodes[-1])

    def dense(self, x: Array) -> Array:
        """All splines at points (m,), (m, n)."""
        first, values = self.local(np.clip(x, *self.ends))
        splines = np.zeros((len(x), len(self.nodes)))
        np.put_along_axis(splines, first[:, None] + np.arange(_DEGREE + 1), values.T, axis=1)
        return splines

    def local(self, x: Array, slopes: bool = False) -> tuple[Indices, Array]:
        """First of the four splines at points (m,) between the nodes, and their values, (4, m)."""
        t = self.knots
        cell = np.clip(np.searchsorted(t, x, side="right") - 1, _DEGREE, len(t) - _DEGREE - 2)
        values = [np.ones(len(x))]
        for degree in range(1, _DEGREE + 1):
            lower, values = values, [np.zeros(len(x)) for _ in range(degree + 1)]
            for n in range(1, degree + 1):
                after, before = t[cell + n], t[cell + n - degree]
                share = lower[n - 1] / (after - before)
                if slopes and degree == _DEGREE:
                    share = degree * lower[n - 1] / (after - before)
                    values[n - 1] -= share
                    values[n] = share
                else:
                    values[n - 1] += share * (after - x)
                    values[n] = share * (x - before)
        return cell - _DEGREE, np.stack(values)


def sum_splines(
    bases: tuple[CubicSplines, CubicSplines],
    coefficients: Array,
    x: Array,
    y: Array,
    orders: Sequence[tuple[int, int]],
) -> Array:
    """Sums of products of splines with coefficients (nx, ny, ...), or slopes, (m, orders, ...).

    At points (m,) between the nodes; orders of derivatives by x and y are 0 or 1.
    """
    along, across = (
        [basis.local(at, slopes) for slopes in (False, True)]
        for basis, at in zip(bases, (x, y), strict=True)
    )
    ny = coefficients.shape[1]
    flat, first = coefficients.reshape(-1, *coefficients.shape[2:]), along[0][0] * ny + across[0][0]
    sums = np.zeros((len(orders), len(x), *coefficients.shape[2:]))
    for i, j in product(range(_DEGREE + 1), repeat=2):
        terms = flat.take(first + (i * ny + j), axis=0)
        for number, (by_x, by_y) in enumerate(orders):
            factors = along[by_x][1][i] * across[by_y][1][j]
            sums[number] += terms * factors.reshape(-1, *(1,) * (terms.ndim - 1))
    return sums.swapaxes(0, 1)


@lru_cache(maxsize=64)
def _spline_fit(nodes: tuple[float, ...]) -> Array:
    at = np.array(nodes)
    splines, count = CubicSplines(at).dense(at), len(nodes)
    bands = np.zeros((2 * _DEGREE + 1, count))
    for offset in range(-_DEGREE, _DEGREE + 1):
        line = np.diagonal(splines, offset)
        bands[_DEGREE - offset, max(offset, 0) : max(offset, 0) + len(line)] = line
    return np.asarray(solve_banded((_DEGREE, _DEGREE), bands, np.eye(count)))
