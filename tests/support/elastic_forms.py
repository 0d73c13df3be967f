"""Linear elasticity of incompressible layers; nothing here knows the simulator."""

import itertools
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm
from scipy.special import j0

Array = NDArray[np.float64]
Sheets = Sequence[tuple[float, float]]  # thickness [m] and shear modulus [Pa], from below

_DECAYED = 14.0  # depth times wave number beyond which nothing is felt
_HIGHEST = 60.0  # wave number times contact radius


def layered_deflection(
    sheets: Sheets, heights: Sequence[float], contact: float, radii: Array, pressure: Array
) -> Array:
    """Downward displacements on the axis at heights over a rigid base [m], by Hankel transform.

    For a wave number k with u = U sin kx, w = W cos kx, tau = T sin kx and sigma_zz = S cos kx,
    incompressibility, Hooke's law and equilibrium are U' = k W + T / mu, W' = -k U,
    T' = 4 mu k^2 U + k S, S' = -k T (Thomson 1950, Haskell 1953). The pressure (n,) [Pa] acts at
    `radii` (n,) [m] without friction; `contact` is its outer radius.
    """
    tops = np.cumsum([thickness for thickness, _ in sheets])
    edges = np.append(0.0, np.geomspace(0.05 / tops[-1], _HIGHEST / contact, 20))
    nodes, weights = np.polynomial.legendre.leggauss(12)
    half = 0.5 * np.diff(edges)[:, None]
    k = (edges[:-1, None] + half * (1.0 + nodes)).ravel()
    loads = np.trapezoid(pressure * radii * j0(k[:, None] * radii), radii, axis=1)
    symbols = np.array([_symbol(sheets, tops, heights, each) for each in k])
    return ((half * weights).ravel() * k * loads) @ symbols


def _symbol(sheets: Sheets, tops: Array, heights: Sequence[float], k: float) -> list[float]:
    """Downward displacements at heights under the pressure cos kx of unit amplitude [m/Pa]."""
    start = max(0.0, float(tops[-1]) - _DECAYED / k)
    levels = sorted({start, *(z for z in (*heights, *tops.tolist()) if z > start)})
    state, passed = np.eye(4)[:, 2:], {}
    for low, high in itertools.pairwise(levels):
        mu = sheets[int(np.searchsorted(tops, 0.5 * (low + high)))][1]
        rates = np.array(
            [[0, k, 1 / mu, 0], [-k, 0, 0, 0], [4 * mu * k**2, 0, 0, k], [0, 0, -k, 0]]
        )
        state = expm(rates * (high - low)) @ state
        passed[high] = state[1]
    at_base = np.linalg.solve(state[2:], [0.0, 1.0])
    return [float(passed[z] @ at_base) if z in passed else 0.0 for z in heights]
