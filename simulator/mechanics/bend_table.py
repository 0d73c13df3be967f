"""Table of bends: equilibria of a clamped stack, interpolated over the angle."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.interpolate import CubicHermiteSpline, CubicSpline

from eitskin.errors import ConfigurationError
from eitskin.simulator.mechanics.bend_3d import BentStack, ClampedStack
from eitskin.simulator.mechanics.quadratic_field import QuadraticField

ANGLES_DEG = (-20.0, -10.0, 0.0, 10.0, 20.0, 30.0, 40.0, 50.0, 60.0, 75.0, 90.0)


@dataclass(frozen=True, eq=False)
class BendTable:
    """Bends of one stack, with displacement as a cubic spline over the angle.

    Attributes:
        solved: equilibria of one stack, by rising angle.
    """

    solved: tuple[BentStack, ...]

    @classmethod
    def of(cls, stack: ClampedStack, angles_deg: Sequence[float] = ANGLES_DEG) -> "BendTable":
        """Solve at all angles, from flat upwards and from flat downwards.

        Raises SolidError where an angle cannot be reached.
        """
        angles = np.unique(np.asarray(angles_deg, dtype=float))
        if len(angles) < 4 or not angles[0] <= 0.0 <= angles[-1]:
            raise ConfigurationError(
                f"a table of bends needs four angles or more, on both sides of 0, got {angles_deg}"
            )
        downwards = list(stack.equilibria(angles[angles < 0.0][::-1].tolist()))
        upwards = list(stack.equilibria(angles[angles >= 0.0].tolist()))
        return cls((*downwards[::-1], *upwards))

    def at(self, angle_deg: float) -> BentStack:
        """Stack bent by an angle within the table [deg]."""
        first, last = self.solved[0], self.solved[-1]
        if not first.angle_deg <= angle_deg <= last.angle_deg:
            raise ConfigurationError(
                f"the table of bends goes from {first.angle_deg:g} to {last.angle_deg:g} deg, got "
                f"{angle_deg:g}; solve it over a wider range"
            )
        lines = first.displacement.lines
        energy = self._energies
        return replace(
            first,
            angle_deg=float(angle_deg),
            displacement=QuadraticField(lines, self._displacements(angle_deg)),
            energy=float(energy(angle_deg)),
            moment=float(np.degrees(energy(angle_deg, 1))),
        )

    @cached_property
    def _displacements(self) -> CubicSpline:
        values = np.stack([bent.displacement.values for bent in self.solved])
        return CubicSpline([bent.angle_deg for bent in self.solved], values)

    @cached_property
    def _energies(self) -> CubicHermiteSpline:
        """Spline of the energy [J] over the angle [deg]; its slopes are the moments."""
        return CubicHermiteSpline(
            [bent.angle_deg for bent in self.solved],
            [bent.energy for bent in self.solved],
            [np.radians(bent.moment) for bent in self.solved],
        )
