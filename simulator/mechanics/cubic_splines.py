"""Cubic splines on nodes along one axis, and sums of products of two of them."""

from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline, CubicSpline, NdBSpline, make_interp_spline

from eitskin.compiled import compiled

Array = NDArray[np.float64]

_DEGREE = 3


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
        inner, ends = nodes[2:-2], (np.full(_DEGREE + 1, nodes[0]), np.full(_DEGREE + 1, nodes[-1]))
        self.knots: Array = np.concatenate([ends[0], inner, ends[1]])

    @cached_property
    def fit(self) -> Array:
        """Coefficients of the splines by the values at the nodes, (n, n)."""
        return np.asarray(make_interp_spline(self.nodes, np.eye(len(self.nodes)), k=_DEGREE).c)

    def at(self, x: Array) -> Array:
        """All splines at points (m,), those beyond the nodes moved to the next, (m, n)."""
        return self.continued(np.clip(x, self.nodes[0], self.nodes[-1]))

    def continued(self, x: Array) -> Array:
        """All splines at points (m,), beyond the nodes by their outermost cubics, (m, n)."""
        return np.asarray(BSpline(self.knots, np.eye(len(self.nodes)), _DEGREE)(x))


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
    kernels = compiled("eitskin.simulator.mechanics.spline_kernels")
    if kernels is not None:
        found = np.empty((len(points), 3, coefficients.shape[2]))
        solid = (np.ascontiguousarray(each, np.float64) for each in (coefficients, points))
        kernels.sums(along.knots, across.knots, *solid, found)
        return found
    sums = NdBSpline((along.knots, across.knots), coefficients, _DEGREE)
    return np.stack([sums(points, nu=order) for order in ((0, 0), (1, 0), (0, 1))], axis=1)
