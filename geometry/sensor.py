"""What a sensor is: outline, thickness, electrodes, materials."""

import itertools
import math
from dataclasses import dataclass
from pathlib import Path

from eitskin.geometry.config import read_toml, to_toml
from eitskin.geometry.errors import ConfigurationError


@dataclass(frozen=True, slots=True)
class Rectangle:
    """Outline with a corner at the origin: length along x, width along y [m]."""

    length: float
    width: float

    def __post_init__(self) -> None:
        """Check the sizes."""
        _require_positive("outline.length", self.length, "m")
        _require_positive("outline.width", self.width, "m")


@dataclass(frozen=True, slots=True)
class Electrode:
    """Contact on a lateral face, over the full thickness of the layer.

    Attributes:
        x, y: centre of the contact, on the outline [m].
        width: extent along the outline [m].
        contact_impedance: z of the complete electrode model [ohm m2].
    """

    x: float
    y: float
    width: float = 0.005
    contact_impedance: float = 1e-3

    def __post_init__(self) -> None:
        """Check the numbers that need no outline."""
        _require_positive("electrode width", self.width, "m")
        _require_positive("electrode contact_impedance", self.contact_impedance, "ohm m2")


@dataclass(frozen=True, slots=True)
class SensorDesign:
    """A flat conductive layer with electrodes on its rim, inside a soft encapsulation.

    Attributes:
        outline: of the conductive layer; its lower left corner is the origin.
        thickness: of the conductive layer, along z [m].
        electrodes: in the order in which they are numbered.
        conductivity: of the layer [S/m].
        encapsulated_thickness: of layer and encapsulation together, layer centred [m].
    """

    outline: Rectangle
    thickness: float
    electrodes: tuple[Electrode, ...]
    conductivity: float = 1.0
    encapsulated_thickness: float = 0.012

    def __post_init__(self) -> None:
        """Check that the electrodes lie on the outline and do not overlap."""
        _require_positive("thickness", self.thickness, "m")
        _require_positive("conductivity", self.conductivity, "S/m")
        if not self.encapsulated_thickness >= self.thickness:
            raise ConfigurationError(
                f"encapsulated_thickness must be at least the layer's {self.thickness:g} m, "
                f"got {self.encapsulated_thickness:g} m"
            )
        if len(self.electrodes) < 2:
            raise ConfigurationError(
                f"a sensor needs at least two electrodes, got {len(self.electrodes)}"
            )
        spans = sorted((*self.perimeter_span(i), i) for i in range(len(self.electrodes)))
        for (_, end, i), (start, _, j) in itertools.pairwise(spans):
            if start < end - 1e-12:
                raise ConfigurationError(
                    f"electrodes {i} and {j} overlap by {(end - start) * 1e3:g} mm along the "
                    "outline; move them apart or make them narrower"
                )

    @classmethod
    def reference(cls) -> "SensorDesign":
        """The sensor of the paper: 150 x 60 x 5 mm, eight 5 mm electrodes, counter-clockwise."""
        places = [
            (0.0225, 0.0),
            (0.075, 0.0),
            (0.1275, 0.0),
            (0.150, 0.030),
            (0.1275, 0.060),
            (0.075, 0.060),
            (0.0225, 0.060),
            (0.0, 0.030),
        ]
        return cls(
            outline=Rectangle(0.150, 0.060),
            thickness=0.005,
            electrodes=tuple(Electrode(x, y) for x, y in places),
        )

    @classmethod
    def from_toml(cls, path: str | Path) -> "SensorDesign":
        """Read a design; raises ConfigurationError for anything that does not fit."""
        return read_toml(cls, path)

    def to_toml(self) -> str:
        """Write the design as TOML; `from_toml` of it is this design."""
        return to_toml(self)

    def side(self, index: int) -> int:
        """Side that electrode `index` lies on: 0 y = 0, 1 x = length, 2 y = width, 3 x = 0."""
        electrode = self.electrodes[index]
        length, width = self.outline.length, self.outline.width
        distances = (
            abs(electrode.y),
            abs(electrode.x - length),
            abs(electrode.y - width),
            abs(electrode.x),
        )
        along = (electrode.x, electrode.y, electrode.x, electrode.y)
        extent = (length, width, length, width)
        for side in range(4):
            inside = electrode.width / 2 - 1e-9 <= along[side]
            inside = inside and along[side] <= extent[side] - electrode.width / 2 + 1e-9
            if distances[side] < 1e-9 and inside:
                return side
        raise ConfigurationError(
            f"electrode {index} at ({electrode.x:g}, {electrode.y:g}) m, {electrode.width:g} m "
            f"wide, must lie wholly on one side of the {length:g} x {width:g} m outline; its "
            "centre is off the outline or its end passes a corner"
        )

    def perimeter_span(self, index: int) -> tuple[float, float]:
        """Start and end of electrode `index` along the outline, counter-clockwise from 0 [m]."""
        electrode = self.electrodes[index]
        length, width = self.outline.length, self.outline.width
        centre = (
            electrode.x,
            length + electrode.y,
            2 * length + width - electrode.x,
            2 * (length + width) - electrode.y,
        )[self.side(index)]
        return centre - electrode.width / 2, centre + electrode.width / 2


def _require_positive(name: str, value: float, unit: str) -> None:
    if not (math.isfinite(value) and value > 0):
        raise ConfigurationError(f"{name} must be a positive number of {unit}, got {value!r}")
