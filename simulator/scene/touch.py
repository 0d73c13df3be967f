"""Touch: a press of an indenter on the touched side of the sensor."""

import math
from dataclasses import dataclass, field
from typing import TypeAlias

from eitskin.errors import ConfigurationError
from eitskin.simulator.scene.indenters import Cylinder, Profile, Sphere
from eitskin.simulator.scene.scanned_indenter import ScannedIndenter

DEFAULT_FORCE = 10.0
AnyIndenter: TypeAlias = Cylinder | Sphere | Profile | ScannedIndenter


@dataclass(frozen=True, slots=True)
class Touch:
    """Press at (x, y) of the flat sensor, with a force or to a depth.

    Attributes:
        x, y: centre of the indenter [m].
        force: normal force [N]; not used where a depth is given.
        indenter: shape of the indenter.
        depth: of the indenter's lowest point under the undeformed surface, instead of a force [m].
        held: duration of the press until now or until its release [s]. When omitted the press is in
            its first moment, and nothing relaxes.
        released: time since the indenter was taken off [s]; only a fading dent is left.
    """

    x: float
    y: float
    force: float = DEFAULT_FORCE
    indenter: AnyIndenter = field(default_factory=Cylinder)
    depth: float | None = None
    held: float | None = None
    released: float = 0.0

    def __post_init__(self) -> None:
        """Check the numbers; the largest possible force depends on the sensor."""
        if not (math.isfinite(self.x) and math.isfinite(self.y)):
            raise ConfigurationError(f"touch position must be finite, got ({self.x}, {self.y})")
        if not (math.isfinite(self.force) and self.force > 0.0):
            raise ConfigurationError(f"touch force must be above 0 N, got {self.force} N")
        if self.depth is not None:
            if not (math.isfinite(self.depth) and self.depth > 0.0):
                raise ConfigurationError(f"touch depth must be above 0 m, got {self.depth} m")
            if self.force != DEFAULT_FORCE:
                raise ConfigurationError(
                    f"a touch has a force or a depth, got {self.force} N and {self.depth} m"
                )
        for name, seconds in (("held", self.held), ("released", self.released)):
            if seconds is not None and not (math.isfinite(seconds) and seconds >= 0.0):
                raise ConfigurationError(f"{name} must be a time of 0 s or more, got {seconds}")
        if self.released and self.held is None:
            raise ConfigurationError(
                "a touch that was released needs held, the time in s for which it lasted"
            )
