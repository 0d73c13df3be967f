"""Products of a matrix with vectors, element by element, without assembling the matrix."""

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


class ElementProducts:
    """Matrices that are sums of symmetric element matrices on one mesh.

    Element matrices are given by their lower triangles, row by row.
    """

    def __init__(self, numbers: Indices, unknowns: int) -> None:
        """Prepare for elements with the unknowns `numbers`, (elements, functions)."""
        self._numbers = numbers
        functions = numbers.shape[1]
        i, j = np.tril_indices(functions)
        whole = np.empty((functions, functions), dtype=np.int64)
        whole[i, j] = whole[j, i] = np.arange(len(i))
        self._whole = whole.ravel()
        ends = np.arange(numbers.size + 1)
        ones = np.ones(numbers.size)
        self._gathered = csr_array(
            (ones, numbers.ravel(), ends), (numbers.size, unknowns)
        ).T.tocsr()

    def whole(self, values: Array) -> Array:
        """Element matrices (elements, functions, functions) from lower triangles, flattened."""
        functions = self._numbers.shape[1]
        lower = values.reshape(len(self._numbers), -1)
        # Indexing would leave the elements last in memory, which slows products down.
        return np.take(lower, self._whole, axis=1).reshape(-1, functions, functions)

    def product(self, whole: Array, vectors: Array) -> Array:
        """Sum of element matrices times vectors (unknowns, k), (unknowns, k)."""
        each = whole @ vectors[self._numbers]
        return np.asarray(self._gathered @ each.reshape(-1, vectors.shape[1]))
