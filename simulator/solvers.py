"""Symmetric positive definite solvers: factorise once, solve many.

A solver is made from the places of the matrix values, `factorise(values)` gives a factorisation,
and that answers `solve(B) = A^-1 B` and the cheaper `congruence(B) = B^T A^-1 B`.
"""

from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import blas, lapack
from scipy.sparse import csc_array
from scipy.sparse.linalg import splu

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


class Factorisation(Protocol):
    """A factorised symmetric positive definite matrix A."""

    def solve(self, B: Array) -> Array:
        """A^-1 B, (n, k)."""
        ...

    def congruence(self, B: Array) -> Array:
        """B^T A^-1 B, (k, k)."""
        ...


class Solver(Protocol):
    """Factorises matrices whose lower-triangle values stand at fixed places."""

    name: str

    def factorise(self, values: Array) -> Factorisation:
        """Factorise the matrix with these values; values of equal place add up."""
        ...


class SparseDirect:
    """Sparse LU of any mesh (SuperLU)."""

    name = "sparse LU"

    def __init__(self, rows: Indices, columns: Indices, n: int) -> None:
        """Prepare for values at (rows >= columns) of an n x n matrix."""
        self._rows, self._columns, self._n = rows, columns, n

    def factorise(self, values: Array) -> "SparseFactors":
        """Factorise the matrix with these values."""
        lower = csc_array((values, (self._rows, self._columns)), shape=(self._n, self._n))
        whole = lower + lower.T
        whole.setdiag(lower.diagonal())
        return SparseFactors(whole)


class SparseFactors:
    """The sparse LU factors of one matrix."""

    def __init__(self, matrix: csc_array) -> None:
        """Factorise `matrix`, keeping it symmetric: diagonal pivots, minimum degree of A + A^T."""
        options = {"SymmetricMode": True}
        self._lu = splu(matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)

    def solve(self, B: Array) -> Array:
        """A^-1 B, (n, k)."""
        solution: Array = self._lu.solve(B)
        return solution

    def congruence(self, B: Array) -> Array:
        """B^T A^-1 B, (k, k)."""
        return B.T @ self.solve(B)


class BlockCholesky:
    """Block tridiagonal Cholesky along x, for slabs: dense blocks, one per strip of unknowns.

    Unknowns at x in (x_{i-1}, x_i] of the cell faces x_i form strip i; a cell then touches two
    neighbouring strips only. Within a strip the unknowns on its last face, which alone touch the
    next strip, come last, so the block below them is all that is carried on.
    """

    name = "block Cholesky along x"

    def __init__(self, rows: Indices, columns: Indices, strip: Indices) -> None:
        """Prepare for values at (rows, columns), with the strip number of each unknown, (n,)."""
        crossing = strip[rows] != strip[columns]
        if np.any(np.abs(strip[rows] - strip[columns]) > 1):
            raise ValueError("a matrix value joins strips that are not neighbours")
        lower_end = np.where(strip[rows] < strip[columns], rows, columns)[crossing]
        carried = np.zeros(len(strip), dtype=bool)
        carried[lower_end] = True
        self._order = np.lexsort((carried, strip))
        rank = np.empty_like(self._order)
        rank[self._order] = np.arange(len(strip))
        low, high = np.minimum(rank[rows], rank[columns]), np.maximum(rank[rows], rank[columns])

        sizes, kept = np.bincount(strip), np.bincount(strip[carried], minlength=strip.max() + 1)
        starts = np.concatenate([[0], np.cumsum(sizes)])
        below = np.append(sizes[1:], 0)
        # All blocks lie in one flat array, column by column: per strip its own block, then the
        # block below its carried unknowns.
        block_starts = np.concatenate([[0], np.cumsum(sizes**2 + below * kept)])
        column_strip, row_strip = strip[self._order[low]], strip[self._order[high]]
        column, row = low - starts[column_strip], high - starts[row_strip]
        size = sizes[column_strip]
        own = column * size + row
        first = size - kept[column_strip]
        joining = size**2 + (column - first) * below[column_strip] + row
        self._place = block_starts[column_strip] + np.where(row_strip == column_strip, own, joining)
        self._sizes, self._starts, self._block_starts = sizes, starts, block_starts

    def factorise(self, values: Array) -> "BlockFactors":
        """Factorise the matrix with these values."""
        flat = np.bincount(self._place, values, int(self._block_starts[-1])).astype(np.float64)
        blocks: list[tuple[Array, Array]] = []
        joined: Array | None = None
        for i in range(len(self._sizes)):
            own, joining = self._blocks(flat, i)
            if joined is not None:
                own = blas.dsyrk(-1.0, joined, 1.0, own, lower=1, overwrite_c=1)
            factor, info = lapack.dpotrf(own, lower=1, clean=0, overwrite_a=1)
            if info:
                raise np.linalg.LinAlgError(f"strip {i}: the matrix is not positive definite")
            if joining.size:
                inner = len(factor) - joining.shape[1]
                corner = np.asfortranarray(factor[inner:, inner:])
                joining = blas.dtrsm(
                    1.0, corner, joining, side=1, lower=1, trans_a=1, overwrite_b=1
                )
            blocks.append((factor, joining))
            joined = joining
        return BlockFactors(blocks, self._order, self._starts)

    def _blocks(self, flat: Array, i: int) -> tuple[Array, Array]:
        start, end, size = self._block_starts[i], self._block_starts[i + 1], self._sizes[i]
        own = flat[start : start + size**2].reshape(size, size).T
        after = self._sizes[i + 1] if i + 1 < len(self._sizes) else 0
        joining = flat[start + size**2 : end].reshape(-1, after).T if after else np.empty((0, 0))
        return own, joining


class BlockFactors:
    """The block Cholesky factors of one matrix."""

    def __init__(self, blocks: list[tuple[Array, Array]], order: Indices, starts: Indices) -> None:
        """Keep the factors; `order` lists the unknowns strip by strip."""
        self._blocks, self._order, self._starts = blocks, order, starts

    def solve(self, B: Array) -> Array:
        """A^-1 B, (n, k)."""
        forward = self._forward(B)
        solution = np.empty_like(B)
        after: Array | None = None
        for i in reversed(range(len(self._blocks))):
            factor, joined = self._blocks[i]
            right = forward[i]
            if after is not None:
                right[len(right) - joined.shape[1] :] -= joined.T @ after
            after = blas.dtrsm(1.0, factor, right, lower=1, trans_a=1)
            solution[self._order[self._starts[i] : self._starts[i + 1]]] = after
        return solution

    def congruence(self, B: Array) -> Array:
        """B^T A^-1 B, (k, k): the forward half of a solve is enough."""
        half = np.concatenate(self._forward(B))
        return half.T @ half

    def _forward(self, B: Array) -> list[Array]:
        """L^-1 B, strip by strip."""
        parts: list[Array] = []
        joined: Array | None = None
        for i, (factor, joining) in enumerate(self._blocks):
            right = B[self._order[self._starts[i] : self._starts[i + 1]]]
            if joined is not None:
                before = parts[-1]
                right = right - joined @ before[len(before) - joined.shape[1] :]
            parts.append(blas.dtrsm(1.0, factor, right, lower=1))
            joined = joining
        return parts
