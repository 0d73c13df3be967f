"""Compiled motion of points; plain twins: `field`, `dents`, `bend_table`, `kinematics`.

Where points (n, 3) follow each other in vertical columns, what depends on x and y alone is found
once for a column. Deformed places (n, 3) and gradients F (n, 9), by rows, are added to.
"""

import math

import numpy as np
from numpy.typing import NDArray

from eitskin.compiled import kernel

Array = NDArray[np.float64]


@kernel("i8(f8[::1], f8, i8, f8[::1])")
def functions(t: Array, x: float, cell: int, values: Array) -> int:
    """Number of the cell of x among the knots `t`, after the cell that was found last.

    Sets the values of its four splines, and after these their slopes, (8,).
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
    values[4], values[5] = -3.0 * p, 3.0 * (p - q)
    values[6], values[7] = 3.0 * (q - s), 3.0 * s
    return cell


@kernel("i8(f8[::1], f8[::1], f8[:,:,::1], i8, i8, f8, f8, f8[:,::1], f8[:,::1])")
def sum_field_powers(
    tx: Array,
    ty: Array,
    coefficients: Array,
    i: int,
    j: int,
    x: float,
    y: float,
    values: Array,
    sums: Array,
) -> int:
    """Sums at (x, y) of a field and its slopes by x and y, (3, 12), of powers of the level.

    Powers it has not stay. Returns the cell along x and y as one number; `values` (2, 8) is room.
    """
    a, b = values[0], values[1]
    i, j = functions(tx, x, i, a), functions(ty, y, j, b)
    for m in range(coefficients.shape[2]):
        sum_0 = sum_x = sum_y = 0.0
        for p in range(4):  # fixed numbers of turns take half the time of any number
            value = by_y = 0.0
            for q in range(4):
                c = coefficients[i - 3 + p, j - 3 + q, m]
                value += b[q] * c
                by_y += b[4 + q] * c
            sum_0 += a[p] * value
            sum_x += a[4 + p] * value
            sum_y += a[p] * by_y
        sums[0, m], sums[1, m], sums[2, m] = sum_0, sum_x, sum_y
    return i * 65536 + j


@kernel("void(f8[:,::1], f8, f8, f8[::1], f8[:,::1])")
def evaluate_level(sums: Array, z: float, rate: float, u: Array, slope: Array) -> None:
    """Set displacement u (3,) and slopes (3, 3) at a level z that grows with the height by rate."""
    for k in range(3):
        s0, s1, s2, s3 = sums[0, k], sums[0, 3 + k], sums[0, 6 + k], sums[0, 9 + k]
        u[k] = s0 + z * (s1 + z * (s2 + z * s3))
        slope[k, 2] = rate * (s1 + z * (2.0 * s2 + 3.0 * z * s3))
        for d in range(2):
            upper = sums[1 + d, 6 + k] + z * sums[1 + d, 9 + k]
            slope[k, d] = sums[1 + d, k] + z * (sums[1 + d, 3 + k] + z * upper)


@kernel(
    "void(UniTuple(f8, 4), UniTuple(f8, 2), f8, f8[::1], f8[::1], f8[:,:,::1], "
    "f8[:,::1], f8[:,::1], f8[:,::1])"
)
def add_field(
    frame: tuple[float, float, float, float],
    half: tuple[float, float],
    height: float,
    tx: Array,
    ty: Array,
    coefficients: Array,
    points: Array,
    places: Array,
    gradients: Array,
) -> None:
    """Add the displacement of a field of splines and its derivatives.

    Args:
        frame: x, y [m], cosine and sine of the angle of the field's frame.
        half: half the length and width of the field's box, beyond which there is nothing; infinite
            where the field keeps the values of its ends [m].
        height: height of the box [m].
        tx, ty: knots of the splines.
        coefficients: coefficients of up to four powers of the level from 0, of three components
            each, (nx, ny, 3 powers).
        points: undeformed.
        places, gradients: arrays that are added to.
    """
    values, sums = np.empty((2, 8)), np.zeros((3, 12))
    slope, u = np.empty((3, 3)), np.empty(3)
    ox, oy, c, s = frame
    ends = tx[0], tx[-1], ty[0], ty[-1]
    cells, inside, before_x, before_y = 3 * 65536 + 3, False, np.nan, np.nan
    for n in range(len(points)):
        x, y = points[n, 0], points[n, 1]
        if x != before_x or y != before_y:
            before_x, before_y = x, y
            at_x, at_y = c * (x - ox) + s * (y - oy), c * (y - oy) - s * (x - ox)
            inside = abs(at_x) < half[0] and abs(at_y) < half[1]
            if inside:
                at_x, at_y = min(max(at_x, ends[0]), ends[1]), min(max(at_y, ends[2]), ends[3])
                cells = sum_field_powers(
                    tx, ty, coefficients, cells // 65536, cells % 65536, at_x, at_y, values, sums
                )
        if not inside:
            continue
        level = min(max(2.0 * points[n, 2] / height - 1.0, -1.0), 1.0)
        evaluate_level(sums, level, 2.0 / height, u, slope)
        places[n, 0] += c * u[0] - s * u[1]
        places[n, 1] += s * u[0] + c * u[1]
        places[n, 2] += u[2]
        # The gradient Q G Q^T: rows turned first, then columns.
        for k in range(3):
            slope_x, slope_y = slope[0, k], slope[1, k]
            slope[0, k], slope[1, k] = c * slope_x - s * slope_y, s * slope_x + c * slope_y
        for k in range(3):
            slope_x, slope_y = slope[k, 0], slope[k, 1]
            gradients[n, 3 * k] += c * slope_x - s * slope_y
            gradients[n, 3 * k + 1] += s * slope_x + c * slope_y
            gradients[n, 3 * k + 2] += slope[k, 2]


@kernel(
    "void(UniTuple(f8, 2), f8[:,::1], f8, f8[::1], f8[:,:,::1], f8, "
    "f8[:,::1], f8[:,::1], f8[:,::1])"
)
def add_dent(
    place: tuple[float, float],
    turn: Array,
    height: float,
    knots: Array,
    pieces: Array,
    least: float,
    points: Array,
    places: Array,
    gradients: Array,
) -> None:
    """Add the displacement of a dent and its derivatives.

    Args:
        place: place of the axis, x and y [m].
        turn: rotation of displacements, and below it factors of distances from the axis, (4, 3).
        height: height of the layer [m].
        knots: knots of the piecewise cubics in r, (m + 1,) [m].
        pieces: coefficients of u and w, of the powers 0 to 5 of the level each, of the powers of r
            from the highest, (m, 4, 12).
        least: distance to which points on the axis are moved aside [m].
        points: undeformed.
        places, gradients: arrays that are added to.
    """
    reach, last, rate = knots[-1], len(knots) - 2, 2.0 / height
    value, slope, parts, one = np.empty(12), np.empty(12), np.empty(9), np.empty(3)
    piece, before_x, before_y, r, c, s = 0, np.nan, np.nan, reach, 1.0, 0.0
    for n in range(len(points)):
        x, y = points[n, 0], points[n, 1]
        if x != before_x or y != before_y:
            before_x, before_y = x, y
            dx, dy = turn[3, 0] * (x - place[0]), turn[3, 1] * (y - place[1])
            r = math.sqrt(dx * dx + dy * dy)
            if r < reach:
                if r < least:
                    dx, dy, r = least, 0.0, least
                while piece < last and r >= knots[piece + 1]:
                    piece += 1
                while piece > 0 and r < knots[piece]:
                    piece -= 1
                t = r - knots[piece]
                own = pieces[piece]
                for m in range(12):
                    c3, c2, c1, c0 = own[0, m], own[1, m], own[2, m], own[3, m]
                    value[m] = ((c3 * t + c2) * t + c1) * t + c0
                    slope[m] = (3.0 * c3 * t + 2.0 * c2) * t + c1
                c, s = dx / r, dy / r
        if r >= reach:
            continue
        z = rate * points[n, 2] - 1.0
        u, w, u_r, w_r = value[5], value[11], slope[5], slope[11]
        u_z, w_z = 0.0, 0.0
        for m in range(4, -1, -1):
            u_z, w_z = u_z * z + u, w_z * z + w
            u, w = u * z + value[m], w * z + value[6 + m]
            u_r, w_r = u_r * z + slope[m], w_r * z + slope[6 + m]
        u_z, w_z = rate * u_z, rate * w_z
        cc, ss, cs = c * c, s * s, c * s
        one[0], one[1], one[2] = c * u, s * u, w
        across = cs * (u_r - u / r)
        parts[0], parts[1], parts[2] = cc * u_r + ss * (u / r), across, c * u_z
        parts[3], parts[4], parts[5] = across, ss * u_r + cc * (u / r), s * u_z
        parts[6], parts[7], parts[8] = c * w_r, s * w_r, w_z
        for i in range(3):
            R0, R1, R2 = turn[i, 0], turn[i, 1], turn[i, 2]
            places[n, i] += R0 * one[0] + R1 * one[1] + R2 * one[2]
            for k in range(3):
                turned = R0 * parts[k] + R1 * parts[3 + k] + R2 * parts[6 + k]
                gradients[n, 3 * i + k] += turned * turn[3, k]


@kernel("void(f8[:,::1], f8[::1], f8[::1], f8[:,:,::1], f8[:,::1], f8[:,::1])")
def bend(
    box: Array,
    tx: Array,
    ty: Array,
    coefficients: Array,
    places: Array,
    gradients: Array,
) -> None:
    """Move places on by a bend, and multiply gradients by its own.

    Args:
        box: middle and half sizes of the bent layer, beyond which it goes on linearly, (2, 3) [m].
        tx, ty: knots of the splines, from the middle.
        coefficients: coefficients as of `add_field`.
        places, gradients: replaced.
    """
    values, sums = np.empty((2, 8)), np.zeros((3, 12))
    slope, u, at, beyond = np.empty((3, 3)), np.empty(3), np.empty(3), np.empty(3)
    cells, before_x, before_y, rate = 3 * 65536 + 3, np.nan, np.nan, 1.0 / box[1, 2]
    for n in range(len(places)):
        for k in range(3):
            at[k] = places[n, k] - box[0, k]
            beyond[k] = at[k]
            at[k] = min(max(at[k], -box[1, k]), box[1, k])
            beyond[k] -= at[k]
        if at[0] != before_x or at[1] != before_y:
            before_x, before_y = at[0], at[1]
            cells = sum_field_powers(
                tx, ty, coefficients, cells // 65536, cells % 65536, at[0], at[1], values, sums
            )
        evaluate_level(sums, rate * at[2], rate, u, slope)
        for k in range(3):
            more = slope[k, 0] * beyond[0] + slope[k, 1] * beyond[1] + slope[k, 2] * beyond[2]
            places[n, k] += u[k] + more
            slope[k, k] += 1.0
        for k in range(3):
            f0, f1, f2 = gradients[n, k], gradients[n, 3 + k], gradients[n, 6 + k]
            for d in range(3):
                gradients[n, 3 * d + k] = slope[d, 0] * f0 + slope[d, 1] * f1 + slope[d, 2] * f2


@kernel("i8(f8[:,::1], f8[:,::1], f8[::1], f8[:,::1])")
def pull_back(gradients: Array, shift: Array, conductivity: Array, entries: Array) -> int:
    """Set the entries xx, yy, zz, xy, xz, yz of J F^-1 sigma F^-T; how many J are not positive.

    Args:
        gradients: F, (n, 9); times those of a shift (n, 9) where there is one, else (0, 9).
        conductivity: sigma, (n,) [S/m].
        entries: entries of n tensors, (n, 6).
    """
    F, a, wrong = np.empty(9), np.empty(9), 0
    for n in range(len(gradients)):
        f = gradients[n]
        for m in range(9):
            F[m] = f[m]
        if len(shift):
            g = shift[n]
            for i in range(3):
                for j in range(3):
                    F[3 * i + j] = (
                        f[3 * i] * g[j] + f[3 * i + 1] * g[3 + j] + f[3 * i + 2] * g[6 + j]
                    )
        # Rows of the adjugate J F^-1.
        a[0], a[1] = F[4] * F[8] - F[5] * F[7], F[2] * F[7] - F[1] * F[8]
        a[2], a[3] = F[1] * F[5] - F[2] * F[4], F[5] * F[6] - F[3] * F[8]
        a[4], a[5] = F[0] * F[8] - F[2] * F[6], F[2] * F[3] - F[0] * F[5]
        a[6], a[7] = F[3] * F[7] - F[4] * F[6], F[1] * F[6] - F[0] * F[7]
        a[8] = F[0] * F[4] - F[1] * F[3]
        J = F[0] * a[0] + F[1] * a[3] + F[2] * a[6]
        wrong += not J > 0.0
        factor = conductivity[n] / J
        entries[n, 0] = factor * (a[0] * a[0] + a[1] * a[1] + a[2] * a[2])
        entries[n, 1] = factor * (a[3] * a[3] + a[4] * a[4] + a[5] * a[5])
        entries[n, 2] = factor * (a[6] * a[6] + a[7] * a[7] + a[8] * a[8])
        entries[n, 3] = factor * (a[0] * a[3] + a[1] * a[4] + a[2] * a[5])
        entries[n, 4] = factor * (a[0] * a[6] + a[1] * a[7] + a[2] * a[8])
        entries[n, 5] = factor * (a[3] * a[6] + a[4] * a[7] + a[5] * a[8])
    return wrong
