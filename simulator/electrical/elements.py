"""Reference elements: shape functions on a column of an extruded mesh, or on a tetrahedron."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Literal

import numpy as np
import skfem
from numpy.polynomial import legendre
from numpy.typing import NDArray

from eitskin.errors import ConfigurationError

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Numbers = NDArray[np.inexact]
Base = Literal["quadrilateral", "triangle"]


def plane_element(base: Base, order: int) -> skfem.Element:
    """Element of polynomial `order` on the unit square or triangle; raises ConfigurationError."""
    if base == "triangle":
        elements = {
            1: skfem.ElementTriP1,
            2: skfem.ElementTriP2,
            3: skfem.ElementTriP3,
            4: skfem.ElementTriP4,
        }
        if order not in elements:
            raise ConfigurationError(
                f"expected an order from 1 to 4 in the plane for prisms, got {order}; take one of "
                "these"
            )
        return elements[order]()
    square = {1: skfem.ElementQuad1, 2: skfem.ElementQuad2}
    return square[order]() if order in square else skfem.ElementQuadP(order)


@lru_cache(maxsize=8)
def _coefficients_of_one(element: skfem.Element, base: Base) -> Array:
    """Coefficients of the constant function one: all ones, or ones at the corners."""
    shape = skfem.refdom.RefTri if base == "triangle" else skfem.refdom.RefQuad
    X, _ = skfem.quadrature.get_quadrature(shape, 2 * element.maxdeg)
    values = np.stack([element.lbasis(X, i)[0] for i in range(len(element.doflocs))])
    coefficients = np.linalg.lstsq(values.T, np.ones(X.shape[1]))[0]
    return np.asarray(np.round(coefficients), dtype=np.float64)


@dataclass(frozen=True)
class ExtrudedElement:
    """Tensor-product element: a column of cells over the unit square or triangle.

    Each function is a function of the plane times one of the height, an upright function. The layer
    is thin, so most of a potential is the same at all heights. The upright functions are
    hierarchical - constant, linear (hats on the inner and upper heights), then polynomial bubbles
    within each cell - and each degree has its own order in the plane: with `order` (3, 2, 1) the
    constant part is cubic in the plane, the linear part quadratic and the quadratic part linear.
    Reference points X hold two reference coordinates in the plane and the height itself [m].

    Attributes:
        base: shape of the cells in the plane.
        order: order in the plane, for the constant, linear, quadratic ... upright functions.
        heights: heights of the mesh points, rising [m].
        condensed: whether functions that vanish on all upright faces count as inner.
    """

    base: Base
    order: tuple[int, ...]
    heights: tuple[float, ...]
    condensed: bool

    @property
    def cells(self) -> int:
        """Number of mesh cells that make one element."""
        return len(self.heights) - 1

    @property
    def face_degree(self) -> int:
        """Degree along an upright face, in the plane plus upwards."""
        return max(self.order) + len(self.order) - 1

    @cached_property
    def planes(self) -> tuple[skfem.Element, ...]:
        """Plane element of each upright degree."""
        return tuple(plane_element(self.base, order) for order in self.order)

    @cached_property
    def functions(self) -> Indices:
        """Upright degree, plane function and upright function of each function, (functions, 3)."""
        outer: list[tuple[int, int, int]] = []
        inner: list[tuple[int, int, int]] = []
        for degree, plane in enumerate(self.planes):
            count = len(plane.doflocs)
            for i in range(count):
                hidden = self.condensed and i >= count - plane.interior_dofs
                part = inner if hidden else outer
                part += [(degree, i, m) for m in range(self.modes(degree))]
        return np.array(outer + inner)

    @cached_property
    def inner(self) -> int:
        """Number of inner functions, the last ones: they meet no other elements or electrodes."""
        if not self.condensed:
            return 0
        return sum(p.interior_dofs * self.modes(d) for d, p in enumerate(self.planes))

    @property
    def most_in_cell(self) -> int:
        """Number of functions that are not zero in a cell, in the cell with most."""
        upright = [1, min(2, self.cells), *(1 for _ in self.order[2:])]
        return sum(len(p.doflocs) * n for p, n in zip(self.planes, upright, strict=False))

    def modes(self, degree: int) -> int:
        """Number of upright functions of a degree."""
        return 1 if degree == 0 else self.cells

    def indicator(self, low: float, high: float) -> Array:
        """Coefficients, (functions,), of a function that is one from height `low` to `high` [m].

        The function falls to zero at the next heights with mesh points, where there are any.
        """
        h = np.array(self.heights)
        same = 1e-9 * (h[-1] - h[0])
        values = ((h > low - same) & (h < high + same)).astype(float)
        if len(self.order) == 1:
            values[:] = 1.0
        # The constant gives the value at the lowest height, hats the differences from that value.
        upright = {(0, 0): values[0]}
        upright |= {(1, m): values[m + 1] - values[0] for m in range(self.cells)}
        flat = [_coefficients_of_one(plane, self.base) for plane in self.planes]
        factors = [flat[d][i] * upright.get((d, m), 0.0) for d, i, m in self.functions.tolist()]
        return np.array(factors)

    def values(self, X: Array) -> Array:
        """Values phi_i, (functions, ...), at reference points X (3, ...)."""
        return np.stack([flat[0] * up[0] for flat, up in self._factors(X)])

    def gradients(self, X: Array) -> Array:
        """Gradients d phi_i / dX, (functions, 3, ...), at reference points X (3, ...)."""
        return np.stack(
            [
                np.stack([flat[1][0] * up[0], flat[1][1] * up[0], flat[0] * up[1]])
                for flat, up in self._factors(X)
            ]
        )

    def column_gradients(self, coefficients: Numbers, X: Array, heights: Array) -> Numbers:
        """Gradients of k functions at all heights above points of the plane, (n, 3, p, q, k).

        The plane functions are evaluated once for all heights and the upright functions once for
        all points, which costs much less than `gradients` at the n p q points.

        Args:
            coefficients: coefficients of the k functions, (n, functions, k).
            X: points of the plane, (2, n, p).
            heights: (q,) [m].
        """
        n, points, q, k = len(coefficients), X.shape[2], len(heights), coefficients.shape[2]
        total = np.zeros((n, 3, points, q, k), dtype=coefficients.dtype)
        for degree, plane in enumerate(self.planes):
            flat = [plane.lbasis(X, i) for i in range(len(plane.doflocs))]
            values = np.stack([value for value, _ in flat], axis=-1)
            slopes = np.stack([slope for _, slope in flat], axis=-1)
            upright = self._upright(heights, degree)
            # Functions of one degree stand plane function by plane function, upwards.
            mine = coefficients[:, self.functions[:, 0] == degree]
            parts = mine.reshape(n, len(flat), len(upright), k)
            level, rise = (
                np.einsum("nimk,mq->niqk", parts, np.stack(part)).reshape(n, len(flat), q * k)
                for part in zip(*upright, strict=True)
            )
            for axis, sums in enumerate((slopes[0] @ level, slopes[1] @ level, values @ rise)):
                total[:, axis] += sums.reshape(n, points, q, k)
        return total

    def rule(self) -> tuple[Array, Array]:
        """Gauss points (3, q) and weights (q,), cell by cell upwards.

        Along each axis there are as many as the degree, one less than exactness needs, which keeps
        the order of convergence (Ciarlet 1978) and halves the points. Upwards it halves to thirds
        the error of a sheared layer, where full integration is too stiff (Zienkiewicz, Taylor and
        Too 1971). In the plane of squares one function per degree of the height then has no energy;
        `Assembly` gives it some, by `full_rule`.
        """
        return self._gauss(2 * max(self.order) - (self.base == "quadrilateral"))

    def full_rule(self) -> tuple[Array, Array]:
        """Gauss points (3, q) and weights (q,), exact in the plane and as in `rule` upwards."""
        return self._gauss(2 * max(self.order))

    def _gauss(self, degree: int) -> tuple[Array, Array]:
        """Gauss points and weights for `degree` in the plane, in each cell upwards."""
        shape = skfem.refdom.RefTri if self.base == "triangle" else skfem.refdom.RefQuad
        plane, plane_weights = skfem.quadrature.get_quadrature(shape, degree)
        heights = len(self.order)
        nodes, weights = legendre.leggauss(heights - 1 if heights > 2 else heights)
        points, shares = [], []
        for low, high in zip(self.heights, self.heights[1:], strict=False):
            z = low + 0.5 * (nodes + 1.0) * (high - low)
            flat = np.repeat(plane, len(z), axis=1)
            points.append(np.concatenate([flat, np.tile(z, plane.shape[1])[None]]))
            shares.append(np.outer(plane_weights, 0.5 * (high - low) * weights).ravel())
        return np.concatenate(points, axis=1), np.concatenate(shares)

    def _factors(self, X: Array) -> Iterator[tuple[tuple[Array, Array], tuple[Array, Array]]]:
        """Plane and upright factor of each function, both as value and derivatives."""
        plane = {
            (degree, i): element.lbasis(X[:2], i)
            for degree, element in enumerate(self.planes)
            for i in range(len(element.doflocs))
        }
        upright = {degree: self._upright(X[2], degree) for degree in range(len(self.order))}
        for degree, i, m in self.functions:
            yield plane[degree, i], upright[degree][m]

    def _upright(self, z: Array, degree: int) -> list[tuple[Array, Array]]:
        """Values and slopes [1/m] of the upright functions of a degree at heights z."""
        if degree == 0:
            return [(np.ones_like(z), np.zeros_like(z))]
        h = np.array(self.heights)
        cell = np.clip(np.searchsorted(h, z, side="right") - 1, 0, self.cells - 1)
        thickness = np.diff(h)[cell]
        t = (z - h[cell]) / thickness
        if degree == 1:
            rising = [(cell == m - 1, cell == m) for m in range(1, self.cells + 1)]
            return [
                (up * t + down * (1.0 - t), (up * 1.0 - down) / thickness) for up, down in rising
            ]
        # Integrated Legendre polynomials, zero at both ends of the cell.
        bubble = legendre.Legendre.basis(degree) - legendre.Legendre.basis(degree - 2)
        value, slope = bubble(2.0 * t - 1.0), bubble.deriv()(2.0 * t - 1.0) * 2.0 / thickness
        return [((cell == m) * value, (cell == m) * slope) for m in range(self.cells)]


class TetrahedralElement:
    """Linear or quadratic Lagrange element on the unit tetrahedron, with one cell.

    Attributes:
        element: the scikit-fem element.
        face_degree: polynomial degree of the functions on a face.
        most_in_cell: number of functions.
    """

    inner, cells = 0, 1

    def __init__(self, order: int) -> None:
        """Choose the element; raises ConfigurationError for another order than 1 or 2."""
        elements = {1: skfem.ElementTetP1, 2: skfem.ElementTetP2}
        if order not in elements:
            raise ConfigurationError(
                f"expected order 1 or 2 for tetrahedra, got {order}; name one of these"
            )
        self.element, self.face_degree = elements[order](), order
        self._functions = range(len(self.element.doflocs))
        self.most_in_cell = len(self._functions)

    def indicator(self, low: float, high: float) -> Array:  # noqa: ARG002
        """Coefficients, (functions,), of the constant function one, whatever the heights."""
        return np.ones(len(self._functions))

    def values(self, X: Array) -> Array:
        """Values phi_i, (functions, ...), at reference points X (3, ...)."""
        return np.stack([self.element.lbasis(X, i)[0] for i in self._functions])

    def gradients(self, X: Array) -> Array:
        """Gradients d phi_i / dX, (functions, 3, ...), at reference points X (3, ...)."""
        return np.stack([np.stack(self.element.lbasis(X, i)[1]) for i in self._functions])

    def rule(self) -> tuple[Array, Array]:
        """Points (3, q) and weights (q,), exact for products of two functions."""
        points, weights = skfem.quadrature.get_quadrature(skfem.refdom.RefTet, 2 * self.face_degree)
        return points, weights

    full_rule = rule


Element = ExtrudedElement | TetrahedralElement
