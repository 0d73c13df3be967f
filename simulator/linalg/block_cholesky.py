"""Block tridiagonal Cholesky factorisation: dense blocks, one per strip of unknowns."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import blas, lapack
from scipy.sparse import coo_array

from eitskin.errors import ConfigurationError

Numbers = NDArray[np.inexact]
Indices = NDArray[np.int64]


def level_structure(numbers: Indices, first: Indices) -> Indices:
    """Strip of each unknown, (unknowns,): level of a breadth-first search from elements `first`.

    Args:
        numbers: unknowns of each element, (elements, functions).
        first: elements of level 0.

    An element then has unknowns of two consecutive strips at most, on any mesh (level structure,
    George and Liu 1981). Raises ConfigurationError for a mesh that is not connected.
    """
    elements, functions = numbers.shape
    unknowns = int(numbers.max()) + 1
    incidence = (np.repeat(np.arange(elements), functions), numbers.ravel())
    shares = coo_array((np.ones(numbers.size, dtype=np.int8), incidence), (elements, unknowns))
    by_element, by_unknown = shares.tocsr(), shares.T.tocsr()
    level = np.full(unknowns, -1)
    reached = np.zeros(elements, dtype=bool)
    front, number = first, 0
    while len(front):
        reached[front] = True
        new = np.unique(by_element[front].indices)
        new = new[level[new] < 0]
        level[new] = number
        adjacent = np.unique(by_unknown[new].indices)
        front = adjacent[~reached[adjacent]]
        number += 1
    if level.min() < 0:
        raise ConfigurationError(
            "expected a sensor of one connected body, got parts that do not touch; join them in "
            "the design"
        )
    return level


class BlockCholesky:
    """Block tridiagonal Cholesky factorisation for long, thin bodies.

    The unknowns are grouped into strips, and an element has unknowns of two consecutive strips at
    most. Within a strip the unknowns coupled to the next strip come last, so that the sub-diagonal
    block has columns for these alone. Complex symmetric matrices with a positive definite real
    part are eliminated in the same order with LU factors of the diagonal blocks; pivoting between
    blocks is not needed (Higham 1998).

    Attributes:
        block_rows: one for each strip, in the order of elimination.
    """

    name = "block Cholesky"

    def __init__(self, rows: Indices, columns: Indices, strip: Indices) -> None:
        """Prepare for entries at (rows, columns), with the strip of each unknown, (n,)."""
        crossing = strip[rows] != strip[columns]
        if np.any(np.abs(strip[rows] - strip[columns]) > 1):
            raise ValueError("a matrix entry couples strips that are not consecutive")
        lower_end = np.where(strip[rows] < strip[columns], rows, columns)[crossing]
        coupled = np.zeros(len(strip), dtype=bool)
        coupled[lower_end] = True
        self._order = np.lexsort((coupled, strip))
        rank = np.empty_like(self._order)
        rank[self._order] = np.arange(len(strip))
        low, high = np.minimum(rank[rows], rank[columns]), np.maximum(rank[rows], rank[columns])

        sizes, couplings = (
            np.bincount(strip),
            np.bincount(strip[coupled], minlength=strip.max() + 1),
        )
        starts = np.concatenate([[0], np.cumsum(sizes)])
        next_sizes = np.append(sizes[1:], 0)
        # Positions within a block row, column by column: its diagonal block, then the sub-diagonal
        # block, which has the coupled unknowns as columns.
        column_strip, row_strip = strip[self._order[low]], strip[self._order[high]]
        column, row = low - starts[column_strip], high - starts[row_strip]
        size = sizes[column_strip]
        diagonal = column * size + row
        first = size - couplings[column_strip]
        sub_diagonal = size**2 + (column - first) * next_sizes[column_strip] + row
        within = np.where(row_strip == column_strip, diagonal, sub_diagonal)
        extents = sizes**2 + next_sizes * couplings
        block_starts = np.concatenate([[0], np.cumsum(extents)])
        position = block_starts[column_strip] + within
        # Entries of equal position are brought together, and added up in one pass over all strips.
        self._gather = np.argsort(position, kind="stable")
        sorted_positions = position[self._gather]
        self._runs = np.flatnonzero(np.diff(sorted_positions, prepend=-1))
        filled = sorted_positions[self._runs]
        bounds = np.searchsorted(filled, block_starts)
        self.block_rows = [
            BlockRow(
                unknowns=self._order[starts[i] : starts[i + 1]],
                entries=slice(bounds[i], bounds[i + 1]),
                positions=filled[bounds[i] : bounds[i + 1]] - block_starts[i],
                coupled=int(couplings[i]),
                next_size=int(next_sizes[i]),
            )
            for i in range(len(sizes))
        ]

    def assembled(self, values: Numbers) -> Numbers:
        """Entries of all block rows, values of equal position added up."""
        entries: Numbers = np.add.reduceat(values[self._gather], self._runs)
        return entries

    def factorise(self, values: Numbers) -> "BlockFactors | ComplexBlockFactors":
        """Factorise the matrix with these values."""
        entries = self.assembled(values)
        if np.iscomplexobj(entries):
            return ComplexBlockFactors(self.block_rows, entries)
        return BlockFactors(self.block_rows, list(self._factors(entries)))

    def congruence(self, values: Numbers, B: Numbers) -> Numbers:
        """B^T A^-1 B, (k, k); each factor is used once and not kept."""
        entries = self.assembled(values)
        if np.iscomplexobj(entries):
            product: Numbers = B.T @ ComplexBlockFactors(self.block_rows, entries).solve(B)
            return product
        total: Numbers = np.zeros((B.shape[1], B.shape[1]))
        half: Numbers = np.zeros((0, B.shape[1]))
        before: Numbers = np.zeros((0, 0))
        for block_row, (factor, below) in zip(self.block_rows, self._factors(entries), strict=True):
            half = _forward_substitution(block_row, factor, before, half, B)
            total = total + half.T @ half
            before = below
        return total

    def _factors(self, entries: Numbers) -> Iterator[tuple[Numbers, Numbers]]:
        """Diagonal and sub-diagonal block of L for each block row, first to last."""
        before: Numbers | None = None
        for block_row in self.block_rows:
            diagonal, sub_diagonal = block_row.blocks(entries)
            if before is not None:
                diagonal = blas.dsyrk(-1.0, before, 1.0, diagonal, lower=1, overwrite_c=1)
            factor = cholesky(diagonal)
            before = block_row.sub_diagonal_factor(factor, sub_diagonal)
            yield factor, before


@dataclass(frozen=True, slots=True, eq=False)
class BlockRow:
    """The unknowns of one strip, with the positions of its diagonal and sub-diagonal block.

    Attributes:
        unknowns: of the strip; those coupled to the next strip come last.
        entries: the strip's part of `BlockCholesky.assembled`.
        positions: of these entries in diagonal and sub-diagonal block, both by column.
        coupled: number of unknowns coupled to the next strip.
        next_size: number of unknowns of the next strip; 0 for the last one.
    """

    unknowns: Indices
    entries: slice
    positions: Indices
    coupled: int
    next_size: int

    def blocks(self, entries: Numbers) -> tuple[Numbers, Numbers]:
        """Diagonal block, lower triangle filled, and sub-diagonal block (next_size, coupled)."""
        size = len(self.unknowns)
        flat = np.zeros(size**2 + self.next_size * self.coupled, dtype=entries.dtype)
        flat[self.positions] = entries[self.entries]
        below = flat[size**2 :].reshape(self.coupled if self.next_size else 0, self.next_size)
        return flat[: size**2].reshape(size, size).T, below.T

    def sub_diagonal_factor(self, factor: Numbers, sub_diagonal: Numbers) -> Numbers:
        """Sub-diagonal block of L, A' L^-T, from that of A and the diagonal block of L.

        Only the corner of L that belongs to the coupled unknowns takes part.
        """
        if not self.next_size:
            return sub_diagonal
        inner = len(factor) - self.coupled
        corner = np.asfortranarray(factor[inner:, inner:])
        found: Numbers = blas.dtrsm(
            1.0, corner, sub_diagonal, side=1, lower=1, trans_a=1, overwrite_b=1
        )
        return found


def cholesky(block: Numbers) -> Numbers:
    """Cholesky factor of a block, in its lower triangle; raises ConfigurationError."""
    factor: Numbers
    factor, info = lapack.dpotrf(block, lower=1, clean=0, overwrite_a=1)
    if info:
        raise ConfigurationError(
            f"the matrix is not positive definite to rounding (row {info} of a block of "
            f"{len(block)}); conductivities or contact impedances differ by more orders of "
            "magnitude than double precision holds: bring them closer"
        )
    return factor


def _forward_substitution(
    block_row: BlockRow, factor: Numbers, before: Numbers, half: Numbers, B: Numbers
) -> Numbers:
    """Rows of L^-1 B for one strip, from those of the strip before and L's block between them."""
    right = B[block_row.unknowns]
    if before.size:
        right = right - before @ half[len(half) - before.shape[1] :]
    own: Numbers = blas.dtrsm(1.0, factor, right, lower=1)
    return own


class BlockFactors:
    """Block Cholesky factors of one matrix."""

    def __init__(self, block_rows: list[BlockRow], blocks: list[tuple[Numbers, Numbers]]) -> None:
        """Keep the diagonal and sub-diagonal block of L for each block row."""
        self._block_rows, self._blocks = block_rows, blocks

    def rounded(self) -> "SingleBlockFactors":
        """The same factors in single precision."""
        return SingleBlockFactors(self._block_rows, self._blocks)

    def solve(self, B: Numbers) -> Numbers:
        """A^-1 B, (n, k), by forward and backward substitution."""
        halves: list[Numbers] = []
        half: Numbers = np.zeros((0, B.shape[1]))
        before: Numbers = np.zeros((0, 0))
        for block_row, (factor, below) in zip(self._block_rows, self._blocks, strict=True):
            half = _forward_substitution(block_row, factor, before, half, B)
            halves.append(half)
            before = below
        solution = np.empty_like(B)
        after: Numbers | None = None
        for block_row, (factor, below), right in zip(
            reversed(self._block_rows), reversed(self._blocks), reversed(halves), strict=True
        ):
            if after is not None:
                coupled = slice(len(right) - below.shape[1], None)
                right[coupled] = right[coupled] - below.T @ after
            after = blas.dtrsm(1.0, factor, right, lower=1, trans_a=1)
            solution[block_row.unknowns] = after
        return solution


class SingleBlockFactors:
    """Block Cholesky factors in single precision, for approximate solutions of many systems.

    The diagonal blocks of L are inverted, so that a solution is made of matrix products alone.
    """

    def __init__(self, block_rows: list[BlockRow], blocks: list[tuple[Numbers, Numbers]]) -> None:
        """Invert the diagonal block of L of each block row, and round to single precision."""
        self._order = np.concatenate([row.unknowns for row in block_rows])
        self._blocks = [
            (lapack.dtrtri(np.tril(factor), lower=1)[0].astype(np.float32), J.astype(np.float32))
            for factor, J in blocks
        ]

    def solve(self, B: Numbers) -> Numbers:
        """A^-1 B, (n, k), to single precision."""
        scale = np.abs(B).max(initial=np.finfo(np.float32).tiny)
        x = (B[self._order] / scale).astype(np.float32)
        strips, start = [], 0
        before: Numbers | None = None
        for inverse, J in self._blocks:
            strip = x[start : start + len(inverse)]
            if before is not None:
                strip -= before
            strip[:] = inverse @ strip
            before = J @ strip[len(strip) - J.shape[1] :] if J.size else None
            strips.append(strip)
            start += len(inverse)
        after: Numbers | None = None
        for strip, (inverse, J) in zip(reversed(strips), reversed(self._blocks), strict=True):
            if after is not None and J.size:
                strip[len(strip) - J.shape[1] :] -= J.T @ after
            strip[:] = inverse.T @ strip
            after = strip
        solution = np.empty_like(B)
        solution[self._order] = scale * x
        return solution


class ComplexBlockFactors:
    """Block LU factors of one complex symmetric matrix."""

    def __init__(self, block_rows: list[BlockRow], entries: Numbers) -> None:
        """Eliminate strip by strip: LU factors of the Schur complements S, and the blocks J below.

        J couples a strip's last unknowns to the next strip, whose diagonal block becomes
        S' = A' - J S^-1 J^T.
        """
        self._block_rows = block_rows
        self._blocks: list[tuple[Numbers, Numbers, Numbers]] = []
        update: Numbers | None = None
        for block_row in block_rows:
            diagonal, J = block_row.blocks(entries)
            S = np.tril(diagonal) + np.tril(diagonal, -1).T
            if update is not None:
                S = S - update
            lu, pivots, _ = lapack.zgetrf(S)
            J_transposed = np.zeros((len(S), J.shape[0]), dtype=complex)
            if J.size:
                J_transposed[len(S) - J.shape[1] :] = J.T
            solved = lapack.zgetrs(lu, pivots, J_transposed)[0] if J.size else J_transposed
            update = J @ solved[len(S) - J.shape[1] :] if J.size else None
            self._blocks.append((lu, pivots, J))

    def solve(self, B: Numbers) -> Numbers:
        """A^-1 B, (n, k), by forward and backward substitution."""
        solution = np.array(B, dtype=complex)
        for (block_row, (lu, pivots, J)), after in zip(
            zip(self._block_rows, self._blocks, strict=True), self._block_rows[1:], strict=False
        ):
            half = lapack.zgetrs(lu, pivots, solution[block_row.unknowns])[0]
            solution[after.unknowns] -= J @ half[len(half) - J.shape[1] :]
        later: BlockRow | None = None
        for block_row, (lu, pivots, J) in zip(
            reversed(self._block_rows), reversed(self._blocks), strict=True
        ):
            unknowns = block_row.unknowns
            if later is not None:
                solution[unknowns[len(unknowns) - J.shape[1] :]] -= J.T @ solution[later.unknowns]
            solution[unknowns] = lapack.zgetrs(lu, pivots, solution[unknowns])[0]
            later = block_row
        return solution
