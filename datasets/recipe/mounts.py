"""Mounts: the clamps and stiffnesses between which the specimens of a recipe differ."""

import dataclasses
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

from eitskin.errors import ConfigurationError
from eitskin.geometry.deformation.fixtures import Clamp
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.simulator.bends import bend_store
from eitskin.simulator.mechanics.layer_stack import Mechanics

MOST_MOUNTS = 1000

# Roberts (2018): powers of the inverse of the root of x^(d + 1) = x + 1 make a sequence that
# fills d dimensions evenly, however many of its points are taken.
_DIMENSIONS = 3
_ROOT = 1.2207440846057596  # of x^4 = x + 1


@dataclass(frozen=True, slots=True)
class Mounts:
    """Different clamps and stiffnesses of the encapsulation, one for each specimen in turn.

    Each is a bend of its own that is solved once, in a quarter of a minute, and shared by all
    specimens that have it; deviations of `Specimens` come on top. Values fill their ranges evenly,
    by an additive recurrence.

    Attributes:
        count: number of mounts; 0 for the fixture of the recipe alone.
        span: range of the free length between the plates [m].
        offset: range of the axis below the mid-plane of the layer [m].
        stiffness: range of the factor on the modulus of the encapsulation, even in its logarithm.
        faces: held by the plates, in turn.
    """

    count: int = 0
    span: tuple[float, float] = (0.040, 0.040)
    offset: tuple[float, float] = (0.008, 0.008)
    stiffness: tuple[float, float] = (1.0, 1.0)
    faces: tuple[Literal["both", "bottom"], ...] = ("both",)

    def clamp(self, number: int) -> Clamp:
        """Clamp of mount `number`."""
        across, along, _ = self._shares(number)
        faces = self.faces[number % len(self.faces)]
        return Clamp(_between(self.span, across), _between(self.offset, along), faces=faces)

    def mechanics(self, number: int, nominal: Mechanics) -> Mechanics:
        """Materials of mount `number`, from the nominal ones."""
        low, high = (math.log(factor) for factor in self.stiffness)
        factor = math.exp(_between((low, high), self._shares(number)[2]))
        law = nominal.encapsulation
        stiffer = dataclasses.replace(law, shear_modulus=factor * law.shear_modulus)
        return dataclasses.replace(nominal, encapsulation=stiffer)

    def problems(self) -> Iterator[str]:
        """Impossible values, a sentence each."""
        if not 0 <= self.count <= MOST_MOUNTS:
            yield f"mounts: count must be from 0 to {MOST_MOUNTS}, got {self.count}"
        for name in ("span", "offset", "stiffness"):
            low, high = getattr(self, name)
            if not (math.isfinite(low) and math.isfinite(high) and low <= high):
                yield f"mounts: {name} must be a range [lowest, highest], got [{low}, {high}]"
            elif name != "offset" and low <= 0.0:
                yield f"mounts: {name} must be positive, got [{low}, {high}]"
        if not self.faces:
            yield 'mounts: faces must name "both" or "bottom", got none'

    def unclampable(self, design: SensorDesign, mechanics: Mechanics) -> Iterator[str]:
        """Reason why sensors like `design` cannot be clamped so, a sentence each."""
        try:
            for number in range(self.count):
                bend_store.check_clamp(
                    design, self.clamp(number), self.mechanics(number, mechanics)
                )
        except ConfigurationError as error:
            yield f"mounts: {error}"

    def _shares(self, number: int) -> tuple[float, ...]:
        """Place of mount `number` in each range, between 0 and 1."""
        steps = (_ROOT ** -(power + 1) for power in range(_DIMENSIONS))
        return tuple((0.5 + (number + 1) * step) % 1.0 for step in steps)


def _between(ends: tuple[float, float], share: float) -> float:
    low, high = ends
    return low + share * (high - low)
