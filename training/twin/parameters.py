"""Numbers of a twin, as standard normal coordinates of a prior."""

import dataclasses
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields

from eitskin.datasets.recipe.specimen import Specimen, free_length, moved_along_rim
from eitskin.errors import ConfigurationError
from eitskin.geometry.deformation.electrode_shift import electrode_shift
from eitskin.geometry.deformation.fixtures import Clamp, FreeArc
from eitskin.geometry.design.outline import Rectangle
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.simulator.instrument.meter_parameters import MeterParameter, meter_parameters

_TRIAL = 1e-4  # shift of an electrode that tells whether it can be moved on the mesh [m]
_WIDEST = 1e6  # spread of a prior
_FARTHEST = 5.0  # prior standard deviations to which a fit may go
_UNITS = {
    "conductivity": "S/m",
    "thickness": "m",
    "contact_impedance": "ohm m2",
    "electrode_place": "m",
    "span": "m",
    "offset": "m",
    "gel_modulus": "Pa",
    "encapsulation_modulus": "Pa",
}
MECHANICAL = ("span", "offset", "gel_modulus", "encapsulation_modulus")


@dataclass(frozen=True, slots=True)
class TwinPrior:
    """Prior of a twin's numbers: one standard deviation about the design's own.

    Those without a unit are factors of lognormal distributions: 3 means from a third to three times
    the design's. The defaults are as wide as what people build.

    Attributes:
        conductivity: of the layer.
        thickness: of layer and encapsulation by one factor.
        contact_impedance: of each electrode.
        electrode_place: of each side electrode along the rim [m].
        span: free length of the fixture, or length of its arc.
        offset: of the fixture's axis [m].
        gel_modulus, encapsulation_modulus: shear moduli.
        gain: of a board that reads ohms.
        load: of the meter's loads, leaks and leads, as the share Y Z / (1 + Y Z) of an admittance Y
            and the sensor's impedance Z; about none.
        common_mode: of the meter, and its offset over the sensor's impedance; about none.
    """

    conductivity: float = 3.0
    thickness: float = 1.1
    contact_impedance: float = 10.0
    electrode_place: float = 0.0015
    span: float = 1.25
    offset: float = 0.0025
    gel_modulus: float = 3.0
    encapsulation_modulus: float = 3.0
    gain: float = 1.01
    load: float = 0.3
    common_mode: float = 0.5

    def __post_init__(self) -> None:
        """Check that factors are above 1 and lengths above 0."""
        for each in fields(self):
            value = getattr(self, each.name)
            least = 0.0 if each.name in _LINEAR else 1.0
            if not least < value <= _WIDEST:
                raise ConfigurationError(
                    f"prior: {each.name} must be above {least:g} and at most {_WIDEST:g}, got "
                    f"{value}; a factor of 1.1 is 10 % either way"
                )


_LINEAR = ("electrode_place", "offset", "load", "common_mode")


@dataclass(frozen=True, slots=True)
class TwinParameter:
    """One number of a twin, with a standard normal coordinate.

    Attributes:
        name: kind of the number, as an attribute of `TwinPrior`, or the term of the meter.
        centre: number where the coordinate is 0.
        spread: of the prior: a factor where `is_factor`, else in the number's unit; for terms of
            the meter per unit of their coordinates.
        is_factor: whether the number is lognormal.
        electrode: number of the electrode; None for others.
        meter: term of the meter; None for numbers of sensor and fixture, and for the gain.
        typical: impedance that loads of the meter are relative to [ohm].
    """

    name: str
    centre: float
    spread: float
    is_factor: bool = True
    electrode: int | None = None
    meter: MeterParameter | None = None
    typical: float = 1.0

    def __str__(self) -> str:
        """Name in reports, such as "thickness" or "contact_impedance[3]"."""
        if self.meter is not None:
            return str(self.meter)
        return self.name if self.electrode is None else f"{self.name}[{self.electrode}]"

    @property
    def unit(self) -> str:
        """Unit of the number; empty where it has none."""
        return self.meter.unit if self.meter is not None else _UNITS.get(self.name, "")

    @property
    def bounds(self) -> tuple[float, float]:
        """Least and greatest coordinate of a fit."""
        if self.meter is None:
            return -_FARTHEST, _FARTHEST
        low, high = self.meter.bounds
        return low / self.spread, high / self.spread

    def number(self, x: float) -> float:
        """Number at a coordinate."""
        if self.meter is not None:
            return self.meter.number(self.spread * x, self.typical)
        return self.centre * self.spread**x if self.is_factor else self.centre + self.spread * x

    def slope(self, x: float) -> float:
        """Derivative of the number by the coordinate."""
        if self.meter is not None:
            return self.spread * self.meter.slope(self.spread * x, self.typical)
        return math.log(self.spread) * self.number(x) if self.is_factor else self.spread

    def coordinate(self, number: float) -> float:
        """Coordinate of a number."""
        if self.meter is not None:
            ratio = number / self.meter.per_unit(self.typical)
            return (ratio / (1.0 + ratio) if self.meter.is_share else ratio) / self.spread
        if self.is_factor:
            return math.log(number / self.centre) / math.log(self.spread)
        return (number - self.centre) / self.spread


def sensor_parameters(nominal: Specimen, prior: TwinPrior) -> tuple[TwinParameter, ...]:
    """Numbers of sensor, fixture and materials, about those of a nominal one.

    Places along the rim are among them where the sensor's mesh can follow them: on rectangles,
    electrodes as high as the layer and off the corners.
    """
    return tuple(_sensor_parameters(nominal, prior))


def _sensor_parameters(nominal: Specimen, prior: TwinPrior) -> Iterator[TwinParameter]:
    design, fixture, mechanics = nominal.design, nominal.fixture, nominal.mechanics
    yield TwinParameter("conductivity", conductivity(design), prior.conductivity)
    yield TwinParameter("thickness", design.thickness, prior.thickness)
    for k, electrode in enumerate(design.electrodes):
        z = electrode.contact_impedance.real
        yield TwinParameter("contact_impedance", z, prior.contact_impedance, electrode=k)
    if _movable(design):
        for k in range(len(design.electrodes)):
            yield TwinParameter("electrode_place", 0.0, prior.electrode_place, False, k)
    if isinstance(design.outline, Rectangle) or not isinstance(fixture, Clamp):
        yield TwinParameter("span", free_length(fixture), prior.span)
        if not isinstance(fixture, FreeArc):
            yield TwinParameter("offset", fixture.offset, prior.offset, False)
    yield TwinParameter("gel_modulus", mechanics.gel.shear_modulus, prior.gel_modulus)
    around = mechanics.encapsulation.shear_modulus
    yield TwinParameter("encapsulation_modulus", around, prior.encapsulation_modulus)


def instrument_parameters(
    terms: Sequence[str], n_electrodes: int, prior: TwinPrior, typical: float
) -> tuple[TwinParameter, ...]:
    """Numbers of the meter's terms, as `meter_parameters` names them.

    Args:
        terms: names of terms.
        n_electrodes: number of electrodes.
        prior: of loads and common mode.
        typical: impedance of the sensor that loads are relative to [ohm].
    """
    return tuple(
        TwinParameter(
            each.term,
            0.0,
            prior.load if each.is_share else prior.common_mode,
            False,
            each.electrode,
            each,
            typical,
        )
        for each in meter_parameters(terms, n_electrodes, complex_terms=False)
    )


def conductivity(design: SensorDesign) -> float:
    """Conductivity of a design, that of its lowest layer where it has layers [S/m]."""
    return design.layers[0].conductivity if design.layers else design.conductivity


def _movable(design: SensorDesign) -> bool:
    """Whether every electrode can be moved along the rim on the design's own mesh."""
    moved = [moved_along_rim(each, _TRIAL, design) for each in design.electrodes]
    if any(one == other for one, other in zip(moved, design.electrodes, strict=True)):
        return False
    trial = dataclasses.replace(design, electrodes=tuple(moved))
    return electrode_shift(design, trial) is not None
