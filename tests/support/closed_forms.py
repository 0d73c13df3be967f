"""Closed forms and series for the complete electrode model, written from their sources.

Nothing here knows the simulator. Sheets have unit conductance S = sigma h unless said otherwise;
the resistance of a real sheet is then the value divided by S, with contact impedances
z* = z sigma / (unit of length).
"""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import ellipj, ellipk, ellipkm1

Array = NDArray[np.float64]
Place = tuple[float, float]


def block(length: float, area: float, conductivity: float, *contact: complex) -> complex:
    """L / (sigma A) + (z_1 + z_2) / A [ohm] of a block between two full-end electrodes."""
    return length / (conductivity * area) + sum(contact) / area


def sector_between_ends(angle: float, inner: float, outer: float) -> float:
    """theta / ln(r2/r1): an annular sector between shunt electrodes on its straight ends."""
    return angle / np.log(outer / inner)


def sector_between_arcs(angle: float, inner: float, outer: float, z: float = 0.0) -> float:
    """ln(r2/r1) / theta + z* (1/r1 + 1/r2) / theta: between electrodes on its curved faces."""
    return (np.log(outer / inner) + z * (1 / inner + 1 / outer)) / angle


def shunt_resistance(m: float, rest: float) -> float:
    """K(1-m) / K(m): a half-plane between two shunt electrodes; `rest` is 1 - m.

    m is the cross-ratio (a1 - a2) (b1 - b2) / ((a1 - b1) (a2 - b2)) of the ends a1, a2 of one
    electrode and b1, b2 of the other, in turn. The half-plane is then a rectangle K(1-m) long
    and K(m) wide.
    """
    return float(ellipkm1(m) / ellipkm1(rest))


def shunt_pair(a: float, b: float, edges: Sequence[Place]) -> float:
    """A rectangle a x b between two shunt electrodes on its rim.

    `edges` are the ends of the first and of the second electrode, in turn round the rim. sn maps
    the rectangle to the upper half-plane (Schwarz-Christoffel).
    """
    p = [_on_real_line(a, b, place) for place in edges]
    whole = _minor(p[0], p[2]) * _minor(p[1], p[3])
    m = abs(_minor(p[0], p[1]) * _minor(p[2], p[3]) / whole)
    rest = abs(_minor(p[0], p[3]) * _minor(p[1], p[2]) / whole)
    return shunt_resistance(m, rest)


def _minor(p: Place, q: Place) -> float:
    return p[0] * q[1] - p[1] * q[0]


def _on_real_line(a: float, b: float, place: Place) -> Place:
    """Where sn takes a point of the rim, as a ratio (numerator, denominator).

    With K'/K = 2 b/a the rectangle is |x| < K, 0 < y < K'. The nome q = exp(-pi K'/K) gives
    sqrt(k) = theta_2 / theta_3.
    """
    if a > b:  # a small nome loses no digits
        return _on_real_line(b, a, (place[1], a - place[0]))
    n = np.arange(20)
    nome = np.exp(-2 * np.pi * b / a)
    theta_2 = 2 * (nome ** ((n + 0.5) ** 2)).sum()
    theta_3 = 1 + 2 * (nome ** ((n + 1.0) ** 2)).sum()
    k = (theta_2 / theta_3) ** 2
    K = ellipk(k**2)
    x, y = (2 * place[0] / a - 1) * K, 2 * place[1] / a * K
    sn = ellipj(x, k**2)[0]
    if np.isclose(place[1], 0.0):
        return sn, 1.0
    if np.isclose(place[1], b):
        return 1.0, k * sn  # sn(x + i K') = 1 / (k sn x)
    return float(np.sign(x)), ellipj(y, 1 - k**2)[2]  # sn(K + i y) = 1 / dn(y, 1 - m)


def gap_pair(a: float, b: float, centres: Place, width: float, *, opposite: bool) -> float:
    """A rectangle a x b, the current density uniform under both electrodes.

    Both lie on the sides of length a. The resistance is the difference of the mean potentials
    under them, by separation of variables.
    """
    k = np.arange(1, 400_001) * np.pi / a
    under = np.sin(k * width / 2) / (k * width / 2)
    first, second = (np.cos(k * centre) * under for centre in centres)
    near = 1 / np.tanh(k * b)
    across = 1 / np.sinh(np.minimum(k * b, 700.0)) if opposite else near
    terms = ((first**2 + second**2) * near - 2 * first * second * across) / k
    return float(2 / a * terms.sum() + (b / a if opposite else 0.0))


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
) -> float:
    """Eigenvalue of the impedance matrix of a disc for electrode currents cos(n phi_l).

    The current density is uniform under `electrodes` equal electrodes, `width` rad wide, at equal
    distances. A pattern holds the harmonics n + j L, each weighed by sinc^2 of half its width.
    """
    orders = n + electrodes * np.arange(-20_000, 20_001)
    weights = np.sinc(orders * width / (2 * np.pi)) ** 2
    return float(electrodes / (2 * np.pi) * (weights * eigenvalue(orders)).sum())


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


def bonded_punch(ratio: float, points: int = 40) -> float:
    """F (1 - nu^2) / (2 a E delta) of a smooth flat punch on a bonded incompressible layer.

    Hayes et al. 1972; `ratio` is radius a over thickness h. With pressures
    p(r) = int k A(k) J0(kr) dk and A = int_0^a phi(t) cos(kt) dt, what lies under the punch obeys
    phi + 2/pi int phi(s) int (M(kh) - 1) cos(kt) cos(ks) dk ds = const, where
    M(x) = (sinh 2x - 2x) / (cosh 2x + 1 + 2 x^2) is the compliance of the layer over that of the
    half-space.
    """
    t, weights = np.polynomial.legendre.leggauss(points)
    t, weights = 0.5 * (t + 1.0), 0.5 * weights
    x, dk = np.polynomial.legendre.leggauss(10 * points)
    x, dk = 20.0 * (x + 1.0), 20.0 * ratio * dk
    decay = np.exp(-2.0 * x)
    M = (1.0 - decay**2 - 4.0 * x * decay) / (1.0 + decay**2 + (2.0 + 4.0 * x**2) * decay)
    C = np.cos(np.outer(t, ratio * x))
    K = 2.0 / np.pi * (C * ((M - 1.0) * dk)) @ C.T
    return float(weights @ np.linalg.solve(np.eye(points) + K * weights, np.ones(points)))
