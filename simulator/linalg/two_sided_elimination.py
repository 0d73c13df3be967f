"""Block elimination from both ends of a body: what changes in between is eliminated anew.

With the strips before some strip eliminated from the left, and those after it from the right, each
side is one dense block added to the strip (its Schur complement), one load, and one share of
B^T A^-1 B. Kept for every strip, they turn a change of a few strips into an elimination of these.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import blas

from eitskin.simulator.linalg.block_cholesky import BlockCholesky, BlockFactors, Strip, cholesky

Numbers = NDArray[np.inexact]


@dataclass(frozen=True, slots=True, eq=False)
class _Side:
    """All strips on one side of a strip, eliminated.

    Attributes:
        block: taken off the strip's own block, lower triangle; of its carried unknowns where the
            side is the right one.
        load: taken off its rows of B.
        share: B^T A^-1 B of the side.
    """

    block: Numbers
    load: Numbers
    share: Numbers


class BothEnds:
    """A positive definite matrix and columns B, eliminated from both ends.

    Attributes:
        factors: of the matrix.
    """

    def __init__(self, solver: BlockCholesky, values: Numbers, B: Numbers) -> None:
        """Eliminate the matrix with these values, once each way."""
        self._solver = solver
        sums, count = solver.sums(values), B.shape[1]
        none = _Side(np.zeros((0, 0)), np.zeros((0, count)), np.zeros((count, count)))
        self._left, self._right = [none], [none]
        blocks = []
        for strip in solver.strips:
            side = self._left[-1]
            own, joining = strip.blocks(sums)
            factor, half = _eliminated(own, B[strip.unknowns], side, slice(None))
            joined = strip.joined(factor, joining)
            blocks.append((factor, joined))
            load = joined @ half[len(half) - strip.carried :]
            self._left.append(_Side(_square(joined), load, side.share + half.T @ half))
        self.factors = BlockFactors(solver.strips, blocks)
        for before, strip in zip(
            reversed(solver.strips[:-1]), reversed(solver.strips), strict=False
        ):
            side = self._right[-1]
            own, _ = strip.blocks(sums)
            factor, half = _eliminated(own, B[strip.unknowns], side, _ends(strip))
            across = blas.dtrsm(1.0, factor, before.blocks(sums)[1], lower=1)
            self._right.append(
                _Side(_square(across.T), across.T @ half, side.share + half.T @ half)
            )
        self._right.reverse()

    def congruence(self, values: Numbers, B: Numbers, first: int, last: int) -> Numbers:
        """B^T A^-1 B, (k, k), where only strips `first` to `last` have changed.

        Values and rows of B of other strips are not looked at.
        """
        sums = self._solver.sums(values, first, last)
        start = self._solver.strips[first].values.start
        side = self._left[first]
        for number in range(first, last + 1):
            strip = self._solver.strips[number]
            own, joining = strip.blocks(sums, start)
            right = B[strip.unknowns]
            if number == last:
                side = _with(side, self._right[last], own, right, _ends(strip))
            factor, half = _eliminated(own, right, side, slice(None))
            share = side.share + half.T @ half
            if number < last:
                joined = strip.joined(factor, joining)
                side = _Side(_square(joined), joined @ half[len(half) - strip.carried :], share)
        return share


def _eliminated(own: Numbers, right: Numbers, side: _Side, where: slice) -> tuple[Numbers, Numbers]:
    """The factor of a strip's block without a side, and its rows of L^-1 B."""
    if side.block.size:
        own[where, where] = own[where, where] - side.block
        right[where] = right[where] - side.load
    factor = cholesky(own)
    half: Numbers = blas.dtrsm(1.0, factor, right, lower=1)
    return factor, half


def _with(side: _Side, other: _Side, own: Numbers, right: Numbers, where: slice) -> _Side:
    """One side after the other is taken off the strip."""
    if other.block.size:
        own[where, where] = own[where, where] - other.block
        right[where] = right[where] - other.load
    return _Side(side.block, side.load, side.share + other.share)


def _ends(strip: Strip) -> slice:
    """The strip's unknowns that touch the next strip."""
    return slice(len(strip.unknowns) - strip.carried, None)


def _square(joined: Numbers) -> Numbers:
    """J J^T, its lower triangle."""
    if not joined.size:
        return np.zeros((0, 0))
    square: Numbers = blas.dsyrk(1.0, joined, lower=1)
    return square
