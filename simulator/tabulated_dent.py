"""The dent of a press as a table: splines over the distance, polynomials over the height."""

from dataclasses import dataclass

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import NDArray
from scipy.interpolate import PPoly

from eitskin.simulator.dents import Strains

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

    def displacement(self, r: Array, z: Array) -> tuple[Array, Array]:
        """u and w [m] at distance r from the axis and height z over the layer's bottom [m]."""
        u, w, _ = _summed(self._over_height(z), self._at(r))
        return u, w

    def mean_stress(self, r: Array, z: Array) -> Array:
        """Mean stress [Pa], positive in tension."""
        _, _, stress = _summed(self._over_height(z), self._at(r))
        return np.asarray(stress)

    def strains(self, r: Array, z: Array) -> Strains:
        """Their derivatives."""
        near = r < 1e-9  # on the axis u / r tends to du/dr
        P, values = self._over_height(z), self._at(r)[:2]
        u = _summed(P, values[:1])[0]
        radial, tilt = _summed(P, self._at(r, 1)[:2])
        shear, upward = _summed(P @ (_RISES * (2.0 / self.thickness)), values)
        hoop = np.where(near, radial, u / np.where(near, 1.0, r))
        return Strains(hoop, radial, shear, tilt, upward)

    def _over_height(self, z: Array) -> Array:
        """Legendre polynomials at heights, (..., m); (h, m) where all rows of heights are alike."""
        if z.ndim == 2 and len(z) and np.array_equal(z, np.broadcast_to(z[:1], z.shape)):
            z = z[0]
        return np.asarray(legendre.legvander(2.0 * z / self.thickness - 1.0, DEGREE))

    def _at(self, r: Array, derivative: int = 0) -> Array:
        """Coefficients of u, w and stress at distances (...), (3, ..., coefficients)."""
        coefficients = self.profile(np.minimum(r, self.reach), derivative)
        return np.ascontiguousarray(np.moveaxis(coefficients, -1, 0))


def _summed(P: Array, coefficients: Array) -> Array:
    """Fields (k, ...) of polynomials (..., m) and coefficients (k, ..., m).

    Columns (k, n, 1, m) at the same heights (h, m) are one product of matrices.
    """
    if P.ndim == 2 and coefficients.ndim == 4:
        return np.asarray(coefficients[:, :, 0] @ P.T)
    fields: Array = np.einsum("...m,k...m->k...", P, coefficients)
    return fields
