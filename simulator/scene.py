"""What happens to the sensor at one moment: how it is bent and where it is pressed."""

from dataclasses import dataclass, field
from pathlib import Path

from eitskin.geometry import Bend
from eitskin.geometry.config import read_toml
from eitskin.simulator.touch import Touch


@dataclass(frozen=True, slots=True)
class Scene:
    """One moment of one sensor; `Scene()` is the flat, untouched sensor.

    Attributes:
        bend: how the sensor is bent; zero degrees when omitted.
        touches: presses on the top side, in coordinates of the flat sensor.
    """

    bend: Bend = field(default_factory=lambda: Bend(0.0))
    touches: tuple[Touch, ...] = ()

    @classmethod
    def from_toml(cls, path: str | Path) -> "Scene":
        """Read a scene; raises ConfigurationError for anything that does not fit."""
        return read_toml(cls, path)
