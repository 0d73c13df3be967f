"""The dent of a press as a table: splines over the distance, polynomials over the height."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import NDArray
from scipy.interpolate import PPoly

from eitskin.simulator.dents import Motion

Array = NDArray[np.float64]

DEGREE = 5  # over the height of the layer
# Legendre coefficients of the derivative of a polynomial, from its own.
_RISES = np.vstack([legendre.legder(np.eye(DEGREE + 1)), np.zeros(DEGREE + 1)])


@dataclass(frozen=True, slots=True, eq=False)
class TabulatedDent:
    """The dent of one press.

    Attributes:
        force: of the indenter [N].
        depth: of its lowest point under the undeformed top of the stack [m].
        contact_radius: where contact ends, in the deformed stack [m].
        peak_pressure: on the contact [Pa].
        thinning: 1 - thickness over undeformed thickness of the layer, on the axis.
        share: of the force that the shear modulus of the layer accounts for, (mu / F) dF/dmu.
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

    def motion(self, r: Array, z: Array) -> Motion:
        """How points at distance r from the axis and height z over the layer's bottom move [m].

        At distances (..., n, 1) and heights (n, h) that are alike for all n, as of quadrature
        points in upright cells, the polynomials over the height are summed before the splines.
        """
        if z.ndim == 2 and r.shape[-2:] == (len(z), 1) and len(z) and (z == z[0]).all():
            u, w, shear, stretch, radial, tilt = self._at_heights(r[..., 0], z[0])
        else:
            u, w, shear, stretch, radial, tilt = self._anywhere(*np.broadcast_arrays(r, z))
        near = r < 1e-9  # on the axis u / r tends to du/dr
        hoop = np.where(near, radial, u / np.where(near, 1.0, r))
        return Motion(u, w, hoop, radial, shear, tilt, stretch)

    def mean_stress(self, r: Array, z: Array) -> Array:
        """Mean stress [Pa], positive in tension."""
        r, z = np.broadcast_arrays(r, z)
        coefficients = self.profile(np.minimum(r, self.reach))[..., 2]
        return np.asarray(np.einsum("...m,...m->...", self.over_height(z), coefficients))

    def _at_heights(self, r: Array, z: Array) -> Array:
        """u, w, their slopes upwards and outwards, each (..., h), at r (...) and z (h,)."""
        found = _at_heights(self, tuple(z.tolist()))(np.minimum(r, self.reach))  # (..., 3 h, 2)
        parts = np.moveaxis(found.reshape(*r.shape, 3, len(z), 2), (-3, -1), (0, 1))
        return np.ascontiguousarray(parts).reshape(6, *r.shape, len(z))

    def _anywhere(self, r: Array, z: Array) -> Array:
        """The same, each (...), at r and z (...)."""
        P = self.over_height(z)
        inside = np.minimum(r, self.reach)
        c, slopes = self.profile(inside)[..., :2], self.profile(inside, 1)[..., :2]
        pairs = ((P, c), (self.rises(P), c), (P, slopes))
        return np.concatenate([np.einsum("...m,...mf->f...", Q, v) for Q, v in pairs])

    def rises(self, P: Array) -> Array:
        """Slopes upwards [1/m] of the polynomials with values P (..., m)."""
        return np.asarray(P @ (_RISES * (2.0 / self.thickness)))

    def over_height(self, z: Array) -> Array:
        """Legendre polynomials at heights z (...), (..., m)."""
        return np.asarray(legendre.legvander(2.0 * z / self.thickness - 1.0, DEGREE))


@lru_cache(maxsize=16)
def _at_heights(dent: TabulatedDent, heights: tuple[float, ...]) -> PPoly:
    """Splines over r of u and w, their slopes upwards, and outwards, at heights, (3 h, 2)."""
    P = dent.over_height(np.array(heights))
    upright = np.concatenate([P, dent.rises(P)])  # (2 h, m)
    values = np.einsum("pkmf,hm->pkhf", dent.profile.c[..., :2], upright, optimize=True)
    outward = np.zeros_like(values[:, :, : len(P)])
    outward[1:] = values[:-1, :, : len(P)] * np.array([3.0, 2.0, 1.0])[:, None, None, None]
    splines = np.concatenate([values, outward], axis=2)
    return PPoly.construct_fast(splines, dent.profile.x)
