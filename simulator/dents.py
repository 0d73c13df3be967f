"""How presses deform the flat layer: dents of revolution, side by side."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from eitskin.geometry.deformation import Gradients, Points
from eitskin.simulator.smooth_field import Box, SmoothField

Array = NDArray[np.float64]

_AT_ONCE = 20_000  # distances, so that what is known of them stays in the processor's memory
# Dents farther from the layer than 5 times its thickness are interpolated, by polynomials of these
# numbers along x, y and z: to 2e-5 of the strain, where dents end at 1e-4 of their depth.
_FAR = 5.0
_DEGREES = (12, 6, 6)


class Motion(NamedTuple):
    """A dent's displacement u outwards and w upwards [m] and their derivatives, each (...).

    Attributes:
        outward, upward: u and w [m].
        hoop: u / r.
        radial, shear: du/dr and du/dz.
        tilt, stretch: dw/dr and dw/dz.
    """

    outward: Array
    upward: Array
    hoop: Array
    radial: Array
    shear: Array
    tilt: Array
    stretch: Array


class Dent(Protocol):
    """A displacement of the layer that is symmetric about an upright axis.

    Distances r (..., n, 1) and heights z (n, h) may be of any shapes that broadcast.
    """

    @property
    def reach(self) -> float:
        """Distance from the axis beyond which nothing moves [m]."""
        ...

    def motion(self, r: Array, z: Array) -> Motion:
        """How points at distance r from the axis and height z over the layer's bottom move [m]."""
        ...

    def mean_stress(self, r: Array, z: Array) -> Array:
        """Mean stress [Pa], positive in tension."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class Placed:
    """A dent at (x, y) of the flat sensor [m], times a sign."""

    x: float
    y: float
    dent: Dent
    sign: float = 1.0


@dataclass(frozen=True, eq=False)
class Dents:
    """The deformation of the flat layer by presses, displacements superposed.

    Each keeps the volume; several do up to the product of their strains where they overlap. Dents
    are those of an unbounded layer; what its rim does is up to images beyond it. What images far
    outside the layer do to it is smooth: it is found at a few places and interpolated.

    Attributes:
        presses: the dents.
        box: around the layer; without it every dent counts as near.
    """

    presses: tuple[Placed, ...]
    box: Box | None = None

    def positions(self, points: Points) -> Points:
        """Deformed places [m], (..., 3), of flat points [m], (..., 3)."""
        return self.mapped(points)[0]

    def gradient(self, points: Points) -> Gradients:
        """Deformation gradient, (..., 3, 3)."""
        return self.mapped(points)[1]

    def mapped(self, points: Points) -> tuple[Points, Gradients]:
        """Both at once, for little more than either costs."""
        columns = _columns(points)
        near, far = self._parts
        moved = np.zeros((12, *columns.shape[:2])) if far is None else far(columns)
        _add(near, columns, moved)
        moved[3::4] += 1.0  # the diagonal of F
        shape = points.shape[:-1]
        places = points + np.moveaxis(moved[:3].reshape(3, *shape), 0, -1)
        return places, np.moveaxis(moved[3:].reshape(3, 3, *shape), (0, 1), (-2, -1))

    def mean_stress(self, points: Points) -> Array:
        """Mean stress [Pa] at flat points (..., 3) [m], (...), positive in tension."""
        columns = _columns(points)
        stress = np.zeros(columns.shape[:2])
        for dent, signs, across in _alike(self.presses, columns):
            r = np.linalg.norm(across, axis=-1)[..., None]
            found = np.where(r < dent.reach, dent.mean_stress(r, columns[..., 2]), 0.0)
            stress += np.tensordot(signs, found, axes=1)
        return stress.reshape(points.shape[:-1])

    @cached_property
    def _parts(self) -> tuple[tuple[Placed, ...], SmoothField | None]:
        """Dents that are near the layer, and the displacement and its derivative by the others."""
        if self.box is None:
            return self.presses, None
        far_away = _FAR * (self.box.high[2] - self.box.low[2])
        near: list[Placed] = []
        far: list[Placed] = []
        for press in self.presses:
            beyond = self.box.distance(press.x, press.y) > far_away
            (far if beyond else near).append(press)
        if not far:
            return self.presses, None

        def moved(columns: Points) -> Array:
            found = np.zeros((12, *columns.shape[:2]))
            _add(tuple(far), columns, found)
            return found

        return tuple(near), SmoothField.of(moved, self.box, _DEGREES)


def _add(presses: tuple[Placed, ...], columns: Points, moved: Array) -> None:
    """Add displacements and their derivatives, 3 and 3 x 3, to `moved` (12, n, h)."""
    most = max(1, _AT_ONCE // max(1, len(presses)))
    for start in range(0, len(columns), most):
        part = slice(start, start + most)
        for dent, signs, across in _alike(presses, columns[part]):
            r = np.hypot(across[..., 0], across[..., 1])
            felt = r.min(axis=1, initial=np.inf) < dent.reach
            if felt.any():
                motion = dent.motion(r[felt, :, None], columns[part, :, 2])
                _sum(motion, signs[felt], across[felt], r[felt], moved[:, part])


def _alike(presses: tuple[Placed, ...], columns: Points) -> Iterator[tuple[Dent, Array, Array]]:
    """Dents that differ, signs (k,) of what is alike, and the way to columns, (k, n, 2) [m]."""
    alike: dict[int, list[Placed]] = {}
    for press in presses:
        alike.setdefault(id(press.dent), []).append(press)
    for same in alike.values():
        places = np.array([(press.x, press.y) for press in same])
        signs = np.array([press.sign for press in same])
        yield same[0].dent, signs, columns[None, :, 0, :2] - places[:, None]


def _sum(m: Motion, signs: Array, across: Array, r: Array, moved: Array) -> None:
    """Add the motion around k dents, at `across` (k, n, 2) and r (k, n) from their axes."""
    on_axis = r == 0.0  # where every direction is radial
    way = across / np.where(on_axis, 1.0, r)[..., None]
    cos, sin = np.where(on_axis, 1.0, way[..., 0]), way[..., 1]
    signs = np.broadcast_to(signs[:, None], r.shape)
    c, s = signs * cos, signs * sin
    stretched = m.radial - m.hoop
    hoop, sheared = _total(m.hoop, signs), _total(stretched, c * sin)
    u, F = moved[:3], moved[3:].reshape(3, 3, *moved.shape[1:])
    for place, values, factors in (
        (u[0], m.outward, c),
        (u[1], m.outward, s),
        (u[2], m.upward, signs),
        (F[0, 0], stretched, c * cos),
        (F[1, 1], stretched, s * sin),
        (F[2, 2], m.stretch, signs),
        (F[0, 2], m.shear, c),
        (F[1, 2], m.shear, s),
        (F[2, 0], m.tilt, c),
        (F[2, 1], m.tilt, s),
    ):
        np.add(place, _total(values, factors), out=place)
    F[0, 0] += hoop
    F[1, 1] += hoop
    F[0, 1] += sheared
    F[1, 0] += sheared


def _total(values: Array, factors: Array) -> Array:
    """Sums (n, h) over dents of values (k, n, h) times factors (k, n)."""
    total: Array = np.einsum("knh,kn->nh", values, factors)
    return total


def _columns(points: Points) -> Points:
    """Points (n, h, 3), those of a row above each other, so that each distance is needed once.

    Quadrature points of upright cells come in such columns; others stand by themselves, h = 1.
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
