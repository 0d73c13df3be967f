"""How presses deform the flat layer: dents of revolution, side by side."""

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from eitskin.geometry.deformation import Gradients, Points

Array = NDArray[np.float64]


class Strains(NamedTuple):
    """Derivatives of a dent's displacement u outwards and w upwards, each (...).

    Attributes:
        hoop: u / r.
        radial, shear: du/dr and du/dz.
        tilt, upward: dw/dr and dw/dz.
    """

    hoop: Array
    radial: Array
    shear: Array
    tilt: Array
    upward: Array


class Dent(Protocol):
    """A displacement of the layer that is symmetric about an upright axis.

    Distances r and heights z may be arrays of any shapes that broadcast.
    """

    @property
    def reach(self) -> float:
        """Distance from the axis beyond which nothing moves [m]."""
        ...

    def displacement(self, r: Array, z: Array) -> tuple[Array, Array]:
        """u and w [m] at distance r from the axis and height z over the layer's bottom [m]."""
        ...

    def strains(self, r: Array, z: Array) -> Strains:
        """Their derivatives."""
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

    def near(self, columns: Points) -> tuple[NDArray[np.int64], Array, Array, Array]:
        """Which columns of points (n, h, 3) it moves, their offsets in x and y, and distances."""
        across = columns[:, :1, :2] - (self.x, self.y)
        r = np.hypot(across[..., 0], across[..., 1])
        near = np.flatnonzero(r[:, 0] < self.dent.reach)
        return near, across[near, :, 0], across[near, :, 1], r[near]


@dataclass(frozen=True, slots=True)
class Dents:
    """The deformation of the flat layer by presses, displacements superposed.

    Each keeps the volume; several do up to the product of their strains where they overlap. Dents
    are those of an unbounded layer; what its rim does is up to images beyond it.
    """

    presses: tuple[Placed, ...]

    def positions(self, points: Points) -> Points:
        """Deformed places [m], (..., 3), of flat points [m], (..., 3)."""
        columns = _columns(points)
        moved = columns.copy()
        for press in self.presses:
            near, dx, dy, r = press.near(columns)
            u, w = (press.sign * part for part in press.dent.displacement(r, columns[near, :, 2]))
            outward = u / np.maximum(r, 1e-12)
            moved[near] += np.stack(np.broadcast_arrays(outward * dx, outward * dy, w), axis=-1)
        return moved.reshape(points.shape)

    def gradient(self, points: Points) -> Gradients:
        """Deformation gradient, (..., 3, 3)."""
        columns = _columns(points)
        shape = columns.shape[:2]
        xx, yy, zz = (np.ones(shape) for _ in range(3))
        xy, xz, yz, zx, zy = (np.zeros(shape) for _ in range(5))
        for press in self.presses:
            near, dx, dy, r = press.near(columns)
            strains = press.dent.strains(r, columns[near, :, 2])
            hoop, radial, shear, tilt, upward = (press.sign * part for part in strains)
            on_axis = r == 0.0  # where every direction is radial
            cos = np.where(on_axis, 1.0, dx / np.where(on_axis, 1.0, r))
            sin = np.where(on_axis, 0.0, dy / np.where(on_axis, 1.0, r))
            xx[near] += hoop + (radial - hoop) * cos**2
            yy[near] += hoop + (radial - hoop) * sin**2
            zz[near] += upward
            xy[near] += (radial - hoop) * (cos * sin)
            xz[near] += shear * cos
            yz[near] += shear * sin
            zx[near] += tilt * cos
            zy[near] += tilt * sin
        F = np.stack([xx, xy, xz, xy, yy, yz, zx, zy, zz], axis=-1)
        return F.reshape(*points.shape, 3)

    def mean_stress(self, points: Points) -> Array:
        """Mean stress [Pa] at flat points (..., 3) [m], (...), positive in tension."""
        columns = _columns(points)
        stress = np.zeros(columns.shape[:2])
        for press in self.presses:
            near, _, _, r = press.near(columns)
            stress[near] += press.sign * press.dent.mean_stress(r, columns[near, :, 2])
        return stress.reshape(points.shape[:-1])


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
