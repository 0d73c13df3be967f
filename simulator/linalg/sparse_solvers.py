"""Solvers for the forward model: sparse LU, and the choice between sparse LU and block Cholesky.

A solver is made from the positions of the matrix entries. `factorise(values)` gives a
factorisation with `solve(B) = A^-1 B`; `congruence(values, B) = B^T A^-1 B`, all that impedances
need, keeps no factors and is cheaper. Matrices are real and positive definite, or complex and
symmetric with a positive definite real part, as with complex contact impedances.
"""

from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array
from scipy.sparse.linalg import splu

from eitskin.errors import ConfigurationError
from eitskin.simulator.linalg.block_cholesky import BlockCholesky, level_structure

Numbers = NDArray[np.inexact]
Indices = NDArray[np.int64]
SolverName = Literal["block Cholesky", "sparse LU"]


class Factorisation(Protocol):
    """A factorised symmetric matrix A."""

    def solve(self, B: Numbers) -> Numbers:
        """A^-1 B, (n, k)."""
        ...


class Solver(Protocol):
    """Solver for matrices whose lower triangle has a fixed sparsity pattern."""

    @property
    def name(self) -> str:
        """Name of the method, for people."""
        ...

    def factorise(self, values: Numbers) -> Factorisation:
        """Factorise the matrix with these values; values of equal position add up."""
        ...

    def congruence(self, values: Numbers, B: Numbers) -> Numbers:
        """B^T A^-1 B, (k, k), for the matrix A with these values."""
        ...


# Sum of the cubed block sizes per matrix entry at which dense blocks and sparse LU take equally
# long: below 5.7e3 blocks were faster, above 7.6e3 slower, on meshes of hexahedra and prisms with
# 3,000 to 37,000 unknowns.
_BLOCK_WORK = 7e3


def choose_solver(
    name: SolverName | None,
    rows: Indices,
    columns: Indices,
    numbers: Indices,
    first: Indices,
) -> Solver:
    """The solver called `name`, or the one that suits the shape of the body.

    Long, thin bodies have small diagonal blocks: block Cholesky then beats a sparse factorisation.
    Compact bodies with many unknowns go to sparse LU. Raises ConfigurationError for another name.

    Args:
        name: "block Cholesky", "sparse LU" or None.
        rows, columns: positions of the matrix values.
        numbers: unknowns of each element, (elements, functions).
        first: elements at one end of the body, where the first strip begins.
    """
    n = int(numbers.max()) + 1
    if name not in (None, "block Cholesky", "sparse LU"):
        raise ConfigurationError(
            f"solver must be 'block Cholesky', 'sparse LU' or None, got {name!r}"
        )
    if name == "sparse LU":
        return SparseDirect(rows, columns, n)
    level = level_structure(numbers, first)
    work = float((np.bincount(level).astype(float) ** 3).sum())
    if name is None and work > _BLOCK_WORK * len(rows):
        return SparseDirect(rows, columns, n)
    return BlockCholesky(rows, columns, level)


class SparseDirect:
    """Sparse LU factorisation (SuperLU) for any mesh, ordered once by minimum degree."""

    name = "sparse LU"

    def __init__(self, rows: Indices, columns: Indices, n: int) -> None:
        """Prepare for entries at (rows >= columns) of an n x n matrix."""
        self._n = n
        self._off = rows != columns
        self._rows = np.concatenate([rows, columns[self._off]])
        self._columns = np.concatenate([columns, rows[self._off]])
        self._order: Indices | None = None

    def factorise(self, values: Numbers) -> "SparseFactors":
        """Factorise the matrix with these values; the first call also finds the order."""
        both = np.concatenate([values, values[self._off]])
        shape = (self._n, self._n)
        if self._order is None:
            whole = csc_array((both, (self._rows, self._columns)), shape=shape)
            found = SparseFactors(whole, np.arange(self._n), "MMD_AT_PLUS_A")
            self._order = found.order
            rank = np.argsort(self._order)
            self._rows, self._columns = rank[self._rows], rank[self._columns]
            return found
        whole = csc_array((both, (self._rows, self._columns)), shape=shape)
        return SparseFactors(whole, self._order, "NATURAL")

    def congruence(self, values: Numbers, B: Numbers) -> Numbers:
        """B^T A^-1 B, (k, k)."""
        product: Numbers = B.T @ self.factorise(values).solve(B)
        return product


class SparseFactors:
    """Sparse LU factors of one matrix, its unknowns permuted to `order`."""

    def __init__(self, matrix: csc_array, order: Indices, ordering: str) -> None:
        """Factorise with diagonal pivots, which keep the permutation symmetric."""
        options = {"SymmetricMode": True}
        self._lu = splu(matrix, permc_spec=ordering, diag_pivot_thresh=0.0, options=options)
        self._order = order

    @property
    def order(self) -> Indices:
        """Unknowns in the order of their elimination, (n,)."""
        return np.argsort(self._lu.perm_c)

    def solve(self, B: Numbers) -> Numbers:
        """A^-1 B, (n, k)."""
        solution = np.empty(B.shape, dtype=np.result_type(B, self._lu.U.dtype))
        right = B[self._order]
        if np.iscomplexobj(solution) and not np.iscomplexobj(right):
            right = right.astype(complex)
        solution[self._order] = self._lu.solve(right)
        return solution
