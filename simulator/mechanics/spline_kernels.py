"""Compiled sums of cubic splines in the plane; the plain twin is in `cubic_splines`."""

import numpy as np
from numpy.typing import NDArray

from eitskin.compiled import kernel

Array = NDArray[np.float64]


@kernel("i8(f8[::1], f8, i8, f8[::1], f8[::1])")
def functions(t: Array, x: float, cell: int, values: Array, slopes: Array) -> int:
    """Number of the first of four splines at x, after the cell that was found last.

    Sets the values and the slopes of the four; `t` are the knots.
    """
    last = len(t) - 5
    while cell < last and x >= t[cell + 1]:
        cell += 1
    while cell > 3 and x < t[cell]:
        cell -= 1
    r1, r2, r3 = t[cell + 1] - x, t[cell + 2] - x, t[cell + 3] - x
    l1, l2, l3 = x - t[cell], x - t[cell - 1], x - t[cell - 2]
    p = 1.0 / (r1 + l1)
    a, b = r1 * p, l1 * p
    p, q = a / (r1 + l2), b / (r2 + l1)
    a, b, c = r1 * p, l2 * p + r2 * q, l1 * q
    p, q, s = a / (r1 + l3), b / (r2 + l2), c / (r3 + l1)
    values[0], values[1] = r1 * p, l3 * p + r2 * q
    values[2], values[3] = l2 * q + r3 * s, l1 * s
    slopes[0], slopes[1] = -3.0 * p, 3.0 * (p - q)
    slopes[2], slopes[3] = 3.0 * (q - s), 3.0 * s
    return cell


@kernel("void(f8[::1], f8[::1], f8[:,:,::1], f8[:,::1], f8[:,:,::1])")
def sums(tx: Array, ty: Array, coefficients: Array, points: Array, found: Array) -> None:
    """Sums of products of splines and their slopes by x and y, `found` (n, 3, k).

    Coefficients are (nx, ny, k), points (n, 2), tx and ty the knots.
    """
    k = coefficients.shape[2]
    a, da, b, db = np.empty(4), np.empty(4), np.empty(4), np.empty(4)
    value, slope = np.empty(k), np.empty(k)
    i, j = 3, 3
    for n in range(len(points)):
        i = functions(tx, points[n, 0], i, a, da)
        j = functions(ty, points[n, 1], j, b, db)
        for m in range(k):
            found[n, 0, m] = 0.0
            found[n, 1, m] = 0.0
            found[n, 2, m] = 0.0
        for p in range(4):
            for m in range(k):
                value[m] = 0.0
                slope[m] = 0.0
            for q in range(4):
                c = coefficients[i - 3 + p, j - 3 + q]
                for m in range(k):
                    value[m] += b[q] * c[m]
                    slope[m] += db[q] * c[m]
            for m in range(k):
                found[n, 0, m] += a[p] * value[m]
                found[n, 1, m] += da[p] * value[m]
                found[n, 2, m] += a[p] * slope[m]


@kernel("void(f8[::1], f8[::1], f8[:,:,::1], f8[:,::1], f8, f8[:,:,::1])")
def gradients(
    tx: Array, ty: Array, coefficients: Array, points: Array, scale: float, found: Array
) -> None:
    """Derivatives (n, 3, 3) of three fields by x, y, z, quadratic along z, at points (n, 3).

    Coefficients are (nx, ny, 9): of the powers 0 to 2 of `scale` z, each of the three fields.
    """
    a, da, b, db = np.empty(4), np.empty(4), np.empty(4), np.empty(4)
    sums = np.empty((3, 9))
    i, j = 3, 3
    for n in range(len(points)):
        i = functions(tx, points[n, 0], i, a, da)
        j = functions(ty, points[n, 1], j, b, db)
        sums[:] = 0.0
        for p in range(4):
            row = coefficients[i - 3 + p, j - 3 : j + 1]
            for m in range(9):  # a fixed number of turns takes half the time of any number
                c0, c1, c2, c3 = row[0, m], row[1, m], row[2, m], row[3, m]
                value = b[0] * c0 + b[1] * c1 + b[2] * c2 + b[3] * c3
                slope = db[0] * c0 + db[1] * c1 + db[2] * c2 + db[3] * c3
                sums[0, m] += a[p] * value
                sums[1, m] += da[p] * value
                sums[2, m] += a[p] * slope
        z = scale * points[n, 2]
        for k in range(3):
            found[n, k, 0] = sums[1, k] + z * (sums[1, 3 + k] + z * sums[1, 6 + k])
            found[n, k, 1] = sums[2, k] + z * (sums[2, 3 + k] + z * sums[2, 6 + k])
            found[n, k, 2] = scale * (sums[0, 3 + k] + 2.0 * z * sums[0, 6 + k])
