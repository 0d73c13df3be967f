"""What happens to the sensor at one moment: how it is bent and where it is pressed."""

from dataclasses import dataclass, field
from pathlib import Path

from eitskin.geometry import Bend
from eitskin.geometry.config import read_toml
from eitskin.geometry.twist import Roll, Twist
from eitskin.simulator.touch import Touch


@dataclass(frozen=True, slots=True)
class Scene:
    """One moment of one sensor; `Scene()` is the flat, untouched sensor.

    Attributes:
        bend: how the sensor is bent by its fixture; zero degrees when omitted.
        touches: presses on the top side, in coordinates of the flat sensor.
        roll: how it is curled across its width, before it is bent; flat when omitted.
        twist: how it is twisted about its long axis, after all else; not at all when omitted.
    """

    bend: Bend = field(default_factory=lambda: Bend(0.0))
    touches: tuple[Touch, ...] = ()
    roll: Roll | None = None
    twist: Twist | None = None

    @classmethod
    def from_toml(cls, path: str | Path) -> "Scene":
        """Read a scene; raises ConfigurationError for anything that does not fit."""
        return read_toml(cls, path)
