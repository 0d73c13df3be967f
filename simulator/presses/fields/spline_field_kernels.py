"""Compiled spline fields at columns of points; plain twins: `spline_field`, `turned_field`."""

import numpy as np
from numpy.typing import NDArray

from eitskin.compiled import kernel
from eitskin.simulator.mechanics.spline_kernels import functions

Array = NDArray[np.float64]


@kernel(
    "void(UniTuple(f8, 4), UniTuple(f8, 2), f8[::1], f8[::1], "
    "f8[:,:,::1], f8[:,::1], f8[:,::1], f8[::1], f8[::1], f8[:,:,::1])"
)
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
        coefficients: of four polynomials over the height of the displacement, (nx, ny, 12).
        heights, rates: polynomials at the heights of the columns, and their derivatives, (h, 4).
        x, y: of the columns, (n,) [m].
        moved: zeros.
    """
    a, da, b, db = np.empty(4), np.empty(4), np.empty(4), np.empty(4)
    sums, slope, u = np.empty((3, 12)), np.empty((3, 3)), np.empty(3)
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
            row = coefficients[i - 3 + p, j - 3 : j + 1]
            for m in range(12):  # a fixed number of turns takes half the time of any number
                c0, c1, c2, c3 = row[0, m], row[1, m], row[2, m], row[3, m]
                value = b[0] * c0 + b[1] * c1 + b[2] * c2 + b[3] * c3
                by_y = db[0] * c0 + db[1] * c1 + db[2] * c2 + db[3] * c3
                sums[0, m] += a[p] * value
                sums[1, m] += da[p] * value
                sums[2, m] += a[p] * by_y
        for level in range(len(heights)):
            up, rate = heights[level], rates[level]
            for k in range(3):
                u[k] = slope[k, 0] = slope[k, 1] = slope[k, 2] = 0.0
                for m in range(4):
                    u[k] += up[m] * sums[0, 3 * m + k]
                    slope[k, 0] += up[m] * sums[1, 3 * m + k]
                    slope[k, 1] += up[m] * sums[2, 3 * m + k]
                    slope[k, 2] += rate[m] * sums[0, 3 * m + k]
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
