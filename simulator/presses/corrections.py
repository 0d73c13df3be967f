"""Corrections of presses on one sensor, interpolated between tables of solved stacks."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from eitskin.errors import ConfigurationError
from eitskin.geometry.design.outline import Polygon, Rectangle
from eitskin.simulator.presses.correction_table import SAME, CorrectionTable
from eitskin.simulator.presses.disc_table import DiscTable
from eitskin.simulator.presses.edge_table import EdgeTable
from eitskin.simulator.presses.fields.edge_field import EdgeField, sides_of
from eitskin.simulator.presses.fields.smooth_field import SmoothField
from eitskin.simulator.presses.fields.spline_field import SplineField
from eitskin.simulator.presses.fields.turned_field import TurnedField
from eitskin.simulator.presses.pair_sides import PairSides
from eitskin.simulator.presses.pair_table import PairTable, Place

Array = NDArray[np.float64]

_BEYOND = 0.02  # of the deepest solved press, by which another may be deeper


@dataclass(frozen=True, slots=True, eq=False)
class DiscCorrections:
    """Corrections of presses on one disc: weighted sums of those of solved stacks.

    Attributes:
        height: of the gel [m].
        base: table of the solved stack nearest to the sensor's.
        tables: of solved stacks with their weights, which add up to 1.
    """

    height: float
    base: DiscTable
    tables: tuple[tuple[DiscTable, float], ...]

    def at(self, x: float, y: float, depth: float) -> tuple[tuple[TurnedField, ...], float]:
        """Fields of the correction of a press at (x, y) to a depth [m], and how much it sinks [m].

        Raises ConfigurationError for a press that overhangs the stack or is deeper than the tables.
        """
        self.check_depth(depth)
        _require_covered(x, y, self.base)
        fields, sunk = [], 0.0
        for table, weight in self.tables:
            higher = self.height / float(table.height)
            turned, more = table.at(x, y, depth / higher)
            field = turned.field.raised(higher).scaled(weight)
            fields.append(replace(turned, field=field))
            sunk += weight * higher * more
        return tuple(fields), sunk

    def check_depth(self, depth: float) -> None:
        """Raise ConfigurationError for a depth [m] beyond the tables."""
        _require_depth(depth, self.height, self.base)


@dataclass(frozen=True, slots=True, eq=False)
class SideCorrections:
    """Corrections of presses on an outline of straight sides: sums over the sides in reach.

    Attributes:
        height: of the gel [m].
        thickness: of the whole stack [m].
        outline: of the gel.
        base: table of the solved stack nearest to the sensor's.
        tables: of solved stacks with their weights, which add up to 1, or to 0 for a change.
    """

    height: float
    thickness: float
    outline: Polygon | Rectangle
    base: EdgeTable
    tables: tuple[tuple[EdgeTable, float], ...]

    def at(self, x: float, y: float, depth: float) -> tuple[tuple[EdgeField, ...], float]:
        """Fields of the correction of a press at (x, y) to a depth [m], and how much it sinks [m].

        Raises ConfigurationError for a press that overhangs the stack or is deeper than the tables.
        """
        self.check_depth(depth)
        least = float(self.base.aside[0])
        if float(self.outline.nearest(np.array([x, y]))[1]) < least - SAME:
            raise _uncovered(x, y, least)
        sides = list(sides_of(self.outline, x, y, self.base.reach))
        corrections, sunk = self._beside([side.aside for side in sides], depth)
        fields, total = [], 0.0
        for side, coefficients, more in zip(sides, corrections, sunk.tolist(), strict=True):
            field = SplineField(self.base.nodes, self.height, coefficients)
            fields.append(EdgeField.of(field, side, float(self.base.middle), self.thickness))
            total += more * fields[-1].weight_at(x, y)
        return tuple(fields), total

    def _beside(self, aside: list[float], depth: float) -> tuple[Array, Array]:
        """Coefficients at distances from sides without ends, and how much a press sinks [m]."""
        corrections, sunk = (
            np.zeros((len(aside), *self.base.fields.shape[2:])),
            np.zeros(len(aside)),
        )
        for table, weight in self.tables if aside else ():
            higher = self.height / float(table.height)
            found, more = table.at(aside, depth / higher)
            corrections += found * (weight * np.array([1.0, 1.0, higher, 1.0], found.dtype))
            sunk += weight * higher * more
        return corrections, sunk

    def check_depth(self, depth: float) -> None:
        """Raise ConfigurationError for a depth [m] beyond the tables."""
        _require_depth(depth, self.height, self.base)


@dataclass(frozen=True, slots=True, eq=False)
class Corrections:
    """Corrections of presses on one rectangle: those of a solved stack, and how others differ.

    Attributes:
        height: of the gel [m].
        base: table of the solved stack.
        change: by other heights and moduli than the solved stack's, beside each side; its weights
            add up to 0. None for the solved stack.
    """

    height: float
    base: CorrectionTable
    change: SideCorrections | None = None

    def at(
        self, x: float, y: float, depth: float
    ) -> tuple[tuple[SmoothField | SplineField, ...], float]:
        """Fields of the correction of a press at (x, y) to a depth [m], and how much it sinks [m].

        Raises ConfigurationError for a press that overhangs the stack or is deeper than the tables.
        """
        self.check_depth(depth)
        _require_covered(x, y, self.base)
        higher = self.height / float(self.base.height)
        solved, sunk = self.base.at(x, y, depth / higher)
        fields, sunk = [field.raised(higher) for field in solved], higher * sunk
        if self.change is None:
            return tuple(fields), sunk
        # A right corner throws back all of a side's field, which thus is that of the whole line.
        beside, more = self.change.at(x, y, depth)
        return (*fields, *(field.turned.straightened() for field in beside)), sunk + more

    def check_depth(self, depth: float) -> None:
        """Raise ConfigurationError for a depth [m] beyond the tables."""
        _require_depth(depth, self.height, self.base)


AnyCorrections = Corrections | DiscCorrections | SideCorrections


@dataclass(frozen=True, slots=True, eq=False)
class PairCorrections:
    """Change of two presses by each other on one sensor.

    Attributes:
        wide: on a wide stack.
        sides: what the sides add; None where they are left out.
    """

    wide: PairTable
    sides: PairSides | None

    def at(
        self, first: Place, second: Place
    ) -> tuple[tuple[TurnedField | SmoothField, ...], float]:
        """Fields of presses (x, y, depth) [m], and by how much deeper each sinks [m].

        No fields where the presses do not feel each other.
        """
        found = self.wide.at(first, second)
        if found is None:
            return (), 0.0
        field, sunk = found
        beside = None if self.sides is None else self.sides.at(first, second)
        return (field,) if beside is None else (field, beside), sunk


def _uncovered(x: float, y: float, least: float) -> ConfigurationError:
    """Error of a press at (x, y) that is nearer to the edge than the least distance [m]."""
    return ConfigurationError(
        f"a touch must keep {1e3 * least:.1f} mm from the edge of the gel, so that "
        f"its contact stays on the stack, got ({x:g}, {y:g}) m; press farther in"
    )


def _require_covered(x: float, y: float, table: CorrectionTable | DiscTable) -> None:
    """Raise ConfigurationError unless the contact of a press at (x, y) [m] is on the stack."""
    if not table.covers(x, y):
        raise _uncovered(x, y, float(table.aside[0]))


def _require_depth(
    depth: float, height: float, table: CorrectionTable | DiscTable | EdgeTable
) -> None:
    """Raise ConfigurationError for a depth [m] beyond a table, on a gel of a height [m]."""
    deepest = height / float(table.height) * float(table.depths[-1])
    if depth > deepest * (1.0 + _BEYOND):
        raise ConfigurationError(
            f"touches are tabulated to a depth of {1e3 * deepest:.2f} mm, got "
            f"{1e3 * depth:.2f} mm; press less, or solve scenes with touch_model='solved'"
        )
