"""Scene: bend, roll, twist, touches and support of a sensor at one moment."""

import math
from dataclasses import dataclass, field
from itertools import combinations
from pathlib import Path
from typing import TypeAlias

import numpy as np

from eitskin.bounds import require_positive
from eitskin.config import read_toml
from eitskin.errors import ConfigurationError
from eitskin.geometry.deformation.fixtures import Bend, Fixture, FreeArc, Roll, Twist
from eitskin.geometry.design.sensor import Free, Plates, Support
from eitskin.simulator.scene.indenters import (
    Cylinder,
    Footprint,
    Profile,
    ScannedIndenter,
    Sphere,
    distance,
)

DEFAULT_FORCE = 10.0
AnyIndenter: TypeAlias = Cylinder | Sphere | Profile | ScannedIndenter | Footprint
_SPAN_TOLERANCE = 1e-9  # difference of spans that count as equal [m]


@dataclass(frozen=True, slots=True)
class Touch:
    """Touch at (x, y) of the flat sensor, with a force or to a depth.

    Attributes:
        x, y: centre of the indenter [m].
        force: normal force [N]; not used where a depth is given.
        indenter: shape of the indenter.
        depth: depth of the indenter's tip below the undeformed top, instead of a force [m].
        held: duration of the touch until now or until its release [s]. When omitted the touch is in
            its first moment, and nothing relaxes.
        released: time since the indenter was taken off [s]; only a fading dent is left.
        before: earlier touches on this place that have not faded: force [N], duration and time
            since the release [s] of each, which is before this touch began.

    Example:
        >>> from eitskin import Touch
        >>> Touch(x=0.050, y=0.020, force=8.0).force
        8.0
    """

    x: float
    y: float
    force: float = DEFAULT_FORCE
    indenter: AnyIndenter = field(default_factory=Cylinder)
    depth: float | None = None
    held: float | None = None
    released: float = 0.0
    before: tuple[tuple[float, float, float], ...] = ()

    def __post_init__(self) -> None:
        """Check the numbers; the largest possible force depends on the sensor."""
        if not (math.isfinite(self.x) and math.isfinite(self.y)):
            raise ConfigurationError(f"touch position must be finite, got ({self.x}, {self.y})")
        require_positive("touch force", self.force, "N")
        if self.depth is not None:
            require_positive("touch depth", self.depth, "m")
            if self.force != DEFAULT_FORCE:
                raise ConfigurationError(
                    f"a touch has a force or a depth, got {self.force} N and {self.depth} m"
                )
        for name, seconds in (("held", self.held), ("released", self.released)):
            if seconds is not None and not (math.isfinite(seconds) and seconds >= 0.0):
                raise ConfigurationError(f"{name} must be a time of 0 s or more, got {seconds}")
        object.__setattr__(self, "before", tuple(map(tuple, self.before)))
        begun = self.released + (self.held or 0.0)
        wrong = [
            each
            for each in self.before
            if len(each) != 3
            or not (min(each) >= 0.0 and max(each) < math.inf)
            or not each[2] > 0.0
            or each[2] < begun * (1.0 - 1e-6)
        ]
        if wrong or (self.before and (self.held is None or self.depth is not None)):
            raise ConfigurationError(
                "before is for touches with a force and held, and has a force, a duration and a "
                f"time since the release of each earlier touch, all 0 or more, got {self.before}; "
                f"each ended before this touch began, {begun:g} s ago"
            )
        if self.released and self.held is None:
            raise ConfigurationError(
                "a touch that was released needs held, the time in s for which it lasted"
            )


@dataclass(frozen=True, slots=True)
class PressedTouch:
    """Depth, contact, pressure and expected error of one touch of a scene.

    Attributes:
        touch: touch of the scene.
        force: force on the indenter now [N]; 0 after the release.
        depth: depth of the dent: position of the indenter's lowest point, now or before its
            release, below the undeformed top of the stack [m].
        contact_radius: radius of the contact area in the deformed stack [m]; 0 without contact.
            That of a footprint is of a circle as large.
        peak_pressure: largest contact pressure [Pa]; of a footprint the largest mean in a cell.
        thinning: 1 - thickness over undeformed thickness of the gel, on the axis.
        edge_distance: distance from the axis to the nearest edge of the gel [m].
        neighbour_distance: distance from the axis to that of the nearest other touch [m].
        signal_error: relative error of the signal by comparisons with other solutions at such
            distances (docs/results/simulator.md) and with that of the mesh of "fast". 95 of 100
            presses stay below it in the middle of a flat rigid base (32 compared) and on a polygon
            (41); it is above all that were compared near sides and in corners (8), on plates (8)
            and over gaps (5). None nearer to an edge or deeper than any comparison, with thinner
            covers, other ratios of moduli or smaller indenters than any, next to re-entrant
            corners, on other outlines, and on a sensor rolled, twisted or bent otherwise later.
        caution: why the dent is less exact than a single one in the middle of the sensor; empty
            otherwise.
    """

    touch: Touch
    force: float
    depth: float
    contact_radius: float
    peak_pressure: float
    thinning: float
    edge_distance: float
    neighbour_distance: float
    signal_error: float | None
    caution: str = ""

    @property
    def contact_area(self) -> float:
        """Area of the contact [m2]."""
        return math.pi * self.contact_radius**2

    @property
    def mean_pressure(self) -> float:
        """Force over contact area [Pa]."""
        return self.force / self.contact_area if self.contact_radius else 0.0


def neighbour_distance(touch: Touch, touches: tuple[Touch, ...]) -> float:
    """Distance from a touch to the nearest other one [m]."""
    others = (math.dist((touch.x, touch.y), (t.x, t.y)) for t in touches if t is not touch)
    return min(others, default=math.inf)


@dataclass(frozen=True, slots=True)
class Scene:
    """Scene of one moment; `Scene()` is the flat, untouched sensor.

    Attributes:
        bend: bend of the sensor by its fixture; flat when omitted.
        touches: touches on the top side, in coordinates of the flat sensor.
        roll: curl of the sensor across its width, before the bend; flat when omitted.
        twist: torsion about the long axis, after roll and bend; none when omitted.
        support: base that the sensor rests on; the design's support when omitted.

    Example:
        >>> from eitskin import Bend, Scene, Touch
        >>> scene = Scene(bend=Bend(30.0), touches=(Touch(0.050, 0.020, force=10.0),))
        >>> len(scene.touches)
        1
    """

    bend: Bend = field(default_factory=lambda: Bend(0.0))
    touches: tuple[Touch, ...] = ()
    roll: Roll | None = None
    twist: Twist | None = None
    support: Support | None = None

    def __post_init__(self) -> None:
        """Raise ConfigurationError for indenters that overlap."""
        pressing = [touch for touch in self.touches if not touch.released]
        for first, second in combinations(pressing, 2):
            step = np.array([second.x - first.x, second.y - first.y])
            apart = float(np.hypot(*step))
            least = apart - distance(first.indenter, second.indenter, step)
            if apart < least * (1.0 - 1e-9):
                raise ConfigurationError(
                    f"touches at ({first.x:g}, {first.y:g}) and ({second.x:g}, {second.y:g}) m are "
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


def require_bendable(support: Support, fixture: Fixture) -> None:
    """Raise ConfigurationError unless the fixture can bend a sensor on the support."""
    if isinstance(support, Free):
        raise ConfigurationError(
            "a free membrane is held at its rim and can be neither bent, rolled nor twisted; leave "
            "these out, or say support = 'plates' for a sensor that plates bend"
        )
    if not isinstance(support, Plates):
        return
    if isinstance(fixture, FreeArc):
        raise ConfigurationError(
            "a bend of a sensor on plates needs the clamp of the plates as its fixture, got "
            f"{fixture}; use another fixture or support = 'rigid'"
        )
    if abs(fixture.span - support.span) > _SPAN_TOLERANCE:
        raise ConfigurationError(
            f"the support's plates are {support.span:g} m apart, but those of the fixture "
            f"{fixture.span:g} m; give both the same span"
        )
