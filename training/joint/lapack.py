"""Factorisations of small positive definite matrices, by LAPACK directly.

`numpy.linalg` checks, copies and sets error states at every call. For matrices as small as the
covariance of one frame, these take several times as long as the factorisation.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack

Array = NDArray[np.float64]


def whitening(covariance: Array) -> Array:
    """Whitening matrix L^-1 (n, n), lower triangular, of a covariance L L^T (n, n).

    Raises LinAlgError where the matrix is not positive definite.
    """
    lower, failed = lapack.dpotrf(covariance.T, lower=1)
    if failed:
        raise np.linalg.LinAlgError(
            f"expected a positive definite covariance, got one whose minor {failed} is not positive"
        )
    inverse: Array = lapack.dtrtri(lower, lower=1, overwrite_c=1)[0]
    return inverse


def solve(matrix: Array, right: Array) -> Array:
    """Solution x of A x = b for a positive definite A (n, n) and b (n,) or (n, m).

    Raises LinAlgError where the matrix is not positive definite.
    """
    x: Array
    _, x, failed = lapack.dposv(matrix.T, right, lower=1)
    if failed:
        raise np.linalg.LinAlgError(
            f"expected a positive definite matrix, got one whose minor {failed} is not positive"
        )
    return x


def inverse(matrix: Array) -> Array:
    """Inverse (n, n) of a positive definite matrix."""
    root = whitening(matrix)
    product: Array = root.T @ root
    return product


def orthonormal(columns: Array) -> Array:
    """Orthonormal basis (n, min(n, m)) of the span of m columns (n, m)."""
    factors, tau, _, _ = lapack.dgeqrf(columns)
    basis: Array = lapack.dorgqr(factors[:, : len(tau)], tau)[0]
    return basis
