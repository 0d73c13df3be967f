"""Dent of a press in closed form, without solid mechanics: a sketch for drawings."""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicHermiteSpline

from eitskin.errors import ConfigurationError
from eitskin.simulator.deformation.dents import Dents, PlacedDent
from eitskin.simulator.scene.indenters import Cylinder, Indenter
from eitskin.simulator.scene.scene import Touch

Array = NDArray[np.float64]

LARGEST_FORCE = 12.0  # [N]
_FITTED_RADIUS = 0.0075
_REACH = 6.0  # in units of the kernel's width b; beyond it the thickness is unchanged


@dataclass(frozen=True, slots=True, eq=False)
class ClosedFormDent:
    """Axisymmetric, isochoric dent whose relative change of thickness is w(r).

        w = h/h0 - 1 = -A (1 - r^2/b^2) exp(-r^2/b^2)

    Every height z moves by w z, and the radial displacement u preserves volume:
    (r + u)^2 = r^2 + 2 int_0^r s (1/(1 + w) - 1) ds.

    Attributes:
        amplitude: A, thinning on the axis [-].
        width: b [m].
        swept: the integral as a function of r [m2].
    """

    amplitude: float
    width: float
    swept: CubicHermiteSpline

    @classmethod
    def of(cls, indenter: Indenter, force: float) -> "ClosedFormDent":
        """Dent of a press with `force` [N].

        Raises ConfigurationError for indenters and forces outside the fit.
        """
        if not (isinstance(indenter, Cylinder) and abs(indenter.radius - _FITTED_RADIUS) < 1e-9):
            raise ConfigurationError(
                f"the closed form is fitted for a cylinder of radius {_FITTED_RADIUS:g} m, got "
                f"{indenter}; use the touch model 'tabulated'"
            )
        if not 0.0 < force <= LARGEST_FORCE:
            raise ConfigurationError(
                f"touch force must be above 0 and at most {LARGEST_FORCE:g} N, where the closed "
                f"form was fitted, got {force:g} N; the touch model 'tabulated' goes further"
            )
        return cls._of_force(force)

    @classmethod
    @lru_cache(maxsize=4096)
    def _of_force(cls, force: float) -> "ClosedFormDent":
        """Dent of the reference stack under the 15 mm cylinder.

        A = 0.036 F + 0.0012 F^2 and b = 12.8 mm - 0.16 mm F (F in N) pass through the fits at
        5 N (0.21, 12.0 mm) and 10 N (0.48, 11.2 mm), and through no dent at no force.
        """
        amplitude = 0.036 * force + 0.0012 * force**2
        width = 0.0128 - 0.00016 * force
        r = np.linspace(0.0, _REACH * width, 401)
        nodes, weights = np.polynomial.legendre.leggauss(4)
        step = r[1] - r[0]
        s = r[:-1, None] + 0.5 * (nodes + 1.0) * step
        excess = s * (1.0 / (1.0 + _thickness_change(s, amplitude, width)[0]) - 1.0)
        swept = np.concatenate([[0.0], np.cumsum(excess @ weights) * 0.5 * step])
        slope = r * (1.0 / (1.0 + _thickness_change(r, amplitude, width)[0]) - 1.0)
        return cls(amplitude, width, CubicHermiteSpline(r, swept, slope))

    @property
    def reach(self) -> float:
        """Distance from the axis beyond which nothing moves [m]: u falls slowly, like 1 / r."""
        return np.inf

    def motion(self, r: Array, z: Array) -> Array:
        """u, w, du/dz, dw/dz, du/dr and dw/dr [m], (..., n, 6, h), at r (..., n) and z (n, h)."""
        hoop, w, slope = self._thinned(r)
        # d(r + u)/dr from volume: (1 + u') (1 + u/r) (1 + w) = 1.
        radial = 1.0 / ((1.0 + hoop) * (1.0 + w)) - 1.0
        level, rising = np.ones_like(z), z
        parts = ((hoop * r, level), (w, rising), (0.0 * r, level), (w, level), (radial, level))
        return np.stack([each[..., None] * at for each, at in (*parts, (slope, rising))], axis=-2)

    def mean_stress(self, r: Array, z: Array) -> Array:  # noqa: ARG002
        """Raises ConfigurationError: the closed form has no stress."""
        raise ConfigurationError(
            "the closed form of a press knows no stress; a conductivity that depends on pressure "
            "needs the touch model 'tabulated'"
        )

    def _thinned(self, r: Array) -> tuple[Array, Array, Array]:
        """Hoop strain u / r, w and dw/dr at distance r [m], with the limit of u / r on the axis."""
        w, slope = _thickness_change(r, self.amplitude, self.width)
        swept = self.swept(np.minimum(r, _REACH * self.width))
        square = np.maximum(r, 1e-6 * self.width) ** 2
        hoop = np.sqrt(1.0 + 2.0 * swept / square)
        hoop = np.where(r < 1e-4 * self.width, 1.0 / np.sqrt(1.0 + w), hoop)
        return hoop - 1.0, w, slope


def closed_form_dents(touches: Iterable[Touch]) -> Dents:
    """Superposed dents in closed form: a sketch of presses for drawings, without a solution."""
    return Dents(
        tuple(PlacedDent(t.x, t.y, ClosedFormDent.of(t.indenter, t.force)) for t in touches)
    )


def _thickness_change(r: Array, amplitude: float, width: float) -> tuple[Array, Array]:
    """Relative change of thickness w(r) and its derivative dw/dr [1/m]."""
    t = (r / width) ** 2
    bell = np.where(t < _REACH**2, amplitude * np.exp(-t), 0.0)
    return -(1.0 - t) * bell, 2.0 * r / width**2 * (2.0 - t) * bell
