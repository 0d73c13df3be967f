"""Deformation of the layer by presses: superposed axisymmetric dents and their corrections."""

from dataclasses import dataclass
from functools import lru_cache
from types import ModuleType
from typing import Protocol

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import NDArray
from scipy.interpolate import PPoly

from eitskin.compiled import compiled_kernels
from eitskin.geometry.deformation.kinematics import Deformation, Gradients, Points
from eitskin.simulator.deformation.contact import ContactFrame
from eitskin.simulator.deformation.field import Field

Array = NDArray[np.float64]

DEGREE = 5
"""Degree of the polynomials of a dent over the height of the layer."""
# Legendre coefficients of the derivative of a polynomial, from its own.
_DERIVATIVE = np.vstack([legendre.legder(np.eye(DEGREE + 1)), np.zeros(DEGREE + 1)])
# Coefficients of powers, of those of Legendre polynomials.
_POWERS = np.zeros((DEGREE + 1, DEGREE + 1))
for _n in range(DEGREE + 1):
    _POWERS[_n, : _n + 1] = legendre.leg2poly(np.eye(_n + 1)[_n])
_HAIR = 1e-9  # [m]
_UNTURNED = np.concatenate([np.eye(3), np.ones((1, 3))])
KERNELS = "eitskin.simulator.deformation.kernels"


class ColumnField(Protocol):
    """Field that is evaluated in vertical columns of points (n, h, 3) [m]."""

    def values(self, columns: Array) -> Array:
        """Displacement [m] and mean stress [Pa], (4, h, n)."""
        ...

    def displacement_and_gradient(self, columns: Array) -> Array:
        """Displacement [m] and its derivatives by x, y, z, (12, h, n)."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class TabulatedDent:
    """Dent of one press, from a press table.

    Attributes:
        force: force of the indenter [N].
        depth: depth of the indenter's lowest point under the undeformed top of the stack [m].
        contact_radius: radius of the contact area in the deformed stack [m].
        peak_pressure: largest contact pressure [Pa].
        thinning: 1 - thickness over undeformed thickness of the layer, on the axis.
        share: share of the force due to the shear modulus of the layer, (mu / F) dF/dmu.
        thickness: thickness of the undeformed layer [m].
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
        """u, w, du/dz, dw/dz, du/dr and dw/dr, (n, 6, h): u outwards and w upwards [m].

        At distances r > 0 (n,) from the axis and heights z (n, h) over the layer's bottom [m].
        """
        inside = np.minimum(r, self.reach)
        P = self.height_polynomials(z)
        c, slopes = self.profile(inside)[..., :2], self.profile(inside, 1)[..., :2]
        pairs = ((P, c), (self.derivatives(P), c), (P, slopes))
        parts = [np.einsum("nhm,nmf->nfh", Q, v) for Q, v in pairs]
        return np.concatenate(parts, axis=-2)

    def mean_stress(self, r: Array, z: Array) -> Array:
        """Mean stress [Pa], positive in tension, (n, h) at r (n,) and z (n, h)."""
        coefficients = self.profile(np.minimum(r, self.reach))[..., 2]
        return np.asarray(np.einsum("nhm,nm->nh", self.height_polynomials(z), coefficients))

    def derivatives(self, P: Array) -> Array:
        """Derivatives along z [1/m] of the Legendre polynomials with values P (..., m)."""
        return np.asarray(P @ (_DERIVATIVE * (2.0 / self.thickness)))

    def height_polynomials(self, z: Array) -> Array:
        """Legendre polynomials (..., m) at heights z (...) [m]."""
        return np.asarray(legendre.legvander(2.0 * z / self.thickness - 1.0, DEGREE))


@lru_cache(maxsize=16)
def dent_powers(dent: TabulatedDent) -> Array:
    """Piecewise cubics in r of u and w, of the powers 0 to 5 of the level each, (m, 4, 12).

    From the highest power of r. Levels go from -1 to 1 over the height.
    """
    c = np.ascontiguousarray(dent.profile.c.transpose(1, 0, 3, 2)[:, :, :2])
    return np.asarray((c.reshape(-1, DEGREE + 1) @ _POWERS).reshape(len(c), 4, -1))


@dataclass(frozen=True, slots=True, eq=False)
class PlacedDent:
    """Dent at (x, y) of the flat sensor [m], turned to the frame of a bent top where that is given.

    The layer of a bent sensor moves as a flat one in the frame, in which distances from the axis
    are those along the bent top.
    """

    x: float
    y: float
    dent: TabulatedDent
    frame: ContactFrame | None = None

    def displacement_and_gradient(self, columns: Array) -> Array:
        """Displacement [m] and its derivatives by x, y, z, (12, h, n), at columns (n, h, 3)."""
        moved, heights = np.zeros((12, columns.shape[1], len(columns))), columns[..., 2]
        near, (dx, dy), r = self._columns_near(columns)
        motion = np.moveaxis(self.dent.motion(r, heights[near]), (1, 2, 0), (0, 1, 2))
        u, w, u_z, w_z, u_r, w_r = motion
        # Only the direction (c, s) depends on the azimuth.
        c, s, hoop = dx / r, dy / r, u / r
        shear = c * s * (u_r - hoop)
        across = c * c * u_r + s * s * hoop, shear, c * u_z
        along = shear, s * s * u_r + c * c * hoop, s * u_z
        values = np.stack([c * u, s * u, w, *across, *along, c * w_r, s * w_r, w_z])
        if self.frame is not None:
            R, scale = self._turn[:3], self._turn[3]
            G = np.einsum("ij,jk...,k->ik...", R, values[3:].reshape(3, 3, *u.shape), scale)
            values = np.concatenate(
                [np.einsum("ij,j...->i...", R, values[:3]), G.reshape(9, *u.shape)]
            )
        moved[..., near] = values
        return moved

    def accumulate(self, kernels: ModuleType, points: Array, places: Array, F: Array) -> None:
        """Add the displacement to places (n, 3) [m], and its gradient to F (n, 9), at points."""
        dent, place = self.dent, (float(self.x), float(self.y))
        shape = dent.thickness, dent.profile.x, dent_powers(dent)
        kernels.add_dent(place, self._turn, *shape, _HAIR, points, places, F)

    @property
    def _turn(self) -> Array:
        """Rotation to the bent top, and below it factors of distances along x, y and z, (4, 3)."""
        if self.frame is None:
            return _UNTURNED
        return np.stack([*self.frame.rotation, np.append(self.frame.stretches, 1.0)])

    def values(self, columns: Array) -> Array:
        """Displacement [m] and mean stress [Pa], (4, h, n), at columns of points (n, h, 3)."""
        near, _, r = self._columns_near(columns)
        stress = np.zeros((1, columns.shape[1], len(columns)))
        stress[0, :, near] = self.dent.mean_stress(r, columns[near, :, 2])
        return np.concatenate([self.displacement_and_gradient(columns)[:3], stress])

    def _columns_near(self, columns: Array) -> tuple[NDArray[np.bool_], tuple[Array, Array], Array]:
        """Columns in reach, their offsets along x and y, and their distances from the axis [m].

        Points on the axis are moved aside by a hair.
        """
        along, across, _ = self._turn[3]
        dx, dy = along * (columns[:, 0, 0] - self.x), across * (columns[:, 0, 1] - self.y)
        dx = np.where(np.hypot(dx, dy) < _HAIR, _HAIR, dx)
        r = np.sqrt(dx**2 + dy**2)
        near: NDArray[np.bool_] = r < self.dent.reach
        return near, (dx[near], dy[near]), r[near]


@dataclass(frozen=True, slots=True, eq=False)
class Dents(Deformation):
    """Deformation of the flat layer by presses: dents of the unbounded stack, and corrections.

    All displacements are added up.

    Attributes:
        presses: the dents.
        corrections: corrections of the dents in the finite stack; displacement [m] and mean stress
            [Pa].
    """

    presses: tuple[PlacedDent, ...]
    corrections: tuple[ColumnField, ...] = ()

    def map_points(self, points: Points) -> tuple[Points, Gradients]:
        """Positions and deformation gradient in one pass."""
        return self.accumulate(points, points, np.broadcast_to(np.eye(3), (*points.shape, 3)))

    def accumulate(
        self, points: Points, places: Points, gradients: Gradients
    ) -> tuple[Points, Gradients]:
        """Places and gradients of flat points, with displacements and their gradients added."""
        fields = *self.corrections, *self.presses
        if kernels := compiled_kernels(KERNELS):
            flat = np.ascontiguousarray(points, dtype=np.float64).reshape(-1, 3)
            moved = np.array(places, dtype=np.float64, order="C")
            F = np.array(gradients, dtype=np.float64, order="C")
            for field in fields:
                room = moved.reshape(-1, 3), F.reshape(-1, 9)
                if isinstance(field, Field | PlacedDent):
                    field.accumulate(kernels, flat, *room)
                else:
                    more = field.displacement_and_gradient(flat[:, None])[:, 0].T
                    np.add(room[0], more[:, :3], out=room[0])
                    np.add(room[1], more[:, 3:], out=room[1])
            return moved, F
        columns, shape = _columns(points), points.shape[:-1]
        total = np.zeros((12, columns.shape[1], len(columns)))
        for field in fields:
            total += field.displacement_and_gradient(columns)
        total = total.swapaxes(-2, -1)
        F = gradients + np.moveaxis(total[3:].reshape(3, 3, *shape), (0, 1), (-2, -1))
        return places + np.moveaxis(total[:3].reshape(3, *shape), 0, -1), F

    def mean_stress(self, points: Points) -> Array:
        """Mean stress [Pa] at flat points (..., 3) [m], (...), positive in tension."""
        columns = _columns(points)
        stress = np.zeros(columns.shape[:2])
        for field in (*self.corrections, *self.presses):
            stress += field.values(columns)[3].T
        return stress.reshape(points.shape[:-1])


@dataclass(frozen=True, slots=True, eq=False)
class BentPresses(Deformation):
    """Bend of the layer, and dents turned to its top with their corrections.

    All displacements are added up.

    Attributes:
        bend: bend of the untouched layer.
        dents: dents with their frames, and corrections by displacement [m] and mean stress [Pa].
    """

    bend: Deformation
    dents: Dents

    def map_points(self, points: Points) -> tuple[Points, Gradients]:
        """Positions and deformation gradient in one pass."""
        return self.dents.accumulate(points, *self.bend.map_points(points))

    def mean_stress(self, points: Points) -> Array:
        """Mean stress by the presses [Pa] at flat points (..., 3) [m], (...)."""
        return self.dents.mean_stress(points)


def _columns(points: Points) -> Points:
    """Points in vertical columns, (n, h, 3), so that each distance is computed once.

    Quadrature points of upright cells come in such columns; all others in columns of one, h = 1.
    """
    flat = points.reshape(-1, 3)
    height = 1
    while height < len(flat) and np.array_equal(flat[height, :2], flat[0, :2]):
        height += 1
    if len(flat) % height == 0:
        columns = flat.reshape(-1, height, 3)
        if np.array_equal(
            columns[..., :2], np.broadcast_to(columns[:, :1, :2], columns[..., :2].shape)
        ):
            return columns
    return flat[:, None]
