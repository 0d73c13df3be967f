"""Compiled loops over element matrices; the plain twin is in `assembly`."""

import math

import numpy as np
from numpy.typing import NDArray

from eitskin.compiled import kernel

Array = NDArray[np.float64]


@kernel("boolean(f8[:,::1], i8, i8, f8[:,:,::1])")
def condense(matrices: Array, outer: int, inner: int, own: Array) -> bool:
    """Static condensation of element matrices to symmetric ones, `own` (elements, outer, outer).

    Matrices have the lower triangle of the outer functions, the rows of the inner ones by the
    outer ones, and those by each other. False where a matrix is not positive definite.
    """
    pairs = outer * (outer + 1) // 2
    L, J = np.empty((inner, inner)), np.empty((inner, outer))
    for e in range(len(matrices)):
        row = matrices[e]
        within = pairs + inner * outer
        for a in range(inner):
            for b in range(a + 1):
                s = row[within + a * inner + b]
                for k in range(b):
                    s -= L[a, k] * L[b, k]
                if a == b:
                    if not s > 0.0:
                        return False
                    L[a, a] = math.sqrt(s)
                else:
                    L[a, b] = s / L[b, b]
        for a in range(inner):
            for o in range(outer):
                J[a, o] = row[pairs + a * outer + o]
            for k in range(a):
                f = L[a, k]
                for o in range(outer):
                    J[a, o] -= f * J[k, o]
            f = 1.0 / L[a, a]
            for o in range(outer):
                J[a, o] *= f
        p, whole = 0, own[e]
        for i in range(outer):
            for j in range(i + 1):
                whole[i, j] = row[p + j]
            for k in range(inner):
                f = J[k, i]
                for j in range(i + 1):
                    whole[i, j] -= f * J[k, j]
            for j in range(i):
                whole[j, i] = whole[i, j]
            p += i + 1
    return True
