"""Compiled sums of fields and dents over columns of points; plain twins: `field`, `dents`."""

import math

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


@kernel(
    "void(UniTuple(f8, 4), UniTuple(f8, 2), f8[::1], f8[::1], "
    "f8[:,:,::1], f8[:,::1], f8, f8[::1], f8[::1], f8[:,:,::1])"
)
def add_field(
    frame: tuple[float, float, float, float],
    half: tuple[float, float],
    tx: Array,
    ty: Array,
    coefficients: Array,
    levels: Array,
    rate: float,
    x: Array,
    y: Array,
    moved: Array,
) -> None:
    """Set displacements and their derivatives by x, y, z at columns, `moved` (12, h, n).

    Args:
        frame: x, y [m], cosine and sine of the angle of the field's frame.
        half: half the length and width of the field's box [m].
        tx, ty: knots of the splines.
        coefficients: of the powers 0 to 3 of the level, of three components, (nx, ny, 12).
        levels: of the points of each column, from -1 to 1 over the height, (n, h).
        rate: of the level by the height [1/m].
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
        for q in range(levels.shape[1]):
            z = levels[n, q]
            for k in range(3):
                s0, s1, s2, s3 = sums[0, k], sums[0, 3 + k], sums[0, 6 + k], sums[0, 9 + k]
                u[k] = s0 + z * (s1 + z * (s2 + z * s3))
                slope[k, 2] = rate * (s1 + z * (2.0 * s2 + 3.0 * z * s3))
                for d in range(2):
                    upper = sums[1 + d, 6 + k] + z * sums[1 + d, 9 + k]
                    slope[k, d] = sums[1 + d, k] + z * (sums[1 + d, 3 + k] + z * upper)
            moved[0, q, n] = c * u[0] - s * u[1]
            moved[1, q, n] = s * u[0] + c * u[1]
            moved[2, q, n] = u[2]
            # The gradient Q G Q^T: rows turned first, then columns.
            for k in range(3):
                one, other = slope[0, k], slope[1, k]
                slope[0, k], slope[1, k] = c * one - s * other, s * one + c * other
            for k in range(3):
                one, other = slope[k, 0], slope[k, 1]
                moved[3 + 3 * k, q, n] = c * one - s * other
                moved[4 + 3 * k, q, n] = s * one + c * other
                moved[5 + 3 * k, q, n] = slope[k, 2]


@kernel("void(UniTuple(f8, 2), f8[::1], f8[::1], f8[::1], f8[:,:,::1], f8, f8[:,:,::1])")
def add_dent(
    place: tuple[float, float],
    x: Array,
    y: Array,
    knots: Array,
    pieces: Array,
    least: float,
    moved: Array,
) -> None:
    """Add the displacement of a dent and its derivatives, at columns of h points, to `moved`.

    Args:
        place: of the axis, x and y [m].
        x, y: of the columns, (n,) [m].
        knots: of the piecewise cubics in r, (m + 1,) [m].
        pieces: coefficients of u, w, du/dz, dw/dz, du/dr, dw/dr at h heights, highest power
            first, (m, 4, 6 h).
        least: distance to which points on the axis are moved aside [m].
        moved: displacement and derivatives by x, y, z, (12, h, n).
    """
    h = moved.shape[1]
    reach, last = knots[-1], len(knots) - 2
    motion = np.empty(6 * h)
    piece = 0
    for n in range(len(x)):
        dx, dy = x[n] - place[0], y[n] - place[1]
        r = math.sqrt(dx * dx + dy * dy)
        if r >= reach:
            continue
        if r < least:
            dx, dy, r = least, 0.0, least
        while piece < last and r >= knots[piece + 1]:
            piece += 1
        while piece > 0 and r < knots[piece]:
            piece -= 1
        s = r - knots[piece]
        c3, c2, c1, c0 = pieces[piece]
        for m in range(6 * h):
            motion[m] = ((c3[m] * s + c2[m]) * s + c1[m]) * s + c0[m]
        c, s = dx / r, dy / r
        cc, ss, cs = c * c, s * s, c * s
        for q in range(h):
            u, w, u_z = motion[q], motion[h + q], motion[2 * h + q]
            w_z, u_r, w_r = motion[3 * h + q], motion[4 * h + q], motion[5 * h + q]
            moved[0, q, n] += c * u
            moved[1, q, n] += s * u
            moved[2, q, n] += w
            moved[3, q, n] += cc * u_r + ss * (u / r)
            moved[7, q, n] += ss * u_r + cc * (u / r)
            across = cs * (u_r - u / r)
            moved[4, q, n] += across
            moved[6, q, n] += across
            moved[5, q, n] += c * u_z
            moved[8, q, n] += s * u_z
            moved[9, q, n] += c * w_r
            moved[10, q, n] += s * w_r
            moved[11, q, n] += w_z
