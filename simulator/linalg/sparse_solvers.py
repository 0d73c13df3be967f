"""Symmetric solvers: factorise once, solve many.

A solver is made from the places of the matrix values. `factorise(values)` gives a factorisation,
which answers `solve(B) = A^-1 B`; `congruence(values, B) = B^T A^-1 B`, all that impedances need,
keeps no factors and is cheaper. Matrices are real and positive definite, or complex and symmetric
with a positive definite real part, as complex contact impedances make them.
"""

from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array
from scipy.sparse.linalg import splu

from eitskin.errors import ConfigurationError
from eitskin.simulator.linalg.block_cholesky import BlockCholesky, levels

Numbers = NDArray[np.inexact]
Indices = NDArray[np.int64]
SolverName = Literal["block Cholesky", "sparse LU"]


class Factorisation(Protocol):
    """A factorised symmetric matrix A."""

    def solve(self, B: Numbers) -> Numbers:
        """A^-1 B, (n, k)."""
        ...


class Solver(Protocol):
    """Factorises matrices whose lower-triangle values stand at fixed places."""

    @property
    def name(self) -> str:
        """Name of the method, for people."""
        ...

    def factorise(self, values: Numbers) -> Factorisation:
        """Factorise the matrix with these values; values of equal place add up."""
        ...

    def congruence(self, values: Numbers, B: Numbers) -> Numbers:
        """B^T A^-1 B, (k, k), of the matrix with these values."""
        ...


# Cubes of the block sizes per matrix value at which dense blocks and sparse LU take as long: below
# 5.7e3 blocks were faster, above 7.6e3 slower, on hexahedra and prisms of 3,000 to 37,000 unknowns.
_BLOCK_WORK = 7e3


def choose_solver(
    name: SolverName | None,
    rows: Indices,
    columns: Indices,
    numbers: Indices,
    first: Indices,
) -> Solver:
    """The solver called `name`, or the one that suits the shape.

    Long thin bodies have short fronts: dense blocks then beat a sparse factorisation. Compact
    ones with many unknowns go to sparse LU.

    Args:
        name: "block Cholesky", "sparse LU" or None.
        rows, columns: places of the matrix values.
        numbers: unknowns of each element, (elements, functions).
        first: elements at one end of the body, where the first block begins.
    """
    n = int(numbers.max()) + 1
    if name not in (None, "block Cholesky", "sparse LU"):
        raise ConfigurationError(
            f"solver must be 'block Cholesky', 'sparse LU' or None, got {name!r}"
        )
    if name == "sparse LU":
        return SparseDirect(rows, columns, n)
    level = levels(numbers, first)
    work = float((np.bincount(level).astype(float) ** 3).sum())
    if name is None and work > _BLOCK_WORK * len(rows):
        return SparseDirect(rows, columns, n)
    return BlockCholesky(rows, columns, level)


class SparseDirect:
    """Sparse LU of any mesh (SuperLU), ordered once by minimum degree."""

    name = "sparse LU"

    def __init__(self, rows: Indices, columns: Indices, n: int) -> None:
        """Prepare for values at (rows >= columns) of an n x n matrix."""
        self._n = n
        self._off = rows != columns
        self._rows = np.concatenate([rows, columns[self._off]])
        self._columns = np.concatenate([columns, rows[self._off]])
        self._order: Indices | None = None

    def factorise(self, values: Numbers) -> "SparseFactors":
        """Factorise the matrix with these values; the first time also finds the order."""
        every = np.concatenate([values, values[self._off]])
        shape = (self._n, self._n)
        if self._order is None:
            whole = csc_array((every, (self._rows, self._columns)), shape=shape)
            found = SparseFactors(whole, np.arange(self._n), "MMD_AT_PLUS_A")
            self._order = found.order
            rank = np.argsort(self._order)
            self._rows, self._columns = rank[self._rows], rank[self._columns]
            return found
        whole = csc_array((every, (self._rows, self._columns)), shape=shape)
        return SparseFactors(whole, self._order, "NATURAL")

    def congruence(self, values: Numbers, B: Numbers) -> Numbers:
        """B^T A^-1 B, (k, k)."""
        product: Numbers = B.T @ self.factorise(values).solve(B)
        return product


class SparseFactors:
    """The sparse LU factors of one matrix, whose unknowns stand in `order`."""

    def __init__(self, matrix: csc_array, order: Indices, ordering: str) -> None:
        """Factorise with diagonal pivots, which keeps the matrix symmetric."""
        options = {"SymmetricMode": True}
        self._lu = splu(matrix, permc_spec=ordering, diag_pivot_thresh=0.0, options=options)
        self._order = order

    @property
    def order(self) -> Indices:
        """The order of elimination."""
        return np.argsort(self._lu.perm_c)

    def solve(self, B: Numbers) -> Numbers:
        """A^-1 B, (n, k)."""
        solution = np.empty(B.shape, dtype=np.result_type(B, self._lu.U.dtype))
        right = B[self._order]
        if np.iscomplexobj(solution) and not np.iscomplexobj(right):
            right = right.astype(complex)
        solution[self._order] = self._lu.solve(right)
        return solution
