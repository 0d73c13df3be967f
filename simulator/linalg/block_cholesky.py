"""Block tridiagonal elimination along a body: dense blocks, one per strip of unknowns."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import blas, lapack
from scipy.sparse import coo_array

from eitskin.errors import ConfigurationError

Numbers = NDArray[np.inexact]
Indices = NDArray[np.int64]


def levels(numbers: Indices, first: Indices) -> Indices:
    """Strip of each unknown, (unknowns,): its distance in elements from those of `first`.

    `numbers` are the unknowns of each element, (elements, functions). An element then touches two
    neighbouring strips at most, on any mesh.
    """
    elements, functions = numbers.shape
    unknowns = int(numbers.max()) + 1
    places = (np.repeat(np.arange(elements), functions), numbers.ravel())
    touches = coo_array((np.ones(numbers.size, dtype=np.int8), places), (elements, unknowns))
    by_element, by_unknown = touches.tocsr(), touches.T.tocsr()
    level = np.full(unknowns, -1)
    reached = np.zeros(elements, dtype=bool)
    front, number = first, 0
    while len(front):
        reached[front] = True
        new = np.unique(by_element[front].indices)
        new = new[level[new] < 0]
        level[new] = number
        near = np.unique(by_unknown[new].indices)
        front = near[~reached[near]]
        number += 1
    if level.min() < 0:
        raise ConfigurationError(
            "the body falls into parts that do not touch; a sensor is one connected body"
        )
    return level


class BlockCholesky:
    """Block tridiagonal Cholesky, for long bodies: dense blocks, one per strip of unknowns.

    An element touches two neighbouring strips at most. Within a strip the unknowns that touch
    the next one come last, so the block below them is all that is carried on. Complex symmetric
    matrices with a positive definite real part go through the same elimination with LU blocks:
    no pivoting between blocks is needed (Higham 1998).
    """

    name = "block Cholesky"

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
        self.strips = [
            Strip(
                unknowns=self._order[starts[i] : starts[i + 1]],
                values=slice(bounds[i], bounds[i + 1]),
                places=filled[bounds[i] : bounds[i + 1]] - block_starts[i],
                carried=int(kept[i]),
                below=int(below[i]),
            )
            for i in range(len(sizes))
        ]

    def sums(self, values: Numbers, first: int = 0, last: int | None = None) -> Numbers:
        """The values of strips `first` to `last`, those of equal place added up."""
        strips = self.strips[first : None if last is None else last + 1]
        runs = self._runs[strips[0].values.start : strips[-1].values.stop]
        end = np.append(self._runs, len(self._gather))[strips[-1].values.stop]
        added: Numbers = np.add.reduceat(values[self._gather[runs[0] : end]], runs - runs[0])
        return added

    def factorise(self, values: Numbers) -> "BlockFactors | ComplexBlockFactors":
        """Factorise the matrix with these values."""
        sums = self.sums(values)
        if np.iscomplexobj(sums):
            return ComplexBlockFactors(self.strips, sums)
        return BlockFactors(self.strips, list(self._sweep(sums)))

    def congruence(self, values: Numbers, B: Numbers) -> Numbers:
        """B^T A^-1 B, (k, k): each strip's factor serves once and is forgotten."""
        sums = self.sums(values)
        if np.iscomplexobj(sums):
            product: Numbers = B.T @ ComplexBlockFactors(self.strips, sums).solve(B)
            return product
        total: Numbers = np.zeros((B.shape[1], B.shape[1]))
        half: Numbers = np.zeros((0, B.shape[1]))
        joined: Numbers = np.zeros((0, 0))
        for strip, (factor, joining) in zip(self.strips, self._sweep(sums), strict=True):
            half = _forward(strip, factor, joined, half, B)
            total = total + half.T @ half
            joined = joining
        return total

    def _sweep(self, sums: Numbers) -> Iterator[tuple[Numbers, Numbers]]:
        """From end to end, each strip's Cholesky factor and the block joined to the next."""
        joined: Numbers | None = None
        for strip in self.strips:
            own, joining = strip.blocks(sums)
            if joined is not None:
                own = blas.dsyrk(-1.0, joined, 1.0, own, lower=1, overwrite_c=1)
            factor = cholesky(own)
            joined = strip.joined(factor, joining)
            yield factor, joined


@dataclass(frozen=True, slots=True, eq=False)
class Strip:
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

    def blocks(self, sums: Numbers, start: int = 0) -> tuple[Numbers, Numbers]:
        """The strip's own block, its lower triangle filled, and the block below it.

        Of added-up values from number `start` on.
        """
        size = len(self.unknowns)
        flat = np.zeros(size**2 + self.below * self.carried, dtype=sums.dtype)
        flat[self.places] = sums[self.values.start - start : self.values.stop - start]
        joining = flat[size**2 :].reshape(self.carried if self.below else 0, self.below)
        return flat[: size**2].reshape(size, size).T, joining.T

    def joined(self, factor: Numbers, joining: Numbers) -> Numbers:
        """The block below, times the inverse of the carried corner of the factor, transposed."""
        if not self.below:
            return joining
        inner = len(factor) - self.carried
        corner = np.asfortranarray(factor[inner:, inner:])
        found: Numbers = blas.dtrsm(1.0, corner, joining, side=1, lower=1, trans_a=1, overwrite_b=1)
        return found


def cholesky(block: Numbers) -> Numbers:
    """The lower factor of a block, in its lower triangle; raises ConfigurationError."""
    factor: Numbers
    factor, info = lapack.dpotrf(block, lower=1, clean=0, overwrite_a=1)
    if info:
        raise ConfigurationError(
            f"the matrix is not positive definite to rounding (row {info} of a block of "
            f"{len(block)}); conductivities or contact impedances differ by more orders of "
            "magnitude than double precision holds: bring them closer"
        )
    return factor


def _forward(
    strip: Strip, factor: Numbers, joined: Numbers, before: Numbers, B: Numbers
) -> Numbers:
    """The strip's rows of L^-1 B, from those of the strip before."""
    right = B[strip.unknowns]
    if joined.size:
        right = right - joined @ before[len(before) - joined.shape[1] :]
    half: Numbers = blas.dtrsm(1.0, factor, right, lower=1)
    return half


class BlockFactors:
    """The block Cholesky factors of one matrix."""

    def __init__(self, strips: list[Strip], blocks: list[tuple[Numbers, Numbers]]) -> None:
        """Keep each strip's factor and joined block."""
        self._strips, self._blocks = strips, blocks

    def solve(self, B: Numbers) -> Numbers:
        """A^-1 B, (n, k)."""
        halves: list[Numbers] = []
        half: Numbers = np.zeros((0, B.shape[1]))
        joined: Numbers = np.zeros((0, 0))
        for strip, (factor, joining) in zip(self._strips, self._blocks, strict=True):
            half = _forward(strip, factor, joined, half, B)
            halves.append(half)
            joined = joining
        solution = np.empty_like(B)
        after: Numbers | None = None
        for strip, (factor, joining), right in zip(
            reversed(self._strips), reversed(self._blocks), reversed(halves), strict=True
        ):
            if after is not None:
                ends = slice(len(right) - joining.shape[1], None)
                right[ends] = right[ends] - joining.T @ after
            after = blas.dtrsm(1.0, factor, right, lower=1, trans_a=1)
            solution[strip.unknowns] = after
        return solution


class ComplexBlockFactors:
    """The block LU factors of one complex symmetric matrix."""

    def __init__(self, strips: list[Strip], sums: Numbers) -> None:
        """Eliminate strip by strip; S are the pivots, J the blocks below them."""
        self._strips = strips
        self._blocks: list[tuple[Numbers, Numbers, Numbers]] = []
        carried: Numbers | None = None
        for strip in strips:
            own, J = strip.blocks(sums)
            own = np.tril(own) + np.tril(own, -1).T
            if carried is not None:
                own = own - carried
            lu, pivots, _ = lapack.zgetrf(own)
            below = np.zeros((len(own), J.shape[0]), dtype=complex)
            if J.size:
                below[len(own) - J.shape[1] :] = J.T
            S_below = lapack.zgetrs(lu, pivots, below)[0] if J.size else below
            carried = J @ S_below[len(own) - J.shape[1] :] if J.size else None
            self._blocks.append((lu, pivots, J))

    def solve(self, B: Numbers) -> Numbers:
        """A^-1 B, (n, k)."""
        solution = np.array(B, dtype=complex)
        for (strip, (lu, pivots, J)), after in zip(
            zip(self._strips, self._blocks, strict=True), self._strips[1:], strict=False
        ):
            half = lapack.zgetrs(lu, pivots, solution[strip.unknowns])[0]
            solution[after.unknowns] -= J @ half[len(half) - J.shape[1] :]
        later: Strip | None = None
        for strip, (lu, pivots, J) in zip(
            reversed(self._strips), reversed(self._blocks), strict=True
        ):
            if later is not None:
                ends = strip.unknowns[len(strip.unknowns) - J.shape[1] :]
                solution[ends] -= J.T @ solution[later.unknowns]
            solution[strip.unknowns] = lapack.zgetrs(lu, pivots, solution[strip.unknowns])[0]
            later = strip
        return solution
