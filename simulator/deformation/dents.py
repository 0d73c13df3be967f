"""Deformation of the layer by presses: superposed axisymmetric dents and their corrections."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from eitskin.compiled import compiled
from eitskin.geometry.deformation.kinematics import Deformation, Gradients, OnePass, Points, mapped
from eitskin.simulator.deformation.contact import ContactFrame
from eitskin.simulator.deformation.press_table import TabulatedDent

Array = NDArray[np.float64]

_AT_ONCE = 30_000  # distances per chunk, so that all arrays stay in the processor's cache
_HAIR = 1e-9  # [m]


class Dent(Protocol):
    """Axisymmetric displacement of the layer about a vertical axis."""

    @property
    def reach(self) -> float:
        """Distance from the axis beyond which nothing moves [m]."""
        ...

    def motion(self, r: Array, z: Array) -> Array:
        """u, w, du/dz, dw/dz, du/dr and dw/dr, (..., n, 6, h): u outwards and w upwards [m].

        At distances r > 0 (..., n) from the axis and heights z (n, h) over the layer's bottom [m].
        """
        ...

    def mean_stress(self, r: Array, z: Array) -> Array:
        """Mean stress [Pa], positive in tension, (..., n, h) at r (..., n) and z (n, h)."""
        ...


class ColumnField(Protocol):
    """Field that is evaluated in vertical columns of points (n, h, 3) [m]."""

    def values(self, columns: Array) -> Array:
        """Displacement [m] and mean stress [Pa], (4, h, n)."""
        ...

    def moved(self, columns: Array) -> Array:
        """Displacement [m] and its derivatives by x, y, z, (12, h, n)."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class PlacedDent:
    """Dent at (x, y) of the flat sensor [m]."""

    x: float
    y: float
    dent: Dent


@dataclass(frozen=True, slots=True, eq=False)
class Dents(OnePass):
    """Deformation of the flat layer by presses: dents of the unbounded stack, and corrections.

    All displacements are added up.

    Attributes:
        presses: the dents.
        corrections: of the dents in the finite stack; displacement [m] and mean stress [Pa].
    """

    presses: tuple[PlacedDent, ...]
    corrections: tuple[ColumnField, ...] = ()

    def mapped(self, points: Points) -> tuple[Points, Gradients]:
        """Positions and deformation gradient in one pass."""
        columns, shape = _columns(points), points.shape[:-1]
        moved = np.zeros((12, columns.shape[1], len(columns)))
        for field in self.corrections:
            moved += field.moved(columns)
        moved[3::4] += 1.0  # the diagonal of F
        _move(self.presses, columns, moved)
        moved = moved.swapaxes(-2, -1)
        positions = points + np.moveaxis(moved[:3].reshape(3, *shape), 0, -1)
        return positions, np.moveaxis(moved[3:].reshape(3, 3, *shape), (0, 1), (-2, -1))

    def mean_stress(self, points: Points) -> Array:
        """Mean stress [Pa] at flat points (..., 3) [m], (...), positive in tension."""
        columns = _columns(points)
        stress = np.zeros(columns.shape[:2])
        for field in self.corrections:
            stress += field.values(columns)[3].T
        for same in _alike(self.presses):
            for part, _, r in _around(same, columns):
                found = same[0].dent.mean_stress(r, columns[part, :, 2])
                stress[part] += np.where(r[..., None] < same[0].dent.reach, found, 0.0).sum(axis=0)
        return stress.reshape(points.shape[:-1])


@dataclass(frozen=True, slots=True, eq=False)
class BentPresses(OnePass):
    """Bend of the layer, dents turned to its top, and the correction of both in the finite stack.

    All displacements are added up.

    Attributes:
        bend: of the untouched layer.
        presses: dents with their frames.
        correction: displacement [m] and mean stress [Pa], without dents of its own.
    """

    bend: Deformation
    presses: tuple[tuple[ContactFrame, Dent], ...]
    correction: Dents

    def mapped(self, points: Points) -> tuple[Points, Gradients]:
        """Positions and deformation gradient in one pass."""
        positions, F = mapped(self.bend, points)
        corrected, slope = self.correction.mapped(points)
        positions = positions + (corrected - points)
        F = F + (slope - np.eye(3))
        for frame, dents in self._dents():
            stretched = frame.stretched(points)
            pressed, slope = dents.mapped(stretched)
            positions = positions + frame.turned(pressed - stretched)
            F = F + frame.gradient(slope - np.eye(3))
        return positions, F

    def mean_stress(self, points: Points) -> Array:
        """Mean stress by the presses [Pa] at flat points (..., 3) [m], (...)."""
        stress = self.correction.mean_stress(points)
        for frame, dents in self._dents():
            stress = stress + dents.mean_stress(frame.stretched(points))
        return stress

    def _dents(self) -> list[tuple[ContactFrame, Dents]]:
        return [
            (frame, Dents((PlacedDent(frame.x, frame.y, dent),))) for frame, dent in self.presses
        ]


def _alike(presses: Iterable[PlacedDent]) -> Iterable[list[PlacedDent]]:
    """Presses grouped by their dent."""
    alike: dict[int, list[PlacedDent]] = {}
    for press in presses:
        alike.setdefault(id(press.dent), []).append(press)
    return alike.values()


def _move(presses: tuple[PlacedDent, ...], columns: Points, moved: Array) -> None:
    """Add displacements and their derivatives, 3 and 3 x 3, to `moved` (12, h, n)."""
    kernels = compiled("eitskin.simulator.deformation.kernels")
    plain = []
    for press in presses:
        if kernels is not None and isinstance(press.dent, TabulatedDent) and _are_even(columns):
            pieces = press.dent.at_heights(columns[0, :, 2])
            by_piece = np.ascontiguousarray(pieces.c.swapaxes(0, 1))
            axes = columns[:, 0, :2].T.copy()
            kernels.add_dent(
                (float(press.x), float(press.y)), *axes, pieces.x, by_piece, _HAIR, moved
            )
        else:
            plain.append(press)
    for same in _alike(plain):
        for part, way, r in _around(same, columns):
            motion = same[0].dent.motion(r, columns[part, :, 2])
            upright = np.ascontiguousarray(np.moveaxis(motion, (2, 0, 3, 1), (0, 1, 2, 3)))
            _add(upright, way, r, moved[..., part])


def _are_even(columns: Points) -> bool:
    """Whether the heights are the same in all columns."""
    heights = columns[..., 2]
    return bool(len(heights)) and bool((heights == heights[:1]).all())


def _around(
    same: list[PlacedDent], columns: Points
) -> Iterator[tuple[slice, tuple[Array, Array], Array]]:
    """Chunks of the columns with offsets and distances from k dents, (k, n) [m].

    Offsets from each axis are along x and y; a point on an axis is moved aside by `_HAIR`.
    """
    axes = np.array([(press.x, press.y) for press in same])
    most = max(1, _AT_ONCE // len(same))
    for start in range(0, len(columns), most):
        part = slice(start, start + most)
        dx, dy = (columns[None, part, 0, axis] - axes[:, axis, None] for axis in (0, 1))
        r = np.sqrt(dx**2 + dy**2)
        felt = r.min(axis=1) < same[0].dent.reach
        if not felt.all():
            dx, dy, r = (each[felt] for each in (dx, dy, r))
        on_axis = r < _HAIR
        if on_axis.any():
            dx[on_axis], dy[on_axis], r[on_axis] = _HAIR, 0.0, _HAIR
        if len(r):
            yield part, (dx, dy), r


def _add(motion: Array, way: tuple[Array, Array], r: Array, moved: Array) -> None:
    """Add the motion (6, k, h, n) around k dents to displacements and gradients (12, h, n).

    With direction (c, s), F_xx = du/dr c^2 + u/r s^2 and so on: only c and s depend on azimuth.
    """
    u, F = moved[:3], moved[3:].reshape(3, 3, *moved.shape[1:])
    one = np.ones_like(r)
    c, s = way[0] / r, way[1] / r
    cc, ss, cs = c * c, s * s, c * s
    outward = _totals((c, s, ss / r, cc / r, -cs / r), motion[0])
    radial = _totals((cc, ss, cs), motion[4])
    u[:2] += outward[:2]
    u[2] += _totals((one,), motion[1])[0]
    F[0, 0] += outward[2] + radial[0]
    F[1, 1] += outward[3] + radial[1]
    across = outward[4] + radial[2]
    F[0, 1] += across
    F[1, 0] += across
    F[:2, 2] += _totals((c, s), motion[2])
    F[2, :2] += _totals((c, s), motion[5])
    F[2, 2] += _totals((one,), motion[3])[0]


def _totals(factors: tuple[Array, ...], values: Array) -> Array:
    """Sums (f, h, n) over dents of factors (k, n) times values (k, h, n)."""
    totals: Array = np.einsum("fkn,khn->fhn", np.stack(factors), values)
    return totals


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
