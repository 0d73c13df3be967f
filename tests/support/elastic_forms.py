"""Closed forms and transforms of linear elasticity for layered plates and stacks.

Nothing here knows the simulator. Materials are incompressible, so that E = 3 mu and the
plane-strain modulus E / (1 - nu^2) = 4 mu.
"""

import itertools
from collections.abc import Sequence

import numpy as np
from numpy.polynomial import Legendre, Polynomial
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


# Plates and membranes


def plate_stiffnesses(sheets: Sheets) -> tuple[float, float]:
    """Flexural rigidity D [N m] and shear stiffness S [N/m] of a layered plate, per width.

    D = sum of 4 mu int (z - z_n)^2 dz about the neutral plane z_n. The shear stress of a bent
    plate follows from equilibrium, tau / Q = -int 4 mu (z - z_n) dz / D from the lower face, and
    its energy gives 1 / S = int (tau / Q)^2 / mu dz (Reissner 1945; 5/6 mu h for one sheet).
    """
    thicknesses, mu = np.array(sheets, dtype=float).T
    high = np.cumsum(thicknesses)
    low = high - thicknesses
    neutral = np.sum(mu * (high**2 - low**2)) / (2.0 * np.sum(mu * thicknesses))
    parts = 4.0 / 3.0 * mu * ((high - neutral) ** 3 - (low - neutral) ** 3)
    rigidity = float(parts.sum())
    nodes, weights = np.polynomial.legendre.leggauss(5)
    z = low[:, None] + 0.5 * thicknesses[:, None] * (1.0 + nodes) - neutral
    ends = 2.0 * mu * ((high - neutral) ** 2 - (low - neutral) ** 2)
    before = np.cumsum(ends) - ends
    stress = before[:, None] + 2.0 * mu[:, None] * (z**2 - (low[:, None] - neutral) ** 2)
    compliance = np.sum(weights * (stress / rigidity) ** 2 * (0.5 * thicknesses / mu)[:, None])
    return rigidity, 1.0 / float(compliance)


def clamped_strip_deflection(sheets: Sheets, length: float, load: float) -> float:
    """Deflection in the middle of a strip between clamps under a uniform load [Pa], small [m].

    p L^4 / (384 D) + p L^2 / (8 S), bending and shear of a plate bent to a cylinder (Timoshenko).
    """
    rigidity, shear = plate_stiffnesses(sheets)
    return load * length**4 / (384.0 * rigidity) + load * length**2 / (8.0 * shear)


def clamped_plate_deflection(
    length: float, width: float, rigidity: float, load: float, terms: int = 6
) -> float:
    """Deflection in the middle of a thin rectangular plate clamped at its rim, small [m].

    Ritz's method with (1 - x^2)^2 (1 - y^2)^2 times even Legendre polynomials; 0.00126 p a^4 / D
    for a square (Timoshenko and Woinowsky-Krieger 1959, table 35).
    """
    at, weights = np.polynomial.legendre.leggauss(40)
    bubble = Polynomial([1.0, 0.0, -1.0]) ** 2
    forms = [bubble * Legendre.basis(2 * i).convert(kind=Polynomial) for i in range(terms)]
    values, slopes, bends = (np.array([f.deriv(k)(at) for f in forms]) for k in range(3))
    mass, stretch, bending = (
        each @ (weights[:, None] * each.T) for each in (values, slopes, bends)
    )
    x, y = 0.5 * length, 0.5 * width
    stiffness = np.einsum("ik,jl->ijkl", bending, mass) * y / x**3
    stiffness += np.einsum("ik,jl->ijkl", mass, bending) * x / y**3
    stiffness += 2.0 * np.einsum("ik,jl->ijkl", stretch, stretch) / (x * y)
    means = values @ weights
    forces = load * x * y * np.outer(means, means).ravel()
    shares = np.linalg.solve(rigidity * stiffness.reshape(terms**2, -1), forces)
    middle = np.array([f(0.0) for f in forms])
    return float(shares @ np.outer(middle, middle).ravel())


def membrane_deflection(
    length: float, width: float, tension: float, load: float, terms: int = 200
) -> float:
    """Deflection in the middle of a rectangular membrane of tension [N/m], small [m].

    Navier's series of -N laplace w = p; with N = S, the deflection of a plate by shear alone.
    """
    odd = np.arange(1, 2 * terms, 2)
    parts = np.sin(0.5 * np.pi * odd) / odd
    rates = (odd[:, None] / length) ** 2 + (odd / width) ** 2
    return float(16.0 * load / np.pi**4 / tension * np.sum(np.outer(parts, parts) / rates))


def equibiaxial_tension(sheets: Sheets, stretch: float) -> float:
    """Tension of neo-Hookean sheets stretched equally in both directions, per deformed length.

    N = sum of mu h (1 - stretch^-6) [N/m], h the undeformed thicknesses (Treloar 1944).
    """
    return sum(mu * thickness for thickness, mu in sheets) * (1.0 - stretch**-6)
