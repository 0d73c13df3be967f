"""Compiled sums of dents over columns of points; the plain twin is in `dents`."""

import math

import numpy as np
from numpy.typing import NDArray

from eitskin.compiled import kernel

Array = NDArray[np.float64]


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
