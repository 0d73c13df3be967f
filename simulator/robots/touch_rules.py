"""Touches that the simulator can take, from points of contact of a physics engine."""

import math
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from itertools import combinations

from eitskin.errors import ConfigurationError
from eitskin.geometry.design.outline import Rectangle
from eitskin.simulator.scene.indenters import Cylinder
from eitskin.simulator.scene.touch import AnyIndenter, Touch


@dataclass(frozen=True, slots=True)
class TouchRules:
    """Which contacts become touches, and within which limits.

    The defaults keep every touch within the tables of the reference sensor.

    Attributes:
        indenter: of all touches; None for the shape of the body that presses: of a sphere or
            capsule its `Sphere`, of a cylinder its flat end, of others the default `Cylinder`.
            Presses by other indenters than the default one are solved scene by scene, which takes
            half a minute each, unless the simulator has `touch_model="tabulated"`.
        least: weakest touch [N]; weaker ones are none.
        most: strongest touch [N]; stronger ones press as strongly as this.
        margin: least distance from the edge of the gel [m]; touches nearer to it are moved in.
    """

    indenter: AnyIndenter | None = field(default_factory=Cylinder)
    least: float = 0.05
    most: float = 12.0
    margin: float = 0.005

    def __post_init__(self) -> None:
        if not 0.0 < self.least < self.most < math.inf:
            raise ConfigurationError(
                f"expected 0 < least < most, forces in N, got {self.least} and {self.most}"
            )
        if not 0.0 <= self.margin < math.inf:
            raise ConfigurationError(f"expected a margin of 0 m or more, got {self.margin}")

    def applied(self, points: Iterable[Touch], outline: Rectangle) -> tuple[Touch, ...]:
        """Touches of the points of contact on a gel of this outline, strongest first.

        Points whose indenters would overlap are one touch: their forces are added, at the mean
        place weighted by force, with the indenter of the strongest.
        """
        margin = min(self.margin, outline.length / 2, outline.width / 2)
        inside = [
            replace(
                point,
                x=min(max(point.x, margin), outline.length - margin),
                y=min(max(point.y, margin), outline.width - margin),
            )
            for point in points
        ]
        strong = [touch for touch in merged(inside) if touch.force >= self.least]
        limited = [replace(touch, force=min(touch.force, self.most)) for touch in strong]
        return tuple(sorted(limited, key=lambda touch: (-touch.force, touch.x, touch.y)))


def merged(touches: Iterable[Touch]) -> list[Touch]:
    """Touches of which no indenters overlap; those that overlap most are merged first."""
    found = list(touches)
    while True:
        overlaps = [
            (_overlap(found[i], found[j]), i, j) for i, j in combinations(range(len(found)), 2)
        ]
        most, i, j = max(overlaps, default=(0.0, 0, 0))
        if most <= 0.0:
            return found
        one, other = found[i], found.pop(j)
        force = one.force + other.force
        share = other.force / force
        strongest = one if one.force >= other.force else other
        found[i] = replace(
            strongest,
            x=one.x + share * (other.x - one.x),
            y=one.y + share * (other.y - one.y),
            force=force,
        )


def _overlap(one: Touch, other: Touch) -> float:
    """Length by which the indenters of two touches overlap [m]; negative where they do not."""
    apart = math.dist((one.x, one.y), (other.x, other.y))
    return one.indenter.rims[1] + other.indenter.rims[1] - apart
