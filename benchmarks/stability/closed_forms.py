"""Closed forms for stiff and extreme cases, independent of the simulator."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.special import ellipj, ellipk, ellipkm1

Array = NDArray[np.float64]


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


def shunt_pair(a: float, b: float, spans: Sequence[tuple[float, float]]) -> float:
    """Resistance times sheet conductance of a rectangle a x b between two shunt electrodes.

    K(1 - m) / K(m), with m the cross-ratio of the images of the electrodes' ends on the real
    line, to which sn takes the rim of the rectangle (Schwarz and Christoffel). `spans` are arc
    lengths from the origin, counter-clockwise [m].
    """
    p, q, r, s = (_on_real_line(a, b, end % (2 * (a + b))) for span in spans for end in span)

    def minor(v: Array, w: Array) -> float:
        return float(v[0] * w[1] - v[1] * w[0])

    whole = minor(p, r) * minor(q, s)
    m, rest = minor(p, q) * minor(r, s) / whole, minor(p, s) * minor(q, r) / whole
    return float(ellipkm1(abs(m)) / ellipkm1(abs(rest)))


def _on_real_line(a: float, b: float, s: float) -> Array:
    """Image under sn of the point at arc length s of the rim, as numerator and denominator.

    The rectangle is |Re| < K, 0 < Im < K', with K' / K = 2 b / a; the nome is exp(-pi K' / K).
    """
    n = np.arange(30)
    nome = np.exp(-2.0 * np.pi * b / a)
    k = (2 * (nome ** ((n + 0.5) ** 2)).sum() / (1 + 2 * (nome ** ((n + 1.0) ** 2)).sum())) ** 2
    K = ellipk(k**2)
    if s <= a:  # sn(x)
        return np.array([ellipj((2 * s / a - 1) * K, k**2)[0], 1.0])
    if s <= a + b:  # sn(K + i y) = 1 / dn(y, 1 - m)
        return np.array([1.0, ellipj(2 * (s - a) / a * K, 1 - k**2)[2]])
    if s <= 2 * a + b:  # sn(x + i K') = 1 / (k sn x)
        return np.array([1.0, k * ellipj((2 * (2 * a + b - s) / a - 1) * K, k**2)[0]])
    return np.array([-1.0, ellipj(2 * (2 * (a + b) - s) / a * K, 1 - k**2)[2]])


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
