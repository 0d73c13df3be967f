"""Symmetric equations of a body that is wide and thin, eliminated block by block.

Nested dissection (George 1973) on a grid: a line of nodes across the grid parts the unknowns into
halves that do not know of each other, and those into halves, down to a few cells. What is left of
a block once its inside is eliminated is a dense matrix of its border, handed on to the block
around it (multifrontal method, Duff and Reid 1983).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import ldl, solve_triangular
from scipy.sparse import csc_array

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

_SAME = 1e-9  # [m]


@dataclass(frozen=True, slots=True, eq=False)
class Block:
    """Unknowns that are eliminated together, after those of the blocks within.

    Attributes:
        own: the unknowns.
        within: numbers of the blocks, in their order of elimination, that this one parts.
    """

    own: Indices
    within: tuple[int, ...]


def dissected(places: Array, lines: Sequence[Array], cells: int = 2) -> list[Block]:
    """Blocks of unknowns in the order of their elimination.

    Args:
        places: of the unknowns, (n, axes) [m]; one without a place, NaN, is eliminated last.
        lines: along each of these axes, between the cells of the grid [m]. Unknowns on different
            sides of a line must not know of each other.
        cells: along each axis, up to which a block is not parted further.
    """
    blocks: list[Block] = []

    def part(unknowns: Indices, ends: list[tuple[int, int]]) -> int:
        axis = int(np.argmax([last - first for first, last in ends]))
        first, last = ends[axis]
        inside: tuple[int, ...] = ()
        if last - first > cells:
            middle = (first + last) // 2
            across = places[unknowns, axis] - lines[axis][middle]
            lower, upper = across < -_SAME, across > _SAME
            halves = [ends.copy(), ends.copy()]
            halves[0][axis], halves[1][axis] = (first, middle), (middle, last)
            inside = (part(unknowns[lower], halves[0]), part(unknowns[upper], halves[1]))
            unknowns = unknowns[~(lower | upper)]
        blocks.append(Block(unknowns, inside))
        return len(blocks) - 1

    part(np.arange(len(places)), [(0, len(line) - 1) for line in lines])
    return blocks


@dataclass(frozen=True, slots=True, eq=False)
class _Front:
    """An eliminated block: P^T L D L^T P, and rows Y = L^-1 P K of what it is tied to."""

    own: Indices  # in the order of P
    border: Indices
    lower: Array
    inverse: tuple[Array, Array]  # D^-1: its diagonal, and what stands beside it
    rows: Array


class Elimination:
    """A symmetric matrix eliminated, ready to be solved with.

    Pivots are chosen within blocks (Bunch and Kaufman 1977).

    Attributes:
        negative: number of negative eigenvalues (Sylvester's law of inertia).
    """

    def __init__(self, matrix: csc_array, blocks: Sequence[Block]) -> None:
        """Eliminate (n, n) `matrix` in the order of `blocks`."""
        order = np.concatenate([block.own for block in blocks])
        matrix = csc_array(matrix[order][:, order])
        local = np.empty(len(order), dtype=np.int64)
        left: dict[int, tuple[Indices, Array]] = {}
        self.negative, start = 0, 0
        self._fronts: list[_Front] = []
        for number, block in enumerate(blocks):
            inner = [left.pop(child) for child in block.within]
            stop = start + len(block.own)
            border, front = _gathered(matrix, start, stop, inner, local)
            size = stop - start
            lower, inverse, order_within, negative = _pivoted(front[:size, :size])
            rows = solve_triangular(
                lower, front[:size, size:][order_within], lower=True, unit_diagonal=True
            )
            left[number] = border, front[size:, size:] - rows.T @ _times(inverse, rows)
            own = start + order_within
            self._fronts.append(_Front(own, border, lower, inverse, rows))
            self.negative += negative
            start = stop
        self._order = order

    def solve(self, right: Array) -> Array:
        """The solution (n,) for a right side (n,)."""
        x = right[self._order].copy()
        for f in self._fronts:
            y = solve_triangular(f.lower, x[f.own], lower=True, unit_diagonal=True)
            y = _times(f.inverse, y)
            x[f.border] -= f.rows.T @ y
            x[f.own] = y
        for f in reversed(self._fronts):
            y = x[f.own] - _times(f.inverse, f.rows @ x[f.border])
            x[f.own] = solve_triangular(f.lower, y, lower=True, unit_diagonal=True, trans="T")
        found: Array = np.empty_like(x)
        found[self._order] = x
        return found


def _gathered(
    matrix: csc_array, start: int, stop: int, inner: Sequence[tuple[Indices, Array]], local: Indices
) -> tuple[Indices, Array]:
    """Border of a block, and the dense matrix of the block and it, blocks within eliminated."""
    span = slice(matrix.indptr[start], matrix.indptr[stop])
    rows, values = matrix.indices[span], matrix.data[span]
    columns = np.repeat(np.arange(stop - start), np.diff(matrix.indptr[start : stop + 1]))
    later = rows >= start
    rows, values, columns = rows[later], values[later], columns[later]
    border = np.unique(np.concatenate([rows, *(places for places, _ in inner)]))
    border = border[border >= stop].astype(np.int64)
    local[start:stop] = np.arange(stop - start)
    local[border] = stop - start + np.arange(len(border))
    front = np.zeros((stop - start + len(border),) * 2)
    front[local[rows], columns] = values
    front[columns, local[rows]] = values
    for places, remainder in inner:
        there = local[places]
        front[np.ix_(there, there)] += remainder
    return border, front


def _pivoted(matrix: Array) -> tuple[Array, tuple[Array, Array], Indices, int]:
    """L, D^-1, the order of the pivots, and how many of them are negative."""
    if not len(matrix):
        return matrix, (np.zeros(0), np.zeros(0)), np.zeros(0, dtype=np.int64), 0
    lower, D, order = ldl(matrix, check_finite=False)
    diagonal, beside = np.diagonal(D).copy(), np.append(np.diagonal(D, -1), 0.0)
    first = np.flatnonzero(beside)  # of a pair of unknowns that are one pivot
    a, b, c = diagonal[first], beside[first], diagonal[first + 1]
    determinant = a * c - b**2
    single = np.ones(len(D), dtype=bool)
    single[first] = single[first + 1] = False
    negative = int(np.count_nonzero(diagonal[single] < 0.0))
    negative += int(np.sum(np.where(determinant < 0.0, 1, np.where(a < 0.0, 2, 0))))
    with np.errstate(divide="ignore"):
        inverse = 1.0 / diagonal
    inverse[first], inverse[first + 1] = c / determinant, a / determinant
    beside[first] = -b / determinant
    return lower[order], (inverse, beside), order.astype(np.int64), negative


def _times(inverse: tuple[Array, Array], rows: Array) -> Array:
    """D^-1 times rows (n, ...)."""
    diagonal, beside = inverse
    shape = (-1,) + (1,) * (rows.ndim - 1)
    product: Array = diagonal.reshape(shape) * rows
    first = np.flatnonzero(beside)
    product[first] += beside[first].reshape(shape) * rows[first + 1]
    product[first + 1] += beside[first].reshape(shape) * rows[first]
    return product


def by_blocks(blocks: Sequence[Block]) -> Callable[[csc_array], Elimination]:
    """How to eliminate matrices of the unknowns that the blocks hold, in rising order."""
    unknowns = np.sort(np.concatenate([block.own for block in blocks]))
    local = [Block(np.searchsorted(unknowns, block.own), block.within) for block in blocks]
    return partial(Elimination, blocks=local)
