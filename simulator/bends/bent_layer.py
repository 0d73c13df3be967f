"""Bent layer: a smooth Deformation through nodal displacements of a clamped stack."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from eitskin.compiled import compiled
from eitskin.errors import ConfigurationError
from eitskin.geometry.deformation.kinematics import Gradients, Points
from eitskin.simulator.mechanics.cubic_splines import CubicSplines, in_plane

Array = NDArray[np.float64]

_AT_ONCE = 20_000  # points, per chunk, so that gathered values stay small
_SAME = 1e-9  # [m]
_QUADRATIC = 3  # coefficients over the height, of layers that are one cell thick


@dataclass(frozen=True, slots=True, eq=False)
class Nodes:
    """Nodes of a quarter of the layer along each axis, from its middle [m].

    Attributes:
        x, y: from 0 to half the length and half the width, (nx,) and (ny,).
        z: from the bottom face to the top face, (nz,).
        thickness: of the whole stack.
    """

    x: Array
    y: Array
    z: Array
    thickness: float


class BentLayer:
    """Layer of a bent sensor, a Deformation of the gel.

    Cubic splines along x and y and a polynomial along z interpolate the nodal displacements of a
    quarter, mirrored to all four: positions and deformation gradients are continuous. Beyond the
    layer, where presses push gel, positions are extrapolated linearly.

    Attributes:
        angle_deg: between the plates.
        energy: stored in the whole sensor [J].
        moment: of each plate about the axis, the derivative of the energy by the angle in radians
            [N m].
    """

    def __init__(
        self,
        nodes: Nodes,
        coefficients: Array,
        centre: Array,
        angle_deg: float,
        energy: float,
        moment: float,
    ) -> None:
        """Keep the splines.

        Args:
            nodes: of a quarter of the layer.
            coefficients: `spline_coefficients` of the displacements at the nodes.
            centre: middle of the layer [m], (3,).
            angle_deg, energy, moment: see the attributes.
        """
        self.angle_deg, self.energy, self.moment = angle_deg, energy, moment
        self._centre, self._thickness = centre, nodes.thickness
        self._ends = np.array([nodes.x[-1], nodes.y[-1], nodes.z[-1]])
        self._x, self._y = _axis(tuple(nodes.x)), _axis(tuple(nodes.y))
        self._shape = coefficients.shape
        self._coefficients = coefficients.reshape(*self._shape[:2], -1)

    def positions(self, points: Points) -> Points:
        """Deformed positions [m], (..., 3), of flat points [m], (..., 3)."""
        x, inside = self._within(points)
        moved = self._in_parts(inside, self._displacements)
        beyond = x - inside
        if np.any(beyond):
            slope = self._in_parts(inside, self._slopes).reshape(*points.shape, 3)
            moved = moved + np.einsum("...ij,...j->...i", slope, beyond)
        deformed: Points = self._centre + x + moved
        return deformed

    def gradient(self, points: Points) -> Gradients:
        """Deformation gradient, (..., 3, 3), continuous everywhere."""
        F = self._in_parts(self._within(points)[1], self._slopes)
        F = F.reshape(*points.shape, 3)
        F[..., range(3), range(3)] += 1.0
        return F

    def _within(self, points: Points) -> tuple[Points, Points]:
        """Points from the middle of the layer, and the nearest points of the layer."""
        x = np.asarray(points, dtype=float) - self._centre
        outside = np.abs(x[..., 2]) > 0.5 * self._thickness + _SAME
        outside |= np.abs(x[..., 1]) > self._ends[1] + 0.5 * self._thickness
        if np.any(outside):
            raise ConfigurationError(
                f"{int(outside.sum())} of {outside.size} points lie beside the bent sensor, whose "
                f"gel is {2 * self._ends[1]:g} m wide and whose stack is {self._thickness:g} m "
                "thick; a rolled sensor needs a kinematic fixture, Hinge(...) or FreeArc(...)"
            )
        return x, np.clip(x, -self._ends, self._ends)

    def _in_parts(self, x: Array, evaluated: Callable[[Array], Array]) -> Array:
        flat = x.reshape(-1, 3)
        parts = [
            evaluated(flat[start : start + _AT_ONCE])
            for start in range(0, max(len(flat), 1), _AT_ONCE)
        ]
        return np.concatenate(parts).reshape(*x.shape[:-1], -1)

    def _displacements(self, x: Array) -> Array:
        """Displacements (n, 3) at points (n, 3) of the layer."""
        value = self._in_plane(x)[:, 0]
        return np.asarray(np.einsum("npc,np->nc", value, self._powers(x[:, 2])[0]))

    def _slopes(self, x: Array) -> Array:
        """Derivatives (n, 9) of the displacements at points (n, 3) of the layer."""
        found = np.empty((len(x), 3, 3))
        kernels = compiled("eitskin.simulator.mechanics.spline_kernels")
        if kernels is not None and self._shape[2] == _QUADRATIC:
            knots = self._x.splines.knots, self._y.splines.knots
            kernels.gradients(*knots, self._coefficients, x, 1.0 / self._ends[2], found)
            return found.reshape(len(x), 9)
        sums, (powers, dpowers) = self._in_plane(x), self._powers(x[:, 2])
        for k, (part, height) in enumerate(((1, powers), (2, powers), (0, dpowers))):
            found[..., k] = np.einsum("npc,np->nc", sums[:, part], height)
        return found.reshape(len(x), 9)

    def _in_plane(self, x: Array) -> Array:
        """Polynomials over the height and their slopes by x and y, (n, 3, powers, 3)."""
        splines = self._x.splines, self._y.splines
        sums = in_plane(splines, self._coefficients, x[:, :2])
        return sums.reshape(len(x), 3, *self._shape[2:])

    def _powers(self, z: Array) -> tuple[Array, Array]:
        """Powers of the scaled height, (n, powers), and their derivatives by z [1/m]."""
        powers = np.vander(z / self._ends[2], self._shape[2], increasing=True)
        slopes = np.zeros_like(powers)
        slopes[:, 1:] = powers[:, :-1] * np.arange(1, self._shape[2]) / self._ends[2]
        return powers, slopes


def spline_coefficients(nodes: Nodes, values: Array) -> Array:
    """Coefficients of splines and powers of the scaled height, (splines, splines, nz, 3) [m].

    Linear in the displacements of the nodes of a quarter [m], `values` (nx, ny, nz, 3).
    """
    upright = np.linalg.inv(np.vander(nodes.z / nodes.z[-1], increasing=True))
    polynomials = np.moveaxis(values, 3, 0) @ upright.T
    along, across = _axis(tuple(nodes.x)).fit, _axis(tuple(nodes.y)).fit
    fits = [
        np.tensordot(np.tensordot(along[odd_x], part, (1, 0)), across[odd_y], (1, 1))
        # u_x is odd and the others are even along x; likewise u_y along y.
        for part, odd_x, odd_y in zip(polynomials, (1, 0, 0), (0, 1, 0), strict=True)
    ]
    return np.ascontiguousarray(np.stack(fits, axis=-1).swapaxes(1, 2))


class _Axis:
    """Splines along one axis, mirrored at the middle.

    Attributes:
        splines: on the nodes of both halves.
        fit: spline coefficients of even and odd functions by their values at the nodes of one
            half, (2, splines, nodes).
    """

    def __init__(self, nodes: Array) -> None:
        self.splines = CubicSplines(np.concatenate([-nodes[:0:-1], nodes]))
        mirror = np.eye(len(nodes))[:0:-1]
        halves = np.stack(
            [np.concatenate([sign * mirror, np.eye(len(nodes))]) for sign in (1.0, -1.0)]
        )
        halves[1, len(nodes) - 1] = 0.0  # odd functions vanish in the middle
        self.fit: Array = np.einsum("ij,sjk->sik", self.splines.fit, halves)


@lru_cache(maxsize=64)
def _axis(nodes: tuple[float, ...]) -> _Axis:
    return _Axis(np.array(nodes))
