"""Compiled sums of turned spline fields over columns; the plain twin is in `turned_field`."""

import numpy as np
from numpy.typing import NDArray

from eitskin.compiled import kernel
from eitskin.simulator.mechanics.spline_kernels import functions

Array = NDArray[np.float64]


@kernel
def move(
    frame: tuple[float, float, float, float],
    half: tuple[float, float],
    tx: Array,
    ty: Array,
    coefficients: Array,
    heights: Array,
    rates: Array,
    x: Array,
    y: Array,
    moved: Array,
) -> None:
    """Set displacements and their derivatives by x, y, z at columns, `moved` (12, h, n).

    Args:
        frame: x, y [m], cosine and sine of the angle of the field's frame.
        half: half the length and width of the field's box [m].
        tx, ty: knots of the splines.
        coefficients: (nx, ny, nz, 3 or more).
        heights, rates: polynomials at the heights of the columns, and their derivatives, (h, nz).
        x, y: of the columns, (n,) [m].
        moved: zeros.
    """
    nz, h = coefficients.shape[2], len(heights)
    a, da, b, db = np.empty(4), np.empty(4), np.empty(4), np.empty(4)
    sums = np.empty((3, nz, 3))
    slope = np.empty((3, 3))
    u = np.empty(3)
    ox, oy, c, s = frame
    i, j = 3, 3
    for n in range(len(x)):
        dx, dy = x[n] - ox, y[n] - oy
        at_x, at_y = c * dx + s * dy, c * dy - s * dx
        if abs(at_x) >= half[0] or abs(at_y) >= half[1]:
            continue
        i = functions(tx, at_x, i, a, da)
        j = functions(ty, at_y, j, b, db)
        sums[:] = 0.0
        for p in range(4):
            for q in range(4):
                value, by_x, by_y = a[p] * b[q], da[p] * b[q], a[p] * db[q]
                part = coefficients[i - 3 + p, j - 3 + q]
                for m in range(nz):
                    for k in range(3):
                        sums[0, m, k] += value * part[m, k]
                        sums[1, m, k] += by_x * part[m, k]
                        sums[2, m, k] += by_y * part[m, k]
        for level in range(h):
            for k in range(3):
                u[k] = 0.0
                slope[k] = 0.0
                for m in range(nz):
                    u[k] += heights[level, m] * sums[0, m, k]
                    slope[k, 0] += heights[level, m] * sums[1, m, k]
                    slope[k, 1] += heights[level, m] * sums[2, m, k]
                    slope[k, 2] += rates[level, m] * sums[0, m, k]
            moved[0, level, n] = c * u[0] - s * u[1]
            moved[1, level, n] = s * u[0] + c * u[1]
            moved[2, level, n] = u[2]
            # The gradient Q G Q^T: rows turned first, then columns.
            for k in range(3):
                one, other = slope[0, k], slope[1, k]
                slope[0, k], slope[1, k] = c * one - s * other, s * one + c * other
            for k in range(3):
                one, other = slope[k, 0], slope[k, 1]
                moved[3 + 3 * k, level, n] = c * one - s * other
                moved[4 + 3 * k, level, n] = s * one + c * other
                moved[5 + 3 * k, level, n] = slope[k, 2]
