"""Table of bends: equilibria of a clamped stack, interpolated over the angle."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicHermiteSpline, CubicSpline

from eitskin.errors import ConfigurationError
from eitskin.simulator.bends.bend_3d import BentStack, ClampedStack
from eitskin.simulator.bends.bent_layer import BentLayer, Nodes, spline_coefficients
from eitskin.simulator.mechanics.load_stepping import SolidError

Array = NDArray[np.float64]

# Downwards the sensor's lower side is pressed together, and the steps are shorter towards the end:
# from -30 degrees straight to -40 takes three times as many iterations as by way of -35.
ANGLES_DEG = tuple(map(float, (-40, -35, *range(-30, 61, 10), 75, 90)))
_FEWEST = 4
_SAME = 1e-9  # [m]
_INTERPOLATED = ("x", "y", "z", "thickness", "centre", "energies", "moments", "values")


@dataclass(frozen=True, eq=False)
class BendTable:
    """Bends of the gel of one stack, with displacement as a cubic spline over the angle.

    Attributes:
        angles_deg: solved angles, rising, (n,).
        energies: stored in the whole sensor [J], (n,).
        moments: of each plate about the axis [N m], (n,).
        x, y, z: nodes of a quarter of the gel along each axis, from its middle [m].
        values: displacements of the nodes [m], (n, nx, ny, nz, 3).
        thickness: of the whole stack [m], ().
        centre: middle of the gel in the coordinates of the design [m], (3,).
    """

    angles_deg: Array
    energies: Array
    moments: Array
    x: Array
    y: Array
    z: Array
    values: Array
    thickness: Array
    centre: Array

    @classmethod
    def of(
        cls,
        stack: ClampedStack,
        angles_deg: Sequence[float] = ANGLES_DEG,
        progress: Callable[[int, int], None] | None = None,
    ) -> "BendTable":
        """Solve at all angles, from flat upwards and from flat downwards, as far as possible.

        Args:
            stack: the clamped sensor.
            angles_deg: four or more, on both sides of 0 [deg].
            progress: called with the number of solved angles and of all angles.

        Raises SolidError where fewer than four angles can be reached.
        """
        angles = np.unique(np.asarray(angles_deg, dtype=float))
        if len(angles) < _FEWEST or not angles[0] <= 0.0 <= angles[-1]:
            raise ConfigurationError(
                f"a table of bends needs four angles or more, on both sides of 0, got {angles_deg}"
            )
        found: dict[float, BentStack] = {}
        for path in (angles[angles >= 0.0], angles[angles < 0.0][::-1]):
            try:
                for bent in stack.equilibria(path.tolist()):
                    found[bent.angle_deg] = bent
                    if progress:
                        progress(len(found), len(angles))
            except SolidError:
                if len(found) < _FEWEST:
                    raise
        return _tabulated([found[angle] for angle in sorted(found)], stack)

    @property
    def nodes(self) -> Nodes:
        """Nodes of a quarter of the gel."""
        return Nodes(self.x, self.y, self.z, float(self.thickness))

    def check(self, angle_deg: float) -> None:
        """Raise ConfigurationError for an angle outside the table [deg]."""
        first, last = self.angles_deg[[0, -1]]
        if not first <= angle_deg <= last:
            raise ConfigurationError(
                f"this sensor is solved for bends of its clamp from {first:g} to {last:g} deg, got "
                f"{angle_deg:g} deg; bend it less, or choose a kinematic fixture, "
                "fixture=Hinge(...) or fixture=FreeArc(...)"
            )

    def at(self, angle_deg: float) -> BentLayer:
        """Layer bent by an angle within the table [deg].

        Raises ConfigurationError for an angle outside.
        """
        self.check(angle_deg)
        over_angle, energy = _over_angle(self)
        return BentLayer(
            self.nodes,
            over_angle(angle_deg),
            self.centre,
            float(angle_deg),
            float(energy(angle_deg)),
            float(np.degrees(energy(angle_deg, 1))),
        )


@lru_cache(maxsize=8)
def _over_angle(table: BendTable) -> tuple[CubicSpline, CubicHermiteSpline]:
    """Splines of `spline_coefficients` [m] and energy [J] over the angle [deg].

    Moments are the slopes of the energy.
    """
    coefficients = [spline_coefficients(table.nodes, values) for values in table.values]
    return (
        CubicSpline(table.angles_deg, np.stack(coefficients)),
        CubicHermiteSpline(table.angles_deg, table.energies, np.radians(table.moments)),
    )


def weighted_sum(tables: Sequence[BendTable], weights: Array) -> BendTable:
    """Weighted sum of tables whose meshes have equal numbers of cells, at their common angles."""
    common = set.intersection(*(set(table.angles_deg.tolist()) for table in tables))
    angles = np.array(sorted(common))

    def summed(name: str) -> Array:
        arrays = [getattr(table, name) for table in tables]
        if name in ("energies", "moments", "values"):
            arrays = [
                array[np.isin(table.angles_deg, angles)]
                for array, table in zip(arrays, tables, strict=True)
            ]
        return np.tensordot(weights, np.stack(arrays), axes=1)

    return BendTable(angles_deg=angles, **{name: summed(name) for name in _INTERPOLATED})


def arrays_of(table: BendTable) -> dict[str, Array]:
    """Arrays of a table by name."""
    return {field.name: getattr(table, field.name) for field in fields(BendTable)}


def _tabulated(solved: Sequence[BentStack], stack: ClampedStack) -> BendTable:
    """Table of equilibria, at the nodes of the gel."""
    nodes = [
        np.interp(np.arange(2 * len(line) - 1) / 2.0, np.arange(len(line)), line)
        for line in stack.lines
    ]
    inside = [
        np.abs(each) < half + _SAME for each, half in zip(nodes, stack.half_sizes, strict=True)
    ]
    values = np.stack([bent.displacement.values for bent in solved])
    x, y, z = (each[within] for each, within in zip(nodes, inside, strict=True))
    return BendTable(
        angles_deg=np.array([bent.angle_deg for bent in solved]),
        energies=np.array([bent.energy for bent in solved]),
        moments=np.array([bent.moment for bent in solved]),
        x=x,
        y=y,
        z=z,
        values=values[:, inside[0]][:, :, inside[1]][:, :, :, inside[2]],
        thickness=np.array(2.0 * stack.lines[2][-1]),
        centre=np.array(solved[0].centre),
    )
