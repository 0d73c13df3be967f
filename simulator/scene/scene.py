"""Scene: bend, roll, twist, touches and support of a sensor at one moment."""

import math
from dataclasses import dataclass, field
from itertools import combinations
from pathlib import Path

from eitskin.config import read_toml
from eitskin.errors import ConfigurationError
from eitskin.geometry.deformation.fixtures import Bend
from eitskin.geometry.deformation.twist import Roll, Twist
from eitskin.geometry.design.support import Support
from eitskin.simulator.scene.touch import Touch


@dataclass(frozen=True, slots=True)
class Scene:
    """Scene of one moment; `Scene()` is the flat, untouched sensor.

    Attributes:
        bend: of the sensor by its fixture; zero degrees when omitted.
        touches: presses on the top side, in coordinates of the flat sensor.
        roll: of the sensor across its width, before the bend; flat when omitted.
        twist: about the long axis, after roll and bend; none when omitted.
        support: of the sensor's bottom face, instead of the design's; the design's when omitted.
    """

    bend: Bend = field(default_factory=lambda: Bend(0.0))
    touches: tuple[Touch, ...] = ()
    roll: Roll | None = None
    twist: Twist | None = None
    support: Support | None = None

    def __post_init__(self) -> None:
        """Raise ConfigurationError for indenters that overlap."""
        pressing = [touch for touch in self.touches if not touch.released]
        for one, other in combinations(pressing, 2):
            apart = math.dist((one.x, one.y), (other.x, other.y))
            least = one.indenter.rims[1] + other.indenter.rims[1]
            if apart < least * (1.0 - 1e-9):
                raise ConfigurationError(
                    f"touches at ({one.x:g}, {one.y:g}) and ({other.x:g}, {other.y:g}) m are "
                    f"{apart:g} m apart, but their indenters need {least:g} m"
                )

    @property
    def bends(self) -> bool:
        """Whether the sensor is bent, rolled or twisted."""
        parts = (self.bend, self.roll, self.twist)
        return any(part is not None and part.angle_deg for part in parts)

    @classmethod
    def from_toml(cls, path: str | Path) -> "Scene":
        """Read a scene from a TOML file; raises ConfigurationError where the file is invalid."""
        return read_toml(cls, path)
