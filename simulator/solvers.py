"""Symmetric positive definite solvers: factorise once, solve many.

A solver is made from the places of the matrix values. `factorise(values)` gives a factorisation,
which answers `solve(B) = A^-1 B`; `congruence(values, B) = B^T A^-1 B`, all that impedances need,
keeps no factors and is cheaper.
"""

from collections.abc import Iterator
from dataclasses import dataclass
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


class Solver(Protocol):
    """Factorises matrices whose lower-triangle values stand at fixed places."""

    name: str

    def factorise(self, values: Array) -> Factorisation:
        """Factorise the matrix with these values; values of equal place add up."""
        ...

    def congruence(self, values: Array, B: Array) -> Array:
        """B^T A^-1 B, (k, k), of the matrix with these values."""
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

    def congruence(self, values: Array, B: Array) -> Array:
        """B^T A^-1 B, (k, k)."""
        return B.T @ self.factorise(values).solve(B)


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
        # Places within a strip, column by column: its own block, then the block below its carried
        # unknowns.
        column_strip, row_strip = strip[self._order[low]], strip[self._order[high]]
        column, row = low - starts[column_strip], high - starts[row_strip]
        size = sizes[column_strip]
        own = column * size + row
        first = size - kept[column_strip]
        joining = size**2 + (column - first) * below[column_strip] + row
        within = np.where(row_strip == column_strip, own, joining)
        extents = sizes**2 + below * kept
        block_starts = np.concatenate([[0], np.cumsum(extents)])
        place = block_starts[column_strip] + within
        # Values of equal place, brought together, are added up in one pass over all strips.
        self._gather = np.argsort(place, kind="stable")
        sorted_place = place[self._gather]
        self._runs = np.flatnonzero(np.diff(sorted_place, prepend=-1))
        filled = sorted_place[self._runs]
        bounds = np.searchsorted(filled, block_starts)
        self._strips = [
            _Strip(
                unknowns=self._order[starts[i] : starts[i + 1]],
                values=slice(bounds[i], bounds[i + 1]),
                places=filled[bounds[i] : bounds[i + 1]] - block_starts[i],
                carried=int(kept[i]),
                below=int(below[i]),
            )
            for i in range(len(sizes))
        ]

    def factorise(self, values: Array) -> "BlockFactors":
        """Factorise the matrix with these values."""
        return BlockFactors(self._strips, list(self._sweep(values)))

    def congruence(self, values: Array, B: Array) -> Array:
        """B^T A^-1 B, (k, k): each strip's factor serves once and is forgotten."""
        total = np.zeros((B.shape[1], B.shape[1]))
        half = np.zeros((0, B.shape[1]))
        joined = np.zeros((0, 0))
        for strip, (factor, joining) in zip(self._strips, self._sweep(values), strict=True):
            half = _forward(strip, factor, joined, half, B)
            total += half.T @ half
            joined = joining
        return total

    def _sweep(self, values: Array) -> Iterator[tuple[Array, Array]]:
        """From left to right, each strip's Cholesky factor and the block joined to the next."""
        sums = np.add.reduceat(values[self._gather], self._runs)
        joined: Array | None = None
        for number, strip in enumerate(self._strips):
            own, joining = strip.blocks(sums)
            if joined is not None:
                own = blas.dsyrk(-1.0, joined, 1.0, own, lower=1, overwrite_c=1)
            factor, info = lapack.dpotrf(own, lower=1, clean=0, overwrite_a=1)
            if info:
                raise np.linalg.LinAlgError(f"strip {number}: the matrix is not positive definite")
            if strip.below:
                inner = len(factor) - strip.carried
                corner = np.asfortranarray(factor[inner:, inner:])
                joining = blas.dtrsm(
                    1.0, corner, joining, side=1, lower=1, trans_a=1, overwrite_b=1
                )
            yield factor, joining
            joined = joining


@dataclass(frozen=True, slots=True, eq=False)
class _Strip:
    """One strip of unknowns and where its matrix values go.

    Attributes:
        unknowns: their numbers, those carried to the next strip last.
        values: of the added-up values, those of this strip.
        places: where these go in the strip's own block and the block below, both by column.
        carried: how many unknowns touch the next strip.
        below: size of the next strip.
    """

    unknowns: Indices
    values: slice
    places: Indices
    carried: int
    below: int

    def blocks(self, sums: Array) -> tuple[Array, Array]:
        """The strip's own block, its lower triangle filled, and the block below it."""
        size = len(self.unknowns)
        flat = np.zeros(size**2 + self.below * self.carried)
        flat[self.places] = sums[self.values]
        joining = flat[size**2 :].reshape(self.carried if self.below else 0, self.below)
        return flat[: size**2].reshape(size, size).T, joining.T


def _forward(strip: _Strip, factor: Array, joined: Array, before: Array, B: Array) -> Array:
    """The strip's rows of L^-1 B, from those of the strip before."""
    right = B[strip.unknowns]
    if joined.size:
        right = right - joined @ before[len(before) - joined.shape[1] :]
    half: Array = blas.dtrsm(1.0, factor, right, lower=1)
    return half


class BlockFactors:
    """The block Cholesky factors of one matrix."""

    def __init__(self, strips: list[_Strip], blocks: list[tuple[Array, Array]]) -> None:
        """Keep each strip's factor and joined block."""
        self._strips, self._blocks = strips, blocks

    def solve(self, B: Array) -> Array:
        """A^-1 B, (n, k)."""
        halves: list[Array] = []
        joined, half = np.zeros((0, 0)), np.zeros((0, B.shape[1]))
        for strip, (factor, joining) in zip(self._strips, self._blocks, strict=True):
            half = _forward(strip, factor, joined, half, B)
            halves.append(half)
            joined = joining
        solution = np.empty_like(B)
        after: Array | None = None
        for strip, (factor, joining), right in zip(
            reversed(self._strips), reversed(self._blocks), reversed(halves), strict=True
        ):
            if after is not None:
                right[len(right) - joining.shape[1] :] -= joining.T @ after
            after = blas.dtrsm(1.0, factor, right, lower=1, trans_a=1)
            solution[strip.unknowns] = after
        return solution
