"""Multifrontal LDL^T factorisation of wide, thin bodies by nested dissection.

Nested dissection (George 1973) on a grid: a line of nodes across the grid separates the unknowns
into two uncoupled halves, and each half is dissected likewise, down to a few cells. Eliminating a
block leaves a dense Schur complement on its border, which is added to the block around it
(multifrontal method, Duff and Reid 1983).

It stands because SuperLU with the same ordering (permc_spec="NATURAL") takes 2.1 times the time and
2.1 times the memory: 10.3 s and 1.5 GB against 4.8 s and 0.7 GB for an elastic layer of 101,400
unknowns (one core; docs/results/studies.md).
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
_STRIP = 256  # rows of a Schur complement that are computed at once


@dataclass(frozen=True, slots=True, eq=False)
class Block:
    """Unknowns eliminated together, after the blocks that they separate.

    Attributes:
        own: the unknowns.
        within: numbers, in the order of elimination, of the blocks that these unknowns separate.
    """

    own: Indices
    within: tuple[int, ...]


def dissected(positions: Array, lines: Sequence[Array], cells: int = 2) -> list[Block]:
    """Blocks of unknowns in the order of their elimination.

    Args:
        positions: of the unknowns, (n, axes) [m]; an unknown without one, NaN, is eliminated last.
        lines: along each of these axes, between the cells of the grid [m]. Unknowns on different
            sides of a line must not be coupled.
        cells: along each axis, up to which a block is not dissected further.
    """
    blocks: list[Block] = []

    def dissect(unknowns: Indices, ends: list[tuple[int, int]]) -> int:
        axis = int(np.argmax([last - first for first, last in ends]))
        first, last = ends[axis]
        inside: tuple[int, ...] = ()
        if last - first > cells:
            middle = (first + last) // 2
            across = positions[unknowns, axis] - lines[axis][middle]
            lower, upper = across < -_SAME, across > _SAME
            halves = [ends.copy(), ends.copy()]
            halves[0][axis], halves[1][axis] = (first, middle), (middle, last)
            inside = (dissect(unknowns[lower], halves[0]), dissect(unknowns[upper], halves[1]))
            unknowns = unknowns[~(lower | upper)]
        # Neighbours in turn: they stay together in the borders of the blocks within.
        turn = np.lexsort(positions[unknowns].T)
        blocks.append(Block(unknowns[turn], inside))
        return len(blocks) - 1

    dissect(np.arange(len(positions)), [(0, len(line) - 1) for line in lines])
    return blocks


@dataclass(frozen=True, slots=True, eq=False)
class _Front:
    """An eliminated block: P^T L D L^T P, and Y = L^-1 P K for its coupling K to the border."""

    own: Indices  # in the order of P
    border: Indices
    lower: Array
    inverse: tuple[Array, Array]  # D^-1: its diagonal and sub-diagonal
    rows: Array


class Elimination:
    """Multifrontal LDL^T factors of a symmetric, possibly indefinite matrix.

    Pivots of order 1 and 2 are chosen within blocks (Bunch and Kaufman 1977).

    Attributes:
        negative: number of negative eigenvalues (Sylvester's law of inertia).
        stored: memory of the factors [byte].
    """

    def __init__(self, matrix: csc_array, blocks: Sequence[Block]) -> None:
        """Factorise `matrix` (n, n) in the order of `blocks`.

        Raises RuntimeError for a singular matrix.
        """
        order = np.concatenate([block.own for block in blocks])
        position = np.empty(len(order), dtype=np.int64)
        position[order] = np.arange(len(order))
        columns = csc_array(matrix[:, order])
        columns.indices = position[columns.indices]  # rows, no longer sorted
        local = np.empty(len(order), dtype=np.int64)
        complements: dict[int, tuple[Indices, Array]] = {}
        self.negative, start = 0, 0
        self._fronts: list[_Front] = []
        for number, block in enumerate(blocks):
            inner = [complements.pop(child) for child in block.within]
            size = len(block.own)
            border, front = _frontal_matrix(columns, start, size, inner, local)
            lower, inverse, order_within, negative = _ldl(front[:size, :size])
            rows = solve_triangular(
                lower,
                front[size:, order_within].T,
                lower=True,
                unit_diagonal=True,
                overwrite_b=True,
                check_finite=False,
            )
            complements[number] = border, _complement(front[size:, size:], rows, inverse)
            self._fronts.append(_Front(start + order_within, border, lower, inverse, rows))
            self.negative += negative
            start += size
        self._order = order
        self.stored = sum(front.lower.nbytes + front.rows.nbytes for front in self._fronts)

    def solve(self, right: Array) -> Array:
        """Solution (n,) for a right-hand side (n,)."""
        x = right[self._order].copy()
        for f in self._fronts:
            y = solve_triangular(f.lower, x[f.own], lower=True, unit_diagonal=True)
            y = _apply_inverse(f.inverse, y)
            x[f.border] -= f.rows.T @ y
            x[f.own] = y
        for f in reversed(self._fronts):
            y = x[f.own] - _apply_inverse(f.inverse, f.rows @ x[f.border])
            x[f.own] = solve_triangular(f.lower, y, lower=True, unit_diagonal=True, trans="T")
        found: Array = np.empty_like(x)
        found[self._order] = x
        return found


def _frontal_matrix(
    matrix: csc_array, start: int, size: int, inner: Sequence[tuple[Indices, Array]], local: Indices
) -> tuple[Indices, Array]:
    """Border of a block, and the lower triangle of the dense frontal matrix of block and border.

    The Schur complements of the blocks within are added to the frontal matrix.
    """
    stop = start + size
    span = slice(matrix.indptr[start], matrix.indptr[stop])
    rows, values = matrix.indices[span], matrix.data[span]
    columns = np.repeat(np.arange(size), np.diff(matrix.indptr[start : stop + 1]))
    later = rows >= start
    rows, values, columns = rows[later], values[later], columns[later]
    coupled = np.zeros(len(local), dtype=bool)
    for numbers in (rows, *(within for within, _ in inner)):
        coupled[numbers] = True
    border = stop + np.flatnonzero(coupled[stop:])
    local[start:stop] = np.arange(size)
    local[border] = size + np.arange(len(border))
    front = np.zeros((size + len(border),) * 2)
    front[local[rows], columns] = values
    for within, complement in inner:
        _add_lower(front, local[within], complement)
    return border, front


def _add_lower(front: Array, rows: Indices, complement: Array) -> None:
    """Add the lower triangle of a Schur complement to a front, at rising rows and columns.

    Runs of consecutive rows are added as blocks.
    """
    ends = np.append(np.flatnonzero(np.diff(rows) != 1) + 1, len(rows))
    runs: list[tuple[slice, slice]] = []
    first = 0
    for last in ends.tolist():
        place = int(rows[first]) if len(rows) else 0
        here, there = slice(first, last), slice(place, place + last - first)
        runs.append((here, there))
        for beside, target in runs:
            front[there, target] += complement[here, beside]
        first = last


def _complement(corner: Array, rows: Array, inverse: tuple[Array, Array]) -> Array:
    """Schur complement: the lower triangle of corner - rows^T D^-1 rows."""
    scaled = _apply_inverse(inverse, rows)
    found = np.zeros_like(corner)  # runs of rows are added with the triangle above, as numbers
    for first in range(0, len(corner), _STRIP):
        strip = slice(first, first + _STRIP), slice(first + _STRIP)
        found[strip] = corner[strip] - rows[:, strip[0]].T @ scaled[:, strip[1]]
    return found


def _ldl(matrix: Array) -> tuple[Array, tuple[Array, Array], Indices, int]:
    """L, D^-1, order of the pivots, and number of negative eigenvalues of D."""
    if not len(matrix):
        return matrix, (np.zeros(0), np.zeros(0)), np.zeros(0, dtype=np.int64), 0
    lower, D, order = ldl(matrix, check_finite=False)
    diagonal, beside = np.diagonal(D).copy(), np.append(np.diagonal(D, -1), 0.0)
    first = np.flatnonzero(beside)  # of the pairs of unknowns that share a 2 x 2 pivot
    a, b, c = diagonal[first], beside[first], diagonal[first + 1]
    determinant = a * c - b**2
    single = np.ones(len(D), dtype=bool)
    single[first] = single[first + 1] = False
    negative = int(np.count_nonzero(diagonal[single] < 0.0))
    negative += int(np.sum(np.where(determinant < 0.0, 1, np.where(a < 0.0, 2, 0))))
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = 1.0 / diagonal
    inverse[first], inverse[first + 1] = c / determinant, a / determinant
    beside[first] = -b / determinant
    if not (np.all(np.isfinite(inverse)) and np.all(np.isfinite(beside))):
        raise RuntimeError("the matrix is singular")
    return lower[order], (inverse, beside), order.astype(np.int64), negative


def _apply_inverse(inverse: tuple[Array, Array], rows: Array) -> Array:
    """D^-1 times rows (n, ...), from the diagonal and sub-diagonal of D^-1."""
    diagonal, beside = inverse
    shape = (-1,) + (1,) * (rows.ndim - 1)
    product: Array = diagonal.reshape(shape) * rows
    first = np.flatnonzero(beside)
    product[first] += beside[first].reshape(shape) * rows[first + 1]
    product[first + 1] += beside[first].reshape(shape) * rows[first]
    return product


def by_blocks(blocks: Sequence[Block]) -> Callable[[csc_array], Elimination]:
    """Function that eliminates matrices of the blocks' unknowns, numbered in rising order."""
    unknowns = np.sort(np.concatenate([block.own for block in blocks]))
    local = [Block(np.searchsorted(unknowns, block.own), block.within) for block in blocks]
    return partial(Elimination, blocks=local)
