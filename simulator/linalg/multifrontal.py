"""Multifrontal factorisation of sparse symmetric matrices, in a given order of elimination.

Blocks of unknowns are eliminated one after the other, each in a dense frontal matrix. Elimination
leaves a dense Schur complement on the unknowns that the block is coupled to, its border, which is
added to the front of a later block (multifrontal method, Duff and Reid 1983). Positive definite
matrices have Cholesky factors. Others, complex ones among them, have factors L D L^T with pivots
of order 1 and 2 within blocks (Bunch and Kaufman 1977).
"""

from collections.abc import Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import blas, lapack, ldl, solve_triangular
from scipy.sparse import csc_array, csr_array

from eitskin.errors import ConfigurationError
from eitskin.simulator.linalg.sparse_structure import Block
from eitskin.threads import one_thread

Numbers = NDArray[Any]  # real or complex
Indices = NDArray[np.int64]
Places = slice | Indices

_SHARED = 3000  # rows of a front, from which several threads have enough to do
_MIN_RUN = 15  # rows, in the mean, of runs that are added one by one


class Addition(NamedTuple):
    """Part of a Schur complement that is added to a front.

    Attributes:
        block: number of the block: of own unknowns, of the border below these, or of the border.
        there, here: rows and columns of the block, and of the complement.
    """

    block: int
    there: tuple[Any, Any]
    here: tuple[slice, slice]


@dataclass(frozen=True, slots=True, eq=False)
class Front:
    """Unknowns eliminated together, and those that their elimination couples.

    Unknowns are numbered by their elimination.

    Attributes:
        own: the unknowns eliminated.
        border: unknowns eliminated later, rising; a slice where they follow each other.
        size, outer: number of own unknowns, and of those in the border.
        coupled: number of the last own unknowns, which alone are coupled to the border before any
            of the own ones are eliminated.
        within: fronts whose Schur complements are added, each with the parts that are added.
        entries: the front's part of the matrix entries, which are sorted by column.
        positions: positions of these entries in the matrix (own, own), column by column, then in
            the matrix (border, coupled) below.
        inherits: whether the matrix (own, own) is the Schur complement of the one front within.
    """

    own: slice
    border: Places
    size: int
    outer: int
    coupled: int
    within: tuple[tuple[int, tuple[Addition, ...]], ...]
    entries: slice
    positions: Indices
    inherits: bool


class _Factor(NamedTuple):
    """Factor of one front: P^T L D L^T P, and Y^T = (L^-1 P K)^T for its coupling K to the border.

    Attributes:
        own: unknowns in the order P of the pivots.
        lower: L, in the lower triangle.
        inverse: diagonal and sub-diagonal of D^-1; None for a Cholesky factor, where D is one.
        below: Y^T, (border, coupled): its columns of the last own unknowns, others being zero.
    """

    own: Places
    lower: Numbers
    inverse: tuple[Numbers, Numbers] | None
    below: Numbers


class MultifrontalSolver:
    """Solver for matrices whose lower triangle has a fixed sparsity pattern.

    Matrices are real and positive definite, or complex and symmetric with a positive definite real
    part, as with complex contact impedances; these need no pivots across blocks (Higham 1998).

    Attributes:
        name: name of the order of elimination, for people.
        fronts: fronts in the order of elimination.
    """

    def __init__(
        self, rows: Indices, columns: Indices, blocks: Sequence[Block], name: str = "given"
    ) -> None:
        """Prepare for values at (rows, columns); those of equal position add up."""
        self.name = name
        self._order = np.concatenate([block.own for block in blocks])
        rank = np.empty_like(self._order)
        rank[self._order] = np.arange(len(rank))
        # Each entry belongs to the front that eliminates the first of its two unknowns.
        one, other = rank[rows], rank[columns]
        entry = np.minimum(one, other) * len(rank) + np.maximum(one, other)
        gather = np.argsort(entry, kind="stable")
        entry = entry[gather]
        runs = np.flatnonzero(np.append(True, np.diff(entry) != 0))
        summed = np.ones(len(gather)), gather, np.append(runs, len(gather))
        self._sums = csr_array(summed, (len(runs), len(gather)))
        first, second = np.divmod(entry[runs], len(rank))
        ends = np.searchsorted(first, np.arange(len(rank) + 1))
        self.fronts = list(_fronts(blocks, ends, second))

    def factorise(self, values: Numbers) -> "Factors":
        """Factorise the matrix with these values."""
        with self.threads():
            return Factors(self._order, self.fronts, list(self._factors(values)))

    def congruence(self, values: Numbers, B: Numbers) -> Numbers:
        """B^T A^-1 B, (k, k), for the matrix A with these values; no factor is kept."""
        x = np.array(B[self._order], dtype=np.result_type(values, B))
        total: Numbers = np.zeros((B.shape[1], B.shape[1]), dtype=x.dtype)
        with self.threads():
            for front, factor in zip(self.fronts, self._factors(values), strict=True):
                y, scaled = _forward(front, factor, x)
                total = total + y.T @ scaled
        return total

    def threads(self) -> AbstractContextManager[None]:
        """Context with one thread, but for large fronts.

        Several wait for each other between small products, and on a busy machine most of the time.
        """
        rows = max(front.size + front.outer for front in self.fronts)
        return one_thread() if rows < _SHARED else nullcontext()

    def _factors(self, values: Numbers) -> Iterator[_Factor]:
        return _eliminate_fronts(self.fronts, self._sums @ values, not np.iscomplexobj(values))


class Factors:
    """Multifrontal factors of one matrix.

    Attributes:
        negative: number of negative eigenvalues (Sylvester's law of inertia).
    """

    def __init__(self, order: Indices, fronts: Sequence[Front], factors: Sequence[_Factor]) -> None:
        """Keep the factors of the fronts, and the unknowns in the order of elimination."""
        self._order, self._fronts, self._factors = order, fronts, factors

    @property
    def negative(self) -> int:
        """Number of negative eigenvalues of the matrix (Sylvester's law of inertia)."""
        return sum(_negative(f.inverse) for f in self._factors if f.inverse is not None)

    def to_single(self) -> "SingleFactors":
        """The same Cholesky factors in single precision."""
        return SingleFactors(self._order, self._fronts, self._factors)

    def solve(self, B: Numbers) -> Numbers:
        """A^-1 B, (n,) or (n, k), by forward and backward substitution."""
        kind = np.result_type(B, *{factor.lower.dtype for factor in self._factors})
        x = np.array(B[self._order], dtype=kind).reshape(len(B), -1)
        for front, factor in zip(self._fronts, self._factors, strict=True):
            _, x[front.own] = _forward(front, factor, x)
        for front, f in zip(reversed(self._fronts), reversed(self._factors), strict=True):
            right = x[front.own]
            right[front.size - f.below.shape[1] :] -= _scale_rows(
                f.inverse, f.below.T @ x[front.border]
            )
            x[f.own] = _triangular(f, right, transposed=True)
        solution = np.empty_like(x)
        solution[self._order] = x
        return solution.reshape(B.shape)


class SingleFactors:
    """Cholesky factors in single precision, for approximate solutions of many systems.

    The blocks S and J of L on and below the diagonal are kept as S^-1 above -J S^-1, so that each
    front takes one matrix product a sweep.

    Attributes:
        order: unknowns in the order of elimination.
    """

    def __init__(self, order: Indices, fronts: Sequence[Front], factors: Sequence[_Factor]) -> None:
        """Invert the diagonal block of L of each front, and round to single precision."""
        self.order = order
        self._fronts: list[tuple[slice, Places, Numbers]] = []
        for front, (_, lower, _, below) in zip(fronts, factors, strict=True):
            start, stop = front.own.start, front.own.stop
            # The first own unknowns are coupled to the last ones alone, as a front within.
            first = front.size - below.shape[1]
            middle = start + first
            for own, border, diagonal, beside in (
                (
                    slice(start, middle),
                    slice(middle, stop),
                    lower[:first, :first],
                    lower[first:, :first],
                ),
                (slice(middle, stop), front.border, lower[first:, first:], below),
            ):
                if own.stop > own.start:
                    inverse = lapack.dtrtri(np.tril(diagonal), lower=1)[0]
                    block = np.concatenate([inverse, -beside @ inverse]).astype(np.float32)
                    self._fronts.append((own, border, block))

    def solve(self, x: NDArray[np.float32]) -> None:
        """Replace x (n, k), with rows in the order of elimination, by A^-1 x."""
        for own, border, block in self._fronts:
            solution, size = block @ x[own], own.stop - own.start
            x[own] = solution[:size]
            x[border] += solution[size:]
        for own, border, block in reversed(self._fronts):
            x[own] = block.T @ np.concatenate([x[own], x[border]])


class IndefiniteSolver:
    """Solver for symmetric, possibly indefinite matrices, in one order of elimination.

    Fronts are set up again only where a matrix has other entries than the last one.
    """

    def __init__(self, blocks: Sequence[Block]) -> None:
        """Prepare for matrices whose unknowns are in blocks."""
        self._blocks = blocks
        self._order = np.concatenate([block.own for block in blocks])
        self._pattern: tuple[Indices, Indices] | None = None
        self._lower = np.empty(0, dtype=np.int64)  # entries on and below the diagonal, in order
        self._fronts: list[Front] = []

    def factorise(self, matrix: csc_array) -> Factors:
        """Factors L D L^T of a matrix (n, n); raises RuntimeError for a singular one."""
        pattern = matrix.indptr, matrix.indices
        if self._pattern is None or not all(map(np.array_equal, pattern, self._pattern)):
            self._set_up(matrix)
            self._pattern = pattern
        factors = _eliminate_fronts(self._fronts, matrix.data[self._lower], definite=False)
        return Factors(self._order, self._fronts, list(factors))

    def _set_up(self, matrix: csc_array) -> None:
        order = self._order
        position = np.empty_like(order)
        position[order] = np.arange(len(order))
        numbered = np.arange(matrix.nnz), matrix.indices, matrix.indptr
        columns = csc_array(csc_array(numbered, matrix.shape)[:, order])
        rows = position[columns.indices]
        later = rows >= np.repeat(np.arange(len(order)), np.diff(columns.indptr))
        ends = np.concatenate([[0], np.cumsum(later)])[columns.indptr]
        self._lower = columns.data[later]
        self._fronts = list(_fronts(self._blocks, ends, rows[later]))


def _fronts(blocks: Sequence[Block], ends: Indices, rows: Indices) -> Iterator[Front]:
    """Fronts of the entries in `rows`, columns between `ends`, of a lower triangle."""
    local = np.empty(len(ends) - 1, dtype=np.int64)
    borders: dict[int, Indices] = {}
    start = 0
    for number, block in enumerate(blocks):
        size = len(block.own)
        stop = start + size
        entries = slice(int(ends[start]), int(ends[stop]))
        coupled = np.zeros(len(local) - stop, dtype=bool)
        inner = [(child, borders.pop(child)) for child in block.within]
        for numbers in (rows[entries], *(border for _, border in inner)):
            coupled[numbers[numbers >= stop] - stop] = True
        border = stop + np.flatnonzero(coupled)
        outer = len(border)
        local[start:stop], local[border] = np.arange(size), size + np.arange(outer)
        columns = np.repeat(np.arange(size), np.diff(ends[start : stop + 1]))
        row = local[rows[entries]]
        rims = [local[rim] for _, rim in inner if len(rim)]
        lowest = [int(rim[0]) for rim in rims if rim[-1] >= size]
        first = min([size, *columns[row >= size][:1].tolist(), *lowest])  # columns rise
        within = tuple((child, tuple(_additions(local[rim], size, first))) for child, rim in inner)
        below = size * size + (columns - first) * outer + row - size
        yield Front(
            own=slice(start, stop),
            border=_as_slice(border),
            size=size,
            outer=outer,
            coupled=size - first,
            within=within,
            entries=entries,
            positions=np.where(row < size, columns * size + row, below),
            inherits=len(inner) == 1 and np.array_equal(inner[0][1], np.arange(start, stop)),
        )
        borders[number] = border
        start = stop


def _additions(rows: Indices, size: int, first: int) -> Iterator[Addition]:
    """Parts of the lower triangle of a complement, whose rows rise to `rows` of a front.

    Args:
        rows: rows of the front, own unknowns first.
        size: number of own unknowns.
        first: own unknown where the columns of the block below begin.

    There is one part for each pair of slices of rows; where these are many, the own unknowns and
    the border count as one each.
    """
    split = int(np.searchsorted(rows, size))
    breaks = np.union1d(np.flatnonzero(np.diff(rows) != 1) + 1, split)
    if _MIN_RUN * len(breaks) > len(rows):
        breaks = np.array([split])
    ends = pairwise([0, *breaks[(breaks > 0) & (breaks < len(rows))], len(rows)])
    runs = [(slice(start, stop), start < split) for start, stop in ends]
    in_front = [_as_slice(rows[run] - (0 if is_own else size)) for run, is_own in runs]
    below = [_as_slice(rows[run] - first) if is_own else None for run, is_own in runs]
    for number, (one, is_own) in enumerate(runs):
        for column, (other, is_column_own) in enumerate(runs[: number + 1]):
            block = 0 if is_own else 1 if is_column_own else 2
            there, beside = in_front[number], (below if block == 1 else in_front)[column]
            if isinstance(there, np.ndarray) and isinstance(beside, np.ndarray):
                there = there[:, None]
            yield Addition(block, (there, beside), (one, other))


def _as_slice(numbers: Indices) -> Places:
    if len(numbers) and numbers[-1] - numbers[0] == len(numbers) - 1:
        return slice(int(numbers[0]), int(numbers[-1]) + 1)
    return numbers


def _eliminate_fronts(
    fronts: Iterable[Front], entries: Numbers, definite: bool
) -> Iterator[_Factor]:
    """Factor of each front, in the order of elimination."""
    complements: dict[int, Numbers] = {}
    for number, front in enumerate(fronts):
        size, outer, coupled = front.size, front.outer, front.coupled
        inside = size * size
        values = np.zeros(inside + outer * coupled, dtype=entries.dtype)
        values[front.positions] = entries[front.entries]
        if front.inherits:
            values[:inside] += complements.pop(front.within[0][0]).T.ravel()
        own = values[:inside].reshape(size, size).T
        below = values[inside:].reshape(coupled, outer).T
        corner = np.zeros((outer, outer), dtype=entries.dtype, order="F")
        blocks = own, below, corner
        for inner, parts in () if front.inherits else front.within:
            complement = complements.pop(inner)
            for block, there, here in parts:
                blocks[block][there] += complement[here]
        if definite:
            factor, complements[number] = _cholesky_front(front, own, below, corner)
        else:
            factor, complements[number] = _ldl_front(front, own, below, corner)
        yield factor


def _cholesky_front(
    front: Front, own: Numbers, below: Numbers, corner: Numbers
) -> tuple[_Factor, Numbers]:
    """Cholesky factor of a front, and the lower triangle of its Schur complement."""
    lower, info = lapack.dpotrf(own, lower=1, clean=0, overwrite_a=1)
    if info:
        raise ConfigurationError(
            f"the matrix is not positive definite to rounding (row {info} of a block of "
            f"{len(own)}); conductivities or contact impedances differ by more orders of "
            "magnitude than double precision holds: bring them closer"
        )
    if front.coupled:
        # Rows of L^-1 K above the last own unknowns are zero.
        last = np.asfortranarray(lower[-front.coupled :, -front.coupled :])
        below = blas.dtrsm(1.0, last, below, side=1, lower=1, trans_a=1, overwrite_b=1)
        corner = blas.dsyrk(-1.0, below, 1.0, corner, lower=1, overwrite_c=1)
    return _Factor(front.own, lower, None, below), corner


def _ldl_front(
    front: Front, own: Numbers, below: Numbers, corner: Numbers
) -> tuple[_Factor, Numbers]:
    """Factor L D L^T of a front, and the lower triangle of its Schur complement."""
    lower, D, order = ldl(own, hermitian=False, check_finite=False)
    lower = np.asfortranarray(lower[order])
    inverse = _inverse(np.diagonal(D).copy(), np.append(np.diagonal(D, -1), 0.0))
    # Pivots mix all own unknowns.
    coupled = np.flatnonzero(order >= front.size - front.coupled)
    rows = np.zeros((front.outer, front.size), dtype=below.dtype, order="F")
    rows[:, coupled] = below[:, order[coupled] - (front.size - front.coupled)]
    if front.outer:
        trsm, syrk, syr2k = blas.get_blas_funcs(("trsm", "syrk", "syr2k"), (lower, rows))
        rows = trsm(1.0, lower, rows, side=1, lower=1, trans_a=1, diag=1, overwrite_b=1)
        if np.iscomplexobj(rows):
            scaled = _scale_rows(inverse, rows.T).T
            corner = syr2k(-0.5, rows, scaled, 1.0, corner, lower=1, overwrite_c=1)
        else:  # squares take half the operations
            squares, signs = _squares(inverse, rows)
            for sign in (-1.0, 1.0):
                part = squares[:, signs == sign]
                corner = syrk(-sign, part, 1.0, corner, lower=1, overwrite_c=1)
    return _Factor(front.own.start + order, lower, inverse, rows), corner


def _squares(inverse: tuple[Numbers, Numbers], rows: Numbers) -> tuple[Numbers, Numbers]:
    """W (n, k) and signs s (k,) of a real D, for which W diag(s) W^T is rows D^-1 rows^T."""
    diagonal, beside = inverse
    values, squares = diagonal.copy(), rows.copy(order="F")
    first = np.flatnonzero(beside)  # of the pairs of unknowns that share a 2 x 2 pivot
    if len(first):
        p, q, r = diagonal[first], beside[first], diagonal[first + 1]
        turn, spread = 0.5 * np.arctan2(q, 0.5 * (p - r)), np.hypot(0.5 * (p - r), q)
        cos, sin, one, other = np.cos(turn), np.sin(turn), rows[:, first], rows[:, first + 1]
        squares[:, first], squares[:, first + 1] = cos * one + sin * other, cos * other - sin * one
        values[first], values[first + 1] = 0.5 * (p + r) + spread, 0.5 * (p + r) - spread
    squares *= np.sqrt(np.abs(values))
    return squares, np.sign(values)


def _forward(front: Front, factor: _Factor, x: Numbers) -> tuple[Numbers, Numbers]:
    """L^-1 and D^-1 L^-1 times the rows of a front's own unknowns; its border's are updated."""
    y = _triangular(factor, x[factor.own])
    scaled = _scale_rows(factor.inverse, y)
    x[front.border] -= factor.below @ scaled[len(scaled) - factor.below.shape[1] :]
    return y, scaled


def _triangular(factor: _Factor, right: Numbers, transposed: bool = False) -> Numbers:
    """L^-1 or L^-T times rows (own, k)."""
    if factor.inverse is None:
        solved: Numbers = blas.dtrsm(1.0, factor.lower, right, lower=1, trans_a=int(transposed))
        return solved
    return np.asarray(
        solve_triangular(
            factor.lower,
            right,
            trans="T" if transposed else "N",
            lower=True,
            unit_diagonal=True,
            check_finite=False,
        )
    )


def _inverse(diagonal: Numbers, beside: Numbers) -> tuple[Numbers, Numbers]:
    """Diagonal and sub-diagonal of D^-1; raises RuntimeError for a singular D."""
    first = np.flatnonzero(beside)  # of the pairs of unknowns that share a 2 x 2 pivot
    a, b, c = diagonal[first], beside[first], diagonal[first + 1]
    determinant = a * c - b**2
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = 1.0 / diagonal
        inverse[first], inverse[first + 1] = c / determinant, a / determinant
        beside[first] = -b / determinant
    if not (np.all(np.isfinite(inverse)) and np.all(np.isfinite(beside))):
        raise RuntimeError("the matrix is singular")
    return inverse, beside


def _negative(inverse: tuple[Numbers, Numbers]) -> int:
    """Number of negative eigenvalues of a real D, from D^-1."""
    diagonal, beside = inverse
    first = np.flatnonzero(beside)
    single = np.ones(len(diagonal), dtype=bool)
    single[first] = single[first + 1] = False
    indefinite = diagonal[first] * diagonal[first + 1] < beside[first] ** 2
    pairs = np.where(indefinite, 1, np.where(diagonal[first] < 0.0, 2, 0))
    return int(np.count_nonzero(diagonal[single] < 0.0) + pairs.sum())


def _scale_rows(inverse: tuple[Numbers, Numbers] | None, rows: Numbers) -> Numbers:
    """D^-1 times rows (n, k); the rows themselves where D is one."""
    if inverse is None:
        return rows
    diagonal, beside = (each[:, None] for each in inverse)
    product: Numbers = diagonal * rows
    first = np.flatnonzero(inverse[1])
    product[first] += beside[first] * rows[first + 1]
    product[first + 1] += beside[first] * rows[first]
    return product
