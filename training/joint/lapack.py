"""Covariances of one frame, by LAPACK at once.

`numpy.linalg` checks, copies and sets error states at every call. For matrices as small as a
frame's, that takes several times as long as the work itself.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack

Array = NDArray[np.float64]


def whitening(covariance: Array) -> Array:
    """L^-1, lower triangular, of a covariance L L^T (n, n); LinAlgError where it is none."""
    lower, failed = lapack.dpotrf(covariance.T, lower=1)
    if failed:
        raise np.linalg.LinAlgError(f"minor {failed} of the covariance is not positive")
    inverse: Array = lapack.dtrtri(lower, lower=1, overwrite_c=1)[0]
    return inverse


def solved(matrix: Array, right: Array) -> Array:
    """x of A x = b, where A (n, n) is positive definite; b is (n,) or (n, m)."""
    x: Array
    _, x, failed = lapack.dposv(matrix.T, right, lower=1)
    if failed:
        raise np.linalg.LinAlgError(f"minor {failed} of the matrix is not positive")
    return x


def inverse(matrix: Array) -> Array:
    """A^-1 of a positive definite A (n, n)."""
    root = whitening(matrix)
    product: Array = root.T @ root
    return product


def orthonormal(columns: Array) -> Array:
    """An orthonormal basis (n, min(n, m)) of what m columns (n, m) span."""
    factors, tau, _, _ = lapack.dgeqrf(columns)
    basis: Array = lapack.dorgqr(factors[:, : len(tau)], tau)[0]
    return basis
