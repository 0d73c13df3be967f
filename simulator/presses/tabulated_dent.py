"""Tabulated dent: splines over the radius, Legendre polynomials over the height."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import NDArray
from scipy.interpolate import PPoly

Array = NDArray[np.float64]

DEGREE = 5  # over the height of the layer
# Legendre coefficients of the derivative of a polynomial, from its own.
_DERIVATIVE = np.vstack([legendre.legder(np.eye(DEGREE + 1)), np.zeros(DEGREE + 1)])


@dataclass(frozen=True, slots=True, eq=False)
class TabulatedDent:
    """Dent of one press, from a press table.

    Attributes:
        force: of the indenter [N].
        depth: of the indenter's lowest point under the undeformed top of the stack [m].
        contact_radius: of the contact area in the deformed stack [m].
        peak_pressure: largest contact pressure [Pa].
        thinning: 1 - thickness over undeformed thickness of the layer, on the axis.
        share: of the force due to the shear modulus of the layer, (mu / F) dF/dmu.
        thickness: of the undeformed layer [m].
        profile: piecewise cubics in r of the coefficients of u, w and the mean stress in Legendre
            polynomials over the height, (coefficients, 3).
    """

    force: float
    depth: float
    contact_radius: float
    peak_pressure: float
    thinning: float
    share: float
    thickness: float
    profile: PPoly

    @property
    def reach(self) -> float:
        """Distance from the axis beyond which nothing moves [m]."""
        return float(self.profile.x[-1])

    def motion(self, r: Array, z: Array) -> Array:
        """u, w, du/dz, dw/dz, du/dr and dw/dr [m], (..., n, 6, h), at r (..., n) and z (n, h).

        Where the heights are equal for all n, as for quadrature points in upright cells, the
        polynomials over the height are summed before the splines.
        """
        inside = np.minimum(r, self.reach)
        if len(z) and (z == z[0]).all():
            found = self.at_heights(z[0])(inside)
            return np.asarray(found.reshape(*r.shape, 6, z.shape[1]))
        P = self.over_height(z)
        c, slopes = self.profile(inside)[..., :2], self.profile(inside, 1)[..., :2]
        pairs = ((P, c), (self.derivatives(P), c), (P, slopes))
        parts = [np.einsum("nhm,...nmf->...nfh", Q, v) for Q, v in pairs]
        return np.concatenate(parts, axis=-2)

    def at_heights(self, z: Array) -> PPoly:
        """Splines over r of u, w, du/dz, dw/dz, du/dr, dw/dr, (6 h,), at heights z (h,)."""
        return _at_heights(self, tuple(z.tolist()))

    def mean_stress(self, r: Array, z: Array) -> Array:
        """Mean stress [Pa], positive in tension, (..., n, h) at r (..., n) and z (n, h)."""
        coefficients = self.profile(np.minimum(r, self.reach))[..., 2]
        return np.asarray(np.einsum("nhm,...nm->...nh", self.over_height(z), coefficients))

    def derivatives(self, P: Array) -> Array:
        """Derivatives along z [1/m] of the Legendre polynomials with values P (..., m)."""
        return np.asarray(P @ (_DERIVATIVE * (2.0 / self.thickness)))

    def over_height(self, z: Array) -> Array:
        """Legendre polynomials (..., m) at heights z (...) [m]."""
        return np.asarray(legendre.legvander(2.0 * z / self.thickness - 1.0, DEGREE))


@lru_cache(maxsize=16)
def _at_heights(dent: TabulatedDent, heights: tuple[float, ...]) -> PPoly:
    """Splines over r of u, w and their derivatives along z and r at heights, (6 h,)."""
    P = dent.over_height(np.array(heights))
    c = dent.profile.c[..., :2]
    both = np.concatenate([P, dent.derivatives(P)]).T
    splines = np.zeros((*c.shape[:2], 6, len(P)))
    for k in range(2):
        values = c[..., k] @ both
        splines[:, :, k], splines[:, :, 2 + k] = values[..., : len(P)], values[..., len(P) :]
    splines[1:, :, 4:] = splines[:-1, :, :2] * np.array([3.0, 2.0, 1.0])[:, None, None, None]
    return PPoly.construct_fast(splines.reshape(*splines.shape[:2], -1), dent.profile.x)
