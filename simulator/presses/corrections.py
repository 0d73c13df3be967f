"""Corrections of presses on one sensor, interpolated between tables of solved stacks."""

from dataclasses import dataclass, replace

from eitskin.errors import ConfigurationError
from eitskin.simulator.presses.correction_table import CorrectionTable, StripTable
from eitskin.simulator.presses.disc_table import DiscTable
from eitskin.simulator.presses.smooth_field import SmoothField, together
from eitskin.simulator.presses.turned_field import TurnedField

_BEYOND = 0.02  # of the deepest solved press, by which another may be deeper


@dataclass(frozen=True, slots=True, eq=False)
class Corrections:
    """Corrections of presses on one sensor: those of a solved stack, and how others differ.

    Attributes:
        height: of the gel [m].
        base: table of the solved stack.
        strips: tables of neighbouring stacks, with their weights, which add up to 0.
    """

    height: float
    base: CorrectionTable
    strips: tuple[tuple[StripTable, float], ...]

    def at(self, x: float, y: float, depth: float) -> tuple[tuple[SmoothField, ...], float]:
        """Fields of the correction of a press at (x, y) to a depth [m], and how much it sinks [m].

        Raises ConfigurationError for a press that overhangs the stack or is deeper than the tables.
        """
        self.check_depth(depth)
        _require_covered(x, y, self.base)
        higher = self.height / float(self.base.height)
        ends, sunk = self.base.near_ends(x, y, depth / higher)
        fields, sunk = [end.raised(higher) for end in ends], sunk * higher
        for table, weight in ((self.base, 1.0), *self.strips):
            higher = self.height / float(table.height)
            field, more = table.at(x, y, depth / higher)
            fields.append(field.scaled(weight).raised(higher))
            sunk += weight * higher * more
        return tuple(together(fields)), sunk

    def check_depth(self, depth: float) -> None:
        """Raise ConfigurationError for a depth [m] beyond the tables."""
        _require_depth(depth, self.height, self.base)


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


def _require_covered(x: float, y: float, table: CorrectionTable | DiscTable) -> None:
    """Raise ConfigurationError unless the contact of a press at (x, y) [m] is on the stack."""
    if not table.covers(x, y):
        raise ConfigurationError(
            f"a touch must keep {1e3 * table.aside[0]:.1f} mm from the edge of the gel, so that "
            f"its contact stays on the stack, got ({x:g}, {y:g}) m; press farther in"
        )


def _require_depth(depth: float, height: float, table: CorrectionTable | DiscTable) -> None:
    """Raise ConfigurationError for a depth [m] beyond a table, on a gel of a height [m]."""
    deepest = height / float(table.height) * float(table.depths[-1])
    if depth > deepest * (1.0 + _BEYOND):
        raise ConfigurationError(
            f"touches are tabulated to a depth of {1e3 * deepest:.2f} mm, got "
            f"{1e3 * depth:.2f} mm; press less, or solve scenes with touch_model='solved'"
        )
