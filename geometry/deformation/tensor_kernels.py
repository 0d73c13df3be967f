"""Compiled loops over deformation gradients; plain twins are in `kinematics`."""

import numpy as np
from numpy.typing import NDArray

from eitskin.compiled import kernel

Array = NDArray[np.float64]


@kernel("f8[:,:,::1](f8[:,:,::1], f8[:,:,::1])")
def products(second: Array, first: Array) -> Array:
    """Products of gradients, (n, 3, 3)."""
    found = np.empty((len(first), 3, 3))
    for n in range(len(first)):
        for i in range(3):
            a, b, c = second[n, i, 0], second[n, i, 1], second[n, i, 2]
            for j in range(3):
                found[n, i, j] = a * first[n, 0, j] + b * first[n, 1, j] + c * first[n, 2, j]
    return found


@kernel("i8(f8[:,:,::1], f8[:,::1])")
def pull_back(F: Array, entries: Array) -> int:
    """Number of F, (n, 3, 3), whose J is not positive; sets `entries` of J F^-1 F^-T, (n, 6).

    Entries are xx, yy, zz, xy, xz and yz.
    """
    negative = 0
    for n in range(len(F)):
        a, b, c = F[n, 0, 0], F[n, 0, 1], F[n, 0, 2]
        d, e, f = F[n, 1, 0], F[n, 1, 1], F[n, 1, 2]
        g, h, k = F[n, 2, 0], F[n, 2, 1], F[n, 2, 2]
        # Cofactors: entry (i, J) belongs to row i of F and column J.
        a_, d_, g_ = e * k - f * h, c * h - b * k, b * f - c * e
        b_, e_, h_ = f * g - d * k, a * k - c * g, c * d - a * f
        c_, f_, k_ = d * h - e * g, b * g - a * h, a * e - b * d
        J = a * a_ + d * d_ + g * g_
        if not J > 0.0:
            negative += 1
        inverse = 1.0 / J
        entries[n, 0] = (a_ * a_ + d_ * d_ + g_ * g_) * inverse
        entries[n, 1] = (b_ * b_ + e_ * e_ + h_ * h_) * inverse
        entries[n, 2] = (c_ * c_ + f_ * f_ + k_ * k_) * inverse
        entries[n, 3] = (a_ * b_ + d_ * e_ + g_ * h_) * inverse
        entries[n, 4] = (a_ * c_ + d_ * f_ + g_ * k_) * inverse
        entries[n, 5] = (b_ * c_ + e_ * f_ + h_ * k_) * inverse
    return negative
