"""Closed forms for stiff and extreme cases, independent of the simulator."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.special import ellipj, ellipk, ellipkm1

Array = NDArray[np.float64]
Place = tuple[float, float]


def block(length: float, area: float, conductivity: float, *contact: complex) -> complex:
    """Resistance L / (sigma A) + sum z / A [ohm] of a block between full-end electrodes."""
    return length / (conductivity * area) + sum(contact) / area


def sector(angle: float, height: float, width: float, stretch: float, length: float) -> float:
    """Resistance times conductivity [1/m] of a block bent into an annular sector, end to end.

    theta / (w ln(r_2 / r_1)), with r^2 = (lambda_0^2 + 2 c Z) / c^2 of Rivlin's flexure at the
    faces Z = +-height / 2 and c = theta / length.
    """
    slope = abs(angle) / length * height
    log_ratio = 0.5 * np.log((stretch**2 + slope) / (stretch**2 - slope))
    return float(abs(angle) / (width * log_ratio))


def shunt_resistance(m: float, rest: float) -> float:
    """Resistance times sheet conductance, K(1-m) / K(m), of a half-plane with shunt electrodes.

    m is the cross-ratio (a1 - a2) (b1 - b2) / ((a1 - b1) (a2 - b2)) of the ends a1, a2 of one
    electrode and b1, b2 of the other, in turn; `rest` is 1 - m. The half-plane is then a
    rectangle K(1-m) long and K(m) wide.
    """
    return float(ellipkm1(m) / ellipkm1(rest))


def shunt_pair(a: float, b: float, edges: Sequence[Place]) -> float:
    """Resistance times sheet conductance of a rectangle a x b between two shunt electrodes.

    `edges` are the ends (x, y) of the first and of the second electrode, in turn round the rim;
    a, b and `edges` share one unit. sn maps the rectangle to the half-plane (Schwarz-Christoffel).
    """
    p = [_on_real_line(a, b, place) for place in edges]
    whole = _minor(p[0], p[2]) * _minor(p[1], p[3])
    m = abs(_minor(p[0], p[1]) * _minor(p[2], p[3]) / whole)
    ratio = abs(_minor(p[0], p[3]) * _minor(p[1], p[2]) / whole)
    return shunt_resistance(m, ratio)


def _minor(p: Place, q: Place) -> float:
    return p[0] * q[1] - p[1] * q[0]


def _on_real_line(a: float, b: float, place: Place) -> Place:
    """Image under sn of a point of the rim, as numerator and denominator.

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


def punched_layer(radius: float, thickness: float, nu: float) -> float:
    """Force over depth and shear modulus [m] of a flat smooth punch on a bonded layer.

    P = 4 mu a delta kappa / (1 - nu), kappa = pi / (2 a delta) int_0^a phi dt, from the integral
    equation of Lebedev and Ufliand (1958), as in Hayes et al. (1972):

        phi(t) - 1/pi int_0^a phi(s) (K(t + s) + K(t - s)) ds = 2 delta / pi,
        K(u) = int_0^inf (1 - L(w)) cos(w u) dw.
    """
    ratio = radius / thickness
    w, w_weights = _gauss(30.0, 600)
    flexible = 3.0 - 4.0 * nu
    L = (flexible * np.sinh(2 * w) - 2 * w) / (
        flexible * np.cosh(2 * w) + 2 * w**2 + 0.5 * (1 + flexible**2)
    )
    t, weights = _gauss(ratio, 40)
    waves = np.cos(np.outer(t, w))
    # cos(w (t + s)) + cos(w (t - s)) = 2 cos(w t) cos(w s).
    K = 2.0 * (waves * ((1.0 - L) * w_weights)) @ waves.T
    phi = np.linalg.solve(np.eye(len(t)) - K * weights / np.pi, np.full(len(t), 2.0 / np.pi))
    kappa = np.pi / (2.0 * ratio) * (weights @ phi)
    return float(4.0 * radius * kappa / (1.0 - nu))


def _gauss(end: float, count: int) -> tuple[Array, Array]:
    """Nodes and weights of the Gauss rule from 0 to `end`."""
    nodes, weights = np.polynomial.legendre.leggauss(count)
    return 0.5 * end * (nodes + 1.0), 0.5 * end * weights
