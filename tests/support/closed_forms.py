"""Closed forms and series for the complete electrode model, written from their sources.

Nothing here knows the simulator. Sheets have unit conductance S = sigma h unless said otherwise;
the resistance of a real sheet is then the value divided by S, with contact impedances
z* = z sigma / (unit of length).
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


def sector_between_ends(angle: float, inner: float, outer: float) -> float:
    """theta / ln(r2/r1): an annular sector between shunt electrodes on its straight ends."""
    return angle / np.log(outer / inner)


def sector_between_arcs(angle: float, inner: float, outer: float, z: float = 0.0) -> float:
    """ln(r2/r1) / theta + z* (1/r1 + 1/r2) / theta: between electrodes on its curved faces."""
    return (np.log(outer / inner) + z * (1 / inner + 1 / outer)) / angle


def concentric_disc(order: ArrayLike, ratio: float, radius: float) -> Array:
    """Eigenvalue of the Neumann-to-Dirichlet map of the unit disc for cos(n phi).

    (1/n) (1 - beta rho^2n) / (1 + beta rho^2n), beta = (kappa - 1) / (kappa + 1), for a
    conductivity `ratio` kappa within `radius` rho.
    """
    n = np.abs(np.asarray(order, dtype=np.float64))
    inner = (ratio - 1) / (ratio + 1) * radius ** (2 * n)
    return (1 - inner) / (1 + inner) / n


def ring_of_gap_electrodes(
    n: int, electrodes: int, width: float, eigenvalue: Callable[[Array], Array]
) -> complex:
    """Eigenvalue of the impedance matrix of a disc for electrode currents cos(n phi_l).

    The current density is uniform under `electrodes` equal electrodes, `width` rad wide, at equal
    distances. A pattern holds the harmonics n + j L, each weighed by sinc^2 of half its width.
    """
    orders = n + electrodes * np.arange(-20_000, 20_001)
    weights = np.sinc(orders * width / (2 * np.pi)) ** 2
    total: complex = (electrodes / (2 * np.pi) * (weights * eigenvalue(orders)).sum()).item()
    return total


def disc_impedance(
    angles: ArrayLike, widths: ArrayLike, z: ArrayLike, points: int = 16
) -> NDArray[np.inexact]:
    """Impedance matrix of the unit disc in the complete electrode model, rows summing to zero.

    An integral equation for the current density f under the electrodes, each `widths` rad wide
    around its angle: u + z f = U - c with u = -1/pi int ln|2 sin((phi - psi) / 2)| f dpsi. With
    phi = angle + w cos(t) and f = g(t) / (w sin t), cosines are eigenfunctions of the logarithm:
    int ln|cos t - cos s| cos(n s) ds = -pi cos(n t) / n, -pi ln 2 for n = 0. Collocated at
    Chebyshev points; the error, exponentially small as z -> 0 and like points^-2 otherwise, is
    extrapolated from twice the points.
    """
    coarse, fine = (_collocated(angles, widths, z, n) for n in (points, 2 * points))
    return (4 * fine - coarse) / 3


def _collocated(
    angles: ArrayLike, widths: ArrayLike, z: ArrayLike, points: int
) -> NDArray[np.inexact]:
    angles = np.asarray(angles, dtype=np.float64)
    count, n = len(angles), np.arange(points)
    w = np.broadcast_to(widths, count)[:, None] / 2
    t = (n + 0.5) * np.pi / points
    cosines = np.cos(np.outer(t, n))
    eigenvalue = 1 / np.maximum(n, 1)
    eigenvalue[0] = np.log(2)
    places = (angles[:, None] + w * np.cos(t)).ravel()
    apart = (places[:, None] - places).reshape(count, points, count, points)
    own = np.arange(count)
    smooth = apart.copy()
    smooth[own, :, own] = 1.0  # written anew below
    smooth = np.log(np.abs(2 * np.sin(smooth / 2)))
    smooth[own, :, own] = np.log(w[:, :, None] * np.sinc(apart[own, :, own] / (2 * np.pi)))
    potential = -(smooth @ cosines) / points
    potential[own, :, own] += cosines * eigenvalue
    weight = w * np.sin(t)
    system = weight[:, :, None, None] * potential
    system[own, :, own] += np.broadcast_to(z, count)[:, None, None] * cosines
    size = count * points
    right = (weight[:, :, None] * np.eye(count)[:, None]).reshape(size, count)
    g = np.linalg.solve(system.reshape(size, size), right)
    G = np.pi * g.reshape(count, points, count)[:, 0]
    centring = np.eye(count) - 1 / count
    return centring @ np.linalg.inv(G) @ centring
