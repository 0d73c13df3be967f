"""How presses deform the flat layer: dents of revolution, side by side."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from eitskin.geometry.deformation import Gradients, Points

Array = NDArray[np.float64]

_AT_ONCE = 20_000  # distances, so that what is known of them stays in the processor's memory
_HAIR = 1e-9  # [m]


class Dent(Protocol):
    """A displacement of the layer that is symmetric about an upright axis."""

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


@dataclass(frozen=True, slots=True, eq=False)
class Placed:
    """A dent at (x, y) of the flat sensor [m], times a sign."""

    x: float
    y: float
    dent: Dent
    sign: float = 1.0


@dataclass(frozen=True, slots=True)
class Dents:
    """The deformation of the flat layer by presses, displacements superposed.

    Each keeps the volume; several do up to the product of their strains where they overlap. Dents
    are those of an unbounded layer; what its rim does is up to images beyond it.
    """

    presses: tuple[Placed, ...]

    def positions(self, points: Points) -> Points:
        """Deformed places [m], (..., 3), of flat points [m], (..., 3)."""
        return self.mapped(points)[0]

    def gradient(self, points: Points) -> Gradients:
        """Deformation gradient, (..., 3, 3)."""
        return self.mapped(points)[1]

    def mapped(self, points: Points) -> tuple[Points, Gradients]:
        """Both at once, for little more than either costs."""
        columns, shape = _columns(points), points.shape[:-1]
        count, height, _ = columns.shape
        u, F = np.zeros((3, height, count)), np.zeros((3, 3, height, count))
        F[0, 0] = F[1, 1] = F[2, 2] = 1.0
        most = max(1, _AT_ONCE // max(1, len(self.presses)))
        for start in range(0, len(columns), most):
            part = slice(start, start + most)
            for dent, signs, way, r in self._around(columns[part]):
                motion = dent.motion(r, columns[part, :, 2])
                upright = np.ascontiguousarray(np.moveaxis(motion, (2, 0, 3, 1), (0, 1, 2, 3)))
                _add(upright, signs, way, r, u[..., part], F[..., part])
        moved, gradients = (each.swapaxes(-2, -1) for each in (u, F))
        places = points + np.moveaxis(moved.reshape(3, *shape), 0, -1)
        return places, np.moveaxis(gradients.reshape(3, 3, *shape), (0, 1), (-2, -1))

    def mean_stress(self, points: Points) -> Array:
        """Mean stress [Pa] at flat points (..., 3) [m], (...), positive in tension."""
        columns = _columns(points)
        stress = np.zeros(columns.shape[:2])
        for dent, signs, _, r in self._around(columns):
            found = dent.mean_stress(r, columns[..., 2])
            stress += np.tensordot(signs, np.where(r[..., None] < dent.reach, found, 0.0), axes=1)
        return stress.reshape(points.shape[:-1])

    def _around(self, columns: Points) -> Iterator[tuple[Dent, Array, tuple[Array, Array], Array]]:
        """Dents that differ, signs (k,) of what is alike, and the way to columns [m].

        Along x and y and as distance, (k, n) each; on the axis, a hair's breadth beside it.
        """
        alike: dict[int, list[Placed]] = {}
        for press in self.presses:
            alike.setdefault(id(press.dent), []).append(press)
        for same in alike.values():
            places = np.array([(press.x, press.y) for press in same])
            signs = np.array([press.sign for press in same])
            dx, dy = (columns[None, :, 0, axis] - places[:, axis, None] for axis in (0, 1))
            r = np.sqrt(dx**2 + dy**2)
            felt = r.min(axis=1, initial=np.inf) < same[0].dent.reach
            if not felt.all():
                signs, dx, dy, r = (each[felt] for each in (signs, dx, dy, r))
            on_axis = r < _HAIR
            if on_axis.any():
                dx[on_axis], dy[on_axis], r[on_axis] = _HAIR, 0.0, _HAIR
            if len(signs):
                yield same[0].dent, signs, (dx, dy), r


def _add(
    motion: Array, signs: Array, way: tuple[Array, Array], r: Array, u: Array, F: Gradients
) -> None:
    """Add the motion (6, k, h, n) around k dents to u (3, h, n) and F (3, 3, h, n).

    With direction (c, s), F_xx = du/dr c^2 + u/r s^2 and so on: only these depend on the way.
    """
    one = np.broadcast_to(signs[:, None], r.shape)
    cos, sin = way[0] / r, way[1] / r
    c, s = one * cos, one * sin
    cc, ss, cs = c * cos, s * sin, c * sin
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
