"""Sparse LU factorisation of symmetric matrices, real or complex, by SuperLU."""

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array
from scipy.sparse.linalg import splu

Numbers = NDArray[np.inexact]
Indices = NDArray[np.int64]


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
