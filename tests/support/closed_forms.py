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
