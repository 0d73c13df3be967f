"""Products of a matrix with vectors, element by element, without assembling the matrix."""

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


class ElementProducts:
    """Matrices that are sums of element matrices on one mesh."""

    def __init__(self, numbers: Indices, unknowns: int) -> None:
        """Prepare for elements with the unknowns `numbers`, (elements, functions)."""
        self._numbers = numbers
        ends = np.arange(numbers.size + 1)
        ones = np.ones(numbers.size)
        self._gathered = csr_array(
            (ones, numbers.ravel(), ends), (numbers.size, unknowns)
        ).T.tocsr()

    def product(self, matrices: Array, vectors: Array) -> Array:
        """Sum of matrices (elements, functions, functions) times vectors, (unknowns, k) both."""
        each = matrices @ vectors[self._numbers]
        return np.asarray(self._gathered @ each.reshape(-1, vectors.shape[1]))
