"""Quasi-linear viscoelasticity: relaxation and creep of force against depth.

A press to a depth d takes an elastic force F_e(d) at once and relaxes: F(t) = int G(t-s) dF_e(s)
(Fung 1993, section 7.6). Under a given force the dent is the one that F_e(t) = int J(t-s) dF(s)
would make at once; J, the creep function, is the inverse of G. Time enters only through F_e, "the
elastic force", for which all results of instantaneous presses hold.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import brentq
from scipy.special import exprel

from eitskin.errors import ConfigurationError

Array = NDArray[np.float64]

FADED = 1e-9  # elastic force over that of the first moment, below which nothing of a dent is left
_MAX_TIME = 1e30  # s; squares of such times neither overflow nor vanish
_FAINTEST = 1e-60  # smaller amplitudes count as zero


@dataclass(frozen=True)
class Prony:
    """Prony series of the reduced relaxation function G(t) = 1 - sum_k g_k (1 - exp(-t / tau_k)).

    Attributes:
        amplitudes: g_k, relative; their sum is less than 1.
        times: relaxation times tau_k [s].
    """

    amplitudes: tuple[float, ...] = ()
    times: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        g, tau = self.amplitudes, self.times
        if len(g) != len(tau):
            raise ConfigurationError(
                f"a Prony series needs one time per amplitude, got {len(g)} amplitudes and "
                f"{len(tau)} times"
            )
        if not all(a >= 0.0 for a in g) or not math.fsum(g) < 1.0:
            raise ConfigurationError(
                "amplitudes of a Prony series must not be negative and must add up to less than "
                f"1, or the material would flow; got {g}"
            )
        if not all(1.0 / _MAX_TIME <= time <= _MAX_TIME for time in tau):
            raise ConfigurationError(
                f"relaxation times must be positive and finite, in s, got {tau}"
            )

    def relaxation(self, t: ArrayLike) -> Array:
        """Relaxation function G at times t >= 0 [s]: force after a step of depth of unit force."""
        return 1.0 - _approach(self.amplitudes, self.times, t)

    def creep(self, t: ArrayLike) -> Array:
        """Creep function J at times t >= 0 [s]: elastic force after a unit step of force."""
        return 1.0 + _approach(*self.dual, t)

    @cached_property
    def dual(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Retardation amplitudes j_k and times [s]: J(t) = 1 + sum_k j_k (1 - exp(-t / time_k)).

        The Laplace transform of G is sum_k w_k / (s + p_k) with weights w = (1 - sum g, g_1, ...)
        and rates p = (0, 1 / tau_1, ...). The transform of J is 1 / s^2 over the transform of G.
        Retardation rates are therefore the zeros of the latter, one between any two neighbouring
        p, and the amplitudes follow from the residues. All sums have terms of one sign, so that no
        digits cancel for close and far rates.
        """
        g = np.array(self.amplitudes)
        significant = g > _FAINTEST
        rates, which = np.unique(1.0 / np.array(self.times)[significant], return_inverse=True)
        p = np.append(0.0, rates)
        w = np.append(1.0 - math.fsum(g), np.bincount(which, weights=g[significant]))
        amplitudes, times = [], []
        for k in reversed(range(len(rates))):
            origin, offset = _find_zero(p, w, k)
            rate = p[origin] + offset
            amplitudes.append(1.0 / float(w @ (rate / ((p[origin] - p) + offset)) ** 2))
            times.append(1.0 / float(rate))
        return tuple(amplitudes), tuple(times)


GEL = Prony((0.10, 0.10, 0.05), (0.5, 10.0, 200.0))
ECOFLEX = Prony((0.05, 0.05), (1.0, 30.0))


def mixture(materials: Sequence[Prony], shares: ArrayLike) -> Prony:
    """Relaxation of a body of several materials, sum_k s_k G_k(t), to first order.

    Args:
        materials: materials of the parts.
        shares: s_k = (mu_k / F) dF/dmu_k at fixed depth, adding up to 1.

    The elastic force is F(mu_1, mu_2, ...), homogeneous of degree one. Were the body linear, its
    transformed relaxation would be F(mu_1 s G_1, ...) exactly (correspondence principle), of
    which the sum is the first order in the amplitudes. The sum is exact for parts side by side;
    for parts on top of each other its error is about s_1 s_2 (G_1 - G_2)^2.
    """
    terms: dict[float, float] = {}
    for share, material in zip(np.asarray(shares).tolist(), materials, strict=True):
        for amplitude, time in zip(material.amplitudes, material.times, strict=True):
            terms[time] = terms.get(time, 0.0) + share * amplitude
    times = tuple(sorted(terms))
    return Prony(tuple(terms[time] for time in times), times)


# The reference stack under the 15 mm cylinder: the gel's share is 0.436 at 2 N, 0.433 at 5 N and
# 0.414 at 10 N.
REFERENCE = mixture((GEL, ECOFLEX), (0.43, 0.57))


def elastic_force(prony: Prony, force: float, seconds: float, released: float = 0.0) -> float:
    """Elastic force [N] of a force applied as a step, held, and possibly removed.

    Args:
        prony: relaxation of the body.
        force: constant force [N].
        seconds: duration of the force [s].
        released: time since the force was removed [s]; 0 while the force acts.
    """
    j, times = (np.array(part) for part in prony.dual)
    crept = float(j @ (np.exp(-released / times) * -np.expm1(-seconds / times)))
    return force * (crept if released > 0.0 else 1.0 + crept)


def elastic_force_at_depth(
    prony: Prony, force: float, seconds: float, released: float = 0.0
) -> float:
    """Elastic force [N] of a depth applied as a step, held, and possibly released.

    Args:
        prony: relaxation of the body.
        force: force at the first moment [N].
        seconds: duration of the constant depth [s].
        released: time since the indenter was taken off [s]; 0 while it is in contact.

    While the depth is held the force is F G(t). The delayed force q of each retardation time,
    time q' = F G - q, decays after the release; all terms are positive.
    """
    if released == 0.0:
        return force
    g, rates = np.array(prony.amplitudes), 1.0 / np.array(prony.times)
    j, times = (np.array(part) for part in prony.dual)
    retardation = 1.0 / times[:, None]
    # (exp(-rate t) - exp(-retardation t)) / (retardation - rate), accurate for close rates too.
    lag = seconds * np.exp(-np.minimum(rates, retardation) * seconds)
    lag *= exprel(-np.abs(rates - retardation) * seconds)
    felt = (1.0 - math.fsum(g)) * -np.expm1(-seconds / times) + (retardation * lag) @ g
    return force * float(j @ (felt * np.exp(-released / times)))


def _approach(amplitudes: ArrayLike, times: ArrayLike, t: ArrayLike) -> Array:
    """Sum of a_k (1 - exp(-t / time_k)) over k, of the shape of t."""
    at, a, tau = (np.asarray(part, dtype=np.float64) for part in (t, amplitudes, times))
    return np.asarray(np.tensordot(a, -np.expm1(-np.multiply.outer(1.0 / tau, at)), axes=1))


def _find_zero(p: Array, w: Array, k: int) -> tuple[int, float]:
    """Zero of sum_i w_i / (x - p_i) between p_k and p_(k+1), as the nearer pole and an offset.

    The offset from the nearer pole keeps all digits (Li 1993, LAPACK's dlaed4).
    """
    left_pole, right_pole = p[k], p[k + 1]
    others = np.delete(np.arange(len(p)), [k, k + 1])

    def without_poles(offset: float, origin: int) -> float:
        above, below = (p[origin] - left_pole) + offset, (right_pole - p[origin]) - offset
        other_terms = float(w[others] @ (1.0 / ((p[origin] - p[others]) + offset)))
        return float(w[k] * below - w[k + 1] * above + above * below * other_terms)

    gap = right_pole - left_pole
    origin, reach = (k + 1, -0.75 * gap) if without_poles(0.5 * gap, k) > 0.0 else (k, 0.75 * gap)
    precision = np.finfo(np.float64)
    offset = brentq(
        without_poles, 0.0, reach, (origin,), precision.tiny, 4.0 * precision.eps, maxiter=2000
    )
    return origin, float(offset)
