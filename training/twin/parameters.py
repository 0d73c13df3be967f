"""Numbers of a twin, as standard normal coordinates of a prior, and the sensor that has them."""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Literal

import numpy as np

from eitskin.datasets.recipe.specimen import (
    Specimen,
    free_length,
    moved_along_rim,
    moved_fixture,
    scaled_conductivity,
    scaled_modulus,
    scaled_thickness,
    with_wider_gap,
)
from eitskin.geometry import Clamp, ConfigurationError, FreeArc, Rectangle, SensorDesign
from eitskin.geometry.deformation.electrode_shift import electrode_shift
from eitskin.geometry.design.dispersion import resolve_conductivity
from eitskin.simulator import SensorGrid
from eitskin.simulator.instrument.meter import Parameter, meter_parameters
from eitskin.simulator.mechanics.materials import NeoHookean, Ogden

_TRIAL = 1e-4  # shift of an electrode that shows whether it can be moved on the mesh [m]
_MAX_SPREAD = 1e6  # spread of a prior
_MAX_DEVIATIONS = 5.0  # prior standard deviations to which a fit may go
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
Numbers = Mapping[tuple[str, int | None], float]
"""Numbers of sensor and fixture by kind and electrode."""

MECHANICAL = ("span", "offset", "gel_modulus", "encapsulation_modulus")


@dataclass(frozen=True, slots=True)
class TwinPrior:
    """Prior of a twin's numbers: one standard deviation about the design's own.

    Those without a unit are factors of lognormal distributions: 3 means from a third to three times
    the design's. The defaults are as wide as what people build.

    Attributes:
        conductivity: conductivity of the gel.
        thickness: thickness of gel and encapsulation by one factor.
        contact_impedance: contact impedance of each electrode.
        electrode_place: position of each side electrode along the rim [m].
        span: free length of the fixture, or length of its arc.
        offset: depth of the fixture's axis [m].
        gel_modulus, encapsulation_modulus: shear moduli.
        gain: gain of a board that reads ohms.
        load: loads, leaks and leads of the meter, as the share Y Z / (1 + Y Z) of an admittance Y
            and the sensor's impedance Z; about none.
        common_mode: common mode of the meter, and offset over the sensor's impedance; about none.

    Example:
        >>> from eitskin.training import TwinPrior
        >>> TwinPrior(conductivity=1.5).conductivity
        1.5
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
        for field in fields(self):
            value = getattr(self, field.name)
            least = 0.0 if field.name in _LINEAR else 1.0
            if not least < value <= _MAX_SPREAD:
                raise ConfigurationError(
                    f"prior: {field.name} must be above {least:g} and at most {_MAX_SPREAD:g}, got "
                    f"{value}; a factor of 1.1 is 10 % either way"
                )


_LINEAR = ("electrode_place", "offset", "load", "common_mode")


def twin_parameter(
    name: str,
    centre: float,
    spread: float,
    transform: Literal["linear", "factor"] = "factor",
    electrode: int | None = None,
) -> Parameter:
    """Number of a twin about a centre, with the spread of its prior: a factor, or in its unit."""
    bounds = (-_MAX_DEVIATIONS, _MAX_DEVIATIONS)
    return Parameter(name, centre, spread, transform, _UNITS.get(name, ""), bounds, electrode)


def sensor_parameters(nominal: Specimen, prior: TwinPrior) -> tuple[Parameter, ...]:
    """Numbers of sensor, fixture and materials, about those of a nominal one.

    Places along the rim are among them where the sensor's mesh can follow them: on rectangles,
    electrodes as high as the layer and off the corners.
    """
    design, fixture, mechanics = nominal.design, nominal.fixture, nominal.mechanics
    parameters = [
        twin_parameter("conductivity", conductivity(design), prior.conductivity),
        twin_parameter("thickness", design.thickness, prior.thickness),
    ]
    for k, electrode in enumerate(design.electrodes):
        z, spread = electrode.contact_impedance.real, prior.contact_impedance
        parameters.append(twin_parameter("contact_impedance", z, spread, electrode=k))
    if _movable(design):
        numbers, spread = range(len(design.electrodes)), prior.electrode_place
        parameters += [twin_parameter("electrode_place", 0.0, spread, "linear", k) for k in numbers]
    if isinstance(design.outline, Rectangle) or not isinstance(fixture, Clamp):
        parameters.append(twin_parameter("span", free_length(fixture), prior.span))
        if not isinstance(fixture, FreeArc):
            parameters.append(twin_parameter("offset", fixture.offset, prior.offset, "linear"))
    for name in ("gel", "encapsulation"):
        kind, modulus = f"{name}_modulus", getattr(mechanics, name).shear_modulus
        parameters.append(twin_parameter(kind, modulus, getattr(prior, kind)))
    return tuple(parameters)


def instrument_parameters(
    terms: Sequence[str], n_electrodes: int, prior: TwinPrior, typical: float
) -> tuple[Parameter, ...]:
    """Numbers of the meter's terms, as `meter_parameters` names them.

    Args:
        terms: names of terms.
        n_electrodes: number of electrodes.
        prior: prior of loads and common mode.
        typical: impedance of the sensor that loads are relative to [ohm].
    """
    parameters = meter_parameters(terms, n_electrodes, typical, complex_terms=False)
    return tuple(p.with_prior(prior.load if p.is_share else prior.common_mode) for p in parameters)


def conductivity(design: SensorDesign) -> float:
    """Conductivity of a design at 40 kHz, that of its lowest layer where it has layers [S/m]."""
    own = design.layers[0].conductivity if design.layers else design.conductivity
    return float(np.real(resolve_conductivity(own)))


def _movable(design: SensorDesign) -> bool:
    """Whether every electrode can be moved along the rim on the design's own mesh."""
    moved = [moved_along_rim(electrode, _TRIAL, design) for electrode in design.electrodes]
    if any(electrode == other for electrode, other in zip(moved, design.electrodes, strict=True)):
        return False
    trial = dataclasses.replace(design, electrodes=tuple(moved))
    return electrode_shift(design, trial) is not None


def interpolation_centre(nominal: Specimen) -> Specimen:
    """The same sensor, about whose numbers bends and presses are interpolated.

    Raises ConfigurationError for sensors whose specimens cannot share a mesh.
    """
    design, fixture, mechanics = nominal.design, nominal.fixture, nominal.mechanics
    if any(complex(electrode.contact_impedance).imag for electrode in design.electrodes):
        raise ConfigurationError(
            "a twin needs real contact impedances, got complex ones; give their real parts"
        )
    if electrode_shift(design, design) is None:
        raise ConfigurationError(
            "a twin needs a plane outline, got a surface; give a flat sensor's rim as outline"
        )
    if not (isinstance(fixture, Clamp) or fixture.transition):
        raise ConfigurationError(
            "the bend of a kinematic fixture without transition jumps where it ends, and every "
            "span needs another mesh; give a clamp, or a transition"
        )
    grid = SensorGrid.from_nominal(design, fixture, mechanics).override(nominal.grid)
    return Specimen(design, fixture, mechanics, grid)


def with_numbers(nominal: Specimen, numbers: Numbers) -> Specimen:
    """Nominal sensor with other numbers.

    Raises ConfigurationError for a sensor that cannot be, or cannot share the nominal one's mesh.
    """
    design, fixture, mechanics = nominal.design, nominal.fixture, nominal.mechanics
    electrodes = tuple(
        dataclasses.replace(
            moved_along_rim(electrode, numbers.get(("electrode_place", k), 0.0), design),
            contact_impedance=numbers["contact_impedance", k],
        )
        for k, electrode in enumerate(design.electrodes)
    )
    wider = numbers.get(("span", None), free_length(fixture)) - free_length(fixture)
    made = dataclasses.replace(
        design, electrodes=electrodes, support=with_wider_gap(design.support, wider)
    )
    made = scaled_conductivity(made, numbers["conductivity", None] / conductivity(design))
    made = scaled_thickness(made, numbers["thickness", None] / design.thickness)
    if electrode_shift(design, made) is None:
        raise ConfigurationError("an electrode meets another one or a corner")
    offset = 0.0 if isinstance(fixture, FreeArc) else fixture.offset
    deeper = numbers.get(("offset", None), offset) - offset
    materials = dataclasses.replace(
        mechanics,
        gel=_set_modulus(mechanics.gel, numbers["gel_modulus", None]),
        encapsulation=_set_modulus(mechanics.encapsulation, numbers["encapsulation_modulus", None]),
    )
    return Specimen(made, moved_fixture(fixture, wider, deeper), materials, nominal.grid)


def _set_modulus(law: NeoHookean | Ogden, modulus: float) -> NeoHookean | Ogden:
    return scaled_modulus(law, modulus / law.shear_modulus)
