"""Two-sided block elimination with cached Schur complements.

With the strips before some strip eliminated from the left, and those after that strip from the
right, each side contributes one dense block (its Schur complement), one right-hand side, and one
term of B^T A^-1 B. Cached for every strip, these contributions turn a change of a few strips into
an elimination of these strips alone.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import blas

from eitskin.simulator.linalg.block_cholesky import BlockCholesky, BlockFactors, BlockRow, cholesky

Numbers = NDArray[np.inexact]


@dataclass(frozen=True, slots=True, eq=False)
class _Side:
    """Contribution of all strips on one side of a strip, eliminated.

    Attributes:
        complement: subtracted from the strip's diagonal block, lower triangle; for the right side
            from the coupled unknowns' part.
        right: subtracted from the strip's rows of B.
        congruence: the side's term of B^T A^-1 B.
    """

    complement: Numbers
    right: Numbers
    congruence: Numbers


class TwoSidedElimination:
    """A positive definite matrix and columns B, eliminated from the left and from the right.

    Attributes:
        factors: of the matrix, from the left.
    """

    def __init__(self, solver: BlockCholesky, values: Numbers, B: Numbers) -> None:
        """Eliminate the matrix with these values once in each direction."""
        self._solver = solver
        entries, count = solver.assembled(values), B.shape[1]
        none = _Side(np.zeros((0, 0)), np.zeros((0, count)), np.zeros((count, count)))
        self._left, self._right = [none], [none]
        blocks = []
        for block_row in solver.block_rows:
            side = self._left[-1]
            diagonal, sub_diagonal = block_row.blocks(entries)
            factor, half = _eliminate(diagonal, B[block_row.unknowns], side, slice(None))
            below = block_row.sub_diagonal_factor(factor, sub_diagonal)
            blocks.append((factor, below))
            self._left.append(_next_side(block_row, below, half, side.congruence + half.T @ half))
        self.factors = BlockFactors(solver.block_rows, blocks)
        for before, block_row in zip(
            reversed(solver.block_rows[:-1]), reversed(solver.block_rows), strict=False
        ):
            side = self._right[-1]
            diagonal, _ = block_row.blocks(entries)
            factor, half = _eliminate(diagonal, B[block_row.unknowns], side, _coupled(block_row))
            above = blas.dtrsm(1.0, factor, before.blocks(entries)[1], lower=1)
            self._right.append(
                _Side(_product(above.T), above.T @ half, side.congruence + half.T @ half)
            )
        self._right.reverse()

    def congruence(self, values: Numbers, B: Numbers, first: int, last: int) -> Numbers:
        """B^T A^-1 B, (k, k), where only strips `first` to `last` have changed.

        Values and rows of B that belong to other strips are not read.
        """
        entries = self._solver.assembled(values, first, last)
        start = self._solver.block_rows[first].entries.start
        side = self._left[first]
        for number in range(first, last + 1):
            block_row = self._solver.block_rows[number]
            diagonal, sub_diagonal = block_row.blocks(entries, start)
            right = B[block_row.unknowns]
            if number == last:
                other = self._right[last]
                _subtract(other, diagonal, right, _coupled(block_row))
                side = _Side(side.complement, side.right, side.congruence + other.congruence)
            factor, half = _eliminate(diagonal, right, side, slice(None))
            total = side.congruence + half.T @ half
            if number < last:
                below = block_row.sub_diagonal_factor(factor, sub_diagonal)
                side = _next_side(block_row, below, half, total)
        return total


def _eliminate(
    diagonal: Numbers, right: Numbers, side: _Side, part: slice
) -> tuple[Numbers, Numbers]:
    """Factor of a strip's Schur complement, and the strip's rows of L^-1 B."""
    _subtract(side, diagonal, right, part)
    factor = cholesky(diagonal)
    half: Numbers = blas.dtrsm(1.0, factor, right, lower=1)
    return factor, half


def _subtract(side: _Side, diagonal: Numbers, right: Numbers, part: slice) -> None:
    """Subtract a side from a `part` of a strip's diagonal block and rows of B, in place."""
    if side.complement.size:
        diagonal[part, part] = diagonal[part, part] - side.complement
        right[part] = right[part] - side.right


def _next_side(block_row: BlockRow, below: Numbers, half: Numbers, congruence: Numbers) -> _Side:
    """Left side of the next strip, from a strip's sub-diagonal block of L and rows of L^-1 B."""
    return _Side(_product(below), below @ half[len(half) - block_row.coupled :], congruence)


def _coupled(block_row: BlockRow) -> slice:
    """Numbers within a strip of the unknowns coupled to the next strip."""
    return slice(len(block_row.unknowns) - block_row.coupled, None)


def _product(J: Numbers) -> Numbers:
    """J J^T, lower triangle."""
    if not J.size:
        return np.zeros((0, 0))
    product: Numbers = blas.dsyrk(1.0, J, lower=1)
    return product
