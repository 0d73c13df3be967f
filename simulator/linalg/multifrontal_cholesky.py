"""Multifrontal Cholesky factorisation by nested dissection of the elements, for any mesh.

The elements are halved across their longest extent, and each half likewise (nested dissection,
George 1973). The unknowns that two halves share, and no other element has, are eliminated after
those within the halves. Eliminating a front leaves a dense Schur complement on its border, which is
added to the front around it (multifrontal method, Duff and Reid 1983). For n unknowns in the plane
the factors have of the order of n log n entries.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import blas, lapack

from eitskin.simulator.linalg.block_cholesky import cholesky
from eitskin.simulator.linalg.sparse_lu import SparseDirect, SparseFactors

Numbers = NDArray[np.inexact]
Indices = NDArray[np.int64]

_LEAF = 12  # elements that are not dissected further


@dataclass(frozen=True, slots=True, eq=False)
class Front:
    """Unknowns eliminated together, and those that their elimination couples.

    Unknowns are numbered by their elimination. The rows of a front are its own unknowns, then its
    border.

    Attributes:
        own: the unknowns eliminated.
        border: unknowns eliminated later, rising, (b,).
        within: fronts whose Schur complements are added, each with the rows of its border here.
        entries: part of the assembled matrix entries.
        positions: of these entries in the front, column by column.
    """

    own: slice
    border: Indices
    within: tuple[tuple[int, Indices], ...]
    entries: slice
    positions: Indices


class _Part(NamedTuple):
    """Part of the mesh: last fronts, border, and number of elements of each border unknown."""

    fronts: tuple[int, ...]
    border: Indices
    shares: Indices


class MultifrontalCholesky:
    """Cholesky factorisation in the order of a nested dissection.

    Complex matrices go to sparse LU.

    Attributes:
        fronts: in the order of elimination.
    """

    name = "nested dissection"

    def __init__(
        self, rows: Indices, columns: Indices, numbers: Indices, positions: NDArray[np.float64]
    ) -> None:
        """Dissect a mesh.

        Args:
            rows, columns: of the matrix values, in the lower triangle.
            numbers: unknowns of each element, (elements, functions).
            positions: of the elements, (elements, axes) [m].
        """
        self._pattern = rows, columns
        own, borders, children = _dissection(numbers, positions)
        self._order = np.concatenate(own)
        rank = np.empty_like(self._order)
        rank[self._order] = np.arange(len(rank))
        starts = np.concatenate([[0], np.cumsum([len(each) for each in own])])
        borders = [np.sort(rank[border]) for border in borders]
        # Each entry belongs to the front that eliminates the first of its two unknowns.
        first, second = (ends(rank[rows], rank[columns]) for ends in (np.minimum, np.maximum))
        front = np.searchsorted(starts, first, side="right") - 1
        self._gather = np.lexsort((second, first))  # by front, column by column
        first, second, front = (each[self._gather] for each in (first, second, front))
        new = np.append(True, (np.diff(first) != 0) | (np.diff(second) != 0))
        self._runs = np.flatnonzero(new)
        first, second, front = (each[self._runs] for each in (first, second, front))
        bounds = np.searchsorted(front, np.arange(len(own) + 1))
        self.fronts: list[Front] = []
        for number, (border, inner) in enumerate(zip(borders, children, strict=True)):
            start, stop = int(starts[number]), int(starts[number + 1])
            unknowns = np.concatenate([np.arange(start, stop), border])
            mine = slice(int(bounds[number]), int(bounds[number + 1]))
            row = np.searchsorted(unknowns, second[mine])
            within = tuple((k, np.searchsorted(unknowns, borders[k])) for k in inner)
            positions_ = (first[mine] - start) * len(unknowns) + row
            self.fronts.append(Front(slice(start, stop), border, within, mine, positions_))

    def factorise(self, values: Numbers) -> "MultifrontalFactors | SparseFactors":
        """Factorise the matrix with these values; values of equal position add up."""
        if np.iscomplexobj(values):
            return self._sparse().factorise(values)
        return MultifrontalFactors(self._order, self.fronts, list(self._blocks(values)))

    def congruence(self, values: Numbers, B: Numbers) -> Numbers:
        """B^T A^-1 B, (k, k); factors are used once and not kept."""
        if np.iscomplexobj(values):
            return self._sparse().congruence(values, B)
        x: Numbers = B[self._order]
        for front, (factor, below) in zip(self.fronts, self._blocks(values), strict=True):
            x[front.own] = blas.dtrsm(1.0, factor, x[front.own], lower=1)
            x[front.border] = x[front.border] - below @ x[front.own]
        product: Numbers = x.T @ x
        return product

    def _sparse(self) -> SparseDirect:
        return SparseDirect(*self._pattern, len(self._order))

    def _blocks(self, values: Numbers) -> Iterator[tuple[Numbers, Numbers]]:
        """Diagonal and sub-diagonal block of L for each front, in the order of elimination."""
        entries = np.add.reduceat(values[self._gather], self._runs)
        complements: dict[int, Numbers] = {}
        for number, front in enumerate(self.fronts):
            size = front.own.stop - front.own.start
            rows = size + len(front.border)
            flat = np.zeros(rows**2)
            flat[front.positions] = entries[front.entries]
            whole = flat.reshape(rows, rows)  # the transpose: lower triangles are upper ones
            for inner, at in front.within:
                whole[at[:, None], at] += complements.pop(inner)
            factor = cholesky(np.asfortranarray(whole[:size, :size].T))
            below = blas.dtrsm(1.0, factor, whole[:size, size:].T, side=1, lower=1, trans_a=1)
            if len(front.border):
                left = blas.dsyrk(-1.0, below, 1.0, whole[size:, size:].T, lower=1)
                complements[number] = left.T
            yield factor, below


class MultifrontalFactors:
    """Multifrontal Cholesky factors of one matrix."""

    def __init__(
        self, order: Indices, fronts: Sequence[Front], blocks: list[tuple[Numbers, Numbers]]
    ) -> None:
        """Keep the diagonal and sub-diagonal block of L for each front."""
        self._order, self._fronts, self._blocks = order, fronts, blocks

    def rounded(self) -> "SingleMultifrontalFactors":
        """The same factors in single precision."""
        return SingleMultifrontalFactors(self._order, self._fronts, self._blocks)

    def solve(self, B: Numbers) -> Numbers:
        """A^-1 B, (n, k), by forward and backward substitution."""
        x: Numbers = B[self._order]
        both = list(zip(self._fronts, self._blocks, strict=True))
        for front, (factor, below) in both:
            x[front.own] = blas.dtrsm(1.0, factor, x[front.own], lower=1)
            x[front.border] = x[front.border] - below @ x[front.own]
        for front, (factor, below) in reversed(both):
            right = x[front.own] - below.T @ x[front.border]
            x[front.own] = blas.dtrsm(1.0, factor, right, lower=1, trans_a=1)
        solution = np.empty_like(x)
        solution[self._order] = x
        return solution


class SingleMultifrontalFactors:
    """Multifrontal Cholesky factors in single precision, for approximate solutions.

    The blocks J and S of L below and on the diagonal are kept as S^-1 above -J S^-1, so that each
    front takes one matrix product a sweep.
    """

    def __init__(
        self, order: Indices, fronts: Sequence[Front], blocks: list[tuple[Numbers, Numbers]]
    ) -> None:
        """Invert the diagonal block of L of each front, and round to single precision."""
        self._order = order
        self._fronts = []
        for front, (factor, below) in zip(fronts, blocks, strict=True):
            inverse = lapack.dtrtri(np.tril(factor), lower=1)[0]
            block = np.concatenate([inverse, -below @ inverse]).astype(np.float32)
            self._fronts.append((front.own, front.border, block))

    def solve(self, B: Numbers) -> Numbers:
        """A^-1 B, (n, k), to single precision."""
        scale = np.abs(B).max(initial=np.finfo(np.float32).tiny)
        x = (B[self._order] / scale).astype(np.float32)
        for own, border, block in self._fronts:
            found, size = block @ x[own], own.stop - own.start
            x[own] = found[:size]
            x[border] += found[size:]
        for own, border, block in reversed(self._fronts):
            x[own] = block.T @ np.concatenate([x[own], x[border]])
        solution = np.empty_like(B)
        solution[self._order] = scale * x
        return solution


def _dissection(
    numbers: Indices, positions: NDArray[np.float64]
) -> tuple[list[Indices], list[Indices], list[tuple[int, ...]]]:
    """Own unknowns, border and inner fronts of each front, in the order of elimination."""
    elements_of = np.bincount(numbers.ravel())
    own: list[Indices] = []
    borders: list[Indices] = []
    children: list[tuple[int, ...]] = []

    def dissect(elements: Indices) -> _Part:
        if len(elements) <= _LEAF:
            inner: tuple[_Part, ...] = ()
            unknowns, shares = np.unique(numbers[elements], return_counts=True)
        else:
            axis = int(np.ptp(positions[elements], axis=0).argmax())
            turn = elements[np.argsort(positions[elements, axis], kind="stable")]
            inner = dissect(turn[: len(turn) // 2]), dissect(turn[len(turn) // 2 :])
            both = np.concatenate([part.border for part in inner])
            unknowns, numbered = np.unique(both, return_inverse=True)
            shares = np.zeros(len(unknowns), dtype=np.int64)
            np.add.at(shares, numbered, np.concatenate([part.shares for part in inner]))
        whole = shares == elements_of[unknowns]  # no element elsewhere has these unknowns
        fronts = sum((part.fronts for part in inner), ())
        if whole.any():
            own.append(unknowns[whole])
            borders.append(unknowns[~whole])
            children.append(fronts)
            fronts = (len(own) - 1,)
        return _Part(fronts, unknowns[~whole], shares[~whole])

    dissect(np.arange(len(numbers)))
    return own, borders, children
