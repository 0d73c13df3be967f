"""Specimens: sensors of one design, on different mounts, with tolerances of hand-made ones."""

import dataclasses
import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from eitskin.datasets.recipe.scene_group import count_problems, range_problem, refusal
from eitskin.datasets.store.schema import LIMITS
from eitskin.geometry.deformation.fixtures import Clamp, Fixture, FreeArc, Hinge
from eitskin.geometry.design.dispersion import scale_conductivity
from eitskin.geometry.design.electrode import Electrode
from eitskin.geometry.design.outline import Rectangle
from eitskin.geometry.design.sensor import Plates, SensorDesign, Support
from eitskin.geometry.design.surface import Surface
from eitskin.protocol import Protocol
from eitskin.simulator.bends import bend_table
from eitskin.simulator.deformation.pressed_sensor import TouchModel
from eitskin.simulator.deformation.sensor_grid import OWN_GRID, SensorGrid
from eitskin.simulator.electrical.resolution import Resolution
from eitskin.simulator.instrument.meter import LOADS, FourTerminalMeter
from eitskin.simulator.mechanics.layer_stack import Mechanics
from eitskin.simulator.mechanics.materials import NeoHookean, Ogden
from eitskin.simulator.simulator import Simulator

Array = NDArray[np.float64]
KinematicFixture = Hinge | FreeArc
_Fixed = TypeVar("_Fixed", Hinge, FreeArc, Clamp, Hinge | FreeArc, Fixture)

MAX_DEVIATIONS = 3.0
"""Truncation of all normal draws, in standard deviations."""

RANGES = {
    "conductivity": (1.0, ""),
    "thickness": (0.05, ""),
    "gel_modulus": (0.3, ""),
    "encapsulation_modulus": (0.3, ""),
    "contact_impedance": (1.0, ""),
    "electrode_place": (0.01, " m"),
    "hinge_span": (0.01, " m"),
    "hinge_offset": (0.01, " m"),
    "board_loads": (10.0, ""),
}


MAX_MOUNTS = 1000

# Roberts (2018): powers of the inverse of the root of x^(d + 1) = x + 1 make a sequence that
# fills d dimensions evenly, however many of its points are taken.
_DIMENSIONS = 3
_ROOT = 1.2207440846057596  # of x^4 = x + 1

SPREAD_LOADS = (*LOADS, "common_mode")  # terms of a meter that differ between boards


@dataclass(frozen=True, slots=True)
class Specimens:
    """Number of specimens in a recipe, and standard deviations from the design.

    All deviations are truncated at three standard deviations; 0 switches a deviation off. Those
    without a unit are relative: lognormal factors with median one.

    Attributes:
        count: number of specimens, which follow each other in the dataset.
        conductivity: conductivity of the gel.
        thickness: thickness of gel and encapsulation by one factor.
        gel_modulus: shear modulus of the layer.
        encapsulation_modulus: shear modulus of the encapsulation.
        contact_impedance: contact impedance of each electrode, independently.
        electrode_place: position along the rim, of each side electrode independently [m].
        hinge_span: free length of the fixture, and between the plates of a support [m].
        hinge_offset: position of the fixture's axis across the layer [m].
        board_loads: load of each role on the instrument's meter, and its common mode,
            independently.
    """

    count: int = 1
    conductivity: float = 0.0
    thickness: float = 0.0
    gel_modulus: float = 0.0
    encapsulation_modulus: float = 0.0
    contact_impedance: float = 0.0
    electrode_place: float = 0.0
    hinge_span: float = 0.0
    hinge_offset: float = 0.0
    board_loads: float = 0.0

    def problems(self, design: SensorDesign, fixture: Fixture) -> Iterator[str]:
        """Impossible values for sensors like `design` on a `fixture`, a sentence each."""
        yield from count_problems("specimens: count", self.count, 1, LIMITS["specimen"])
        for name, (limit, unit) in RANGES.items():
            if not 0.0 <= (value := getattr(self, name)) <= limit:
                yield f"specimens: {name} must be from 0 to {limit:g}{unit}, got {value}"
        span = free_length(fixture)
        if not MAX_DEVIATIONS * self.hinge_span < span:
            yield (
                f"specimens: hinge_span must be less than a third of the span of {span:g} m, "
                f"got {self.hinge_span}"
            )
        free, between = clearance(design)
        if MAX_DEVIATIONS * self.electrode_place > free:
            least = max(0.0, free / MAX_DEVIATIONS)
            yield (
                f"specimens: electrode_place must be at most {least:.3g} m, three of which are the "
                f"{1e3 * max(0.0, free):.3g} mm that {between} leave, got {self.electrode_place}; "
                "lower it, or place these elsewhere, as by `start` of a layout"
            )

    def extremes(
        self, design: SensorDesign, fixture: KinematicFixture
    ) -> Iterator[tuple[SensorDesign, KinematicFixture]]:
        """Sensors and fixtures with the largest possible deviations from the nominal ones."""
        thick = scaled_thickness(design, lognormal(self.thickness, MAX_DEVIATIONS))
        ends = (-MAX_DEVIATIONS, MAX_DEVIATIONS)
        for first, second in itertools.product(ends, ends):
            moved = (first * self.hinge_span, second * self.hinge_offset)
            yield thick, moved_fixture(fixture, *moved)


@dataclass(frozen=True, slots=True)
class Mounts:
    """Different clamps and stiffnesses of the encapsulation, one for each specimen in turn.

    The bend of each is solved once, in a quarter of a minute. Deviations of `Specimens` come on
    top. Values fill their ranges evenly.

    Attributes:
        count: number of mounts; 0 for the fixture of the recipe alone.
        span: range of the free length between the plates [m].
        offset: range of the axis below the mid-plane of the layer [m].
        stiffness: range of the factor on the modulus of the encapsulation, even in its logarithm.
        faces: faces held by the plates, in turn.
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
        return Clamp(_interpolate(self.span, across), _interpolate(self.offset, along), faces=faces)

    def mechanics(self, number: int, nominal: Mechanics) -> Mechanics:
        """Materials of mount `number`, from the nominal ones."""
        low, high = (math.log(factor) for factor in self.stiffness)
        factor = math.exp(_interpolate((low, high), self._shares(number)[2]))
        law = nominal.encapsulation
        stiffer = dataclasses.replace(law, shear_modulus=factor * law.shear_modulus)
        return dataclasses.replace(nominal, encapsulation=stiffer)

    def problems(self) -> Iterator[str]:
        """Impossible values, a sentence each."""
        yield from count_problems("mounts: count", self.count, 0, MAX_MOUNTS)
        for name in ("span", "offset", "stiffness"):
            above = -math.inf if name == "offset" else 0.0
            if problem := range_problem(name, getattr(self, name), above):
                yield f"mounts: {problem}"
        if not self.faces:
            yield 'mounts: faces must name "both" or "bottom", got none'

    def unclampable(self, design: SensorDesign, mechanics: Mechanics) -> Iterator[str]:
        """First reason why sensors like `design` cannot be clamped so."""

        def check() -> None:
            for n in range(self.count):
                bend_table.check_clamp(design, self.clamp(n), self.mechanics(n, mechanics))

        return refusal(check, "mounts: ")

    def _shares(self, number: int) -> tuple[float, ...]:
        """Place of mount `number` in each range, between 0 and 1."""
        steps = (_ROOT ** -(power + 1) for power in range(_DIMENSIONS))
        return tuple((0.5 + (number + 1) * step) % 1.0 for step in steps)


@dataclass(frozen=True, slots=True)
class Specimen:
    """One sensor with its fixture and its materials, and the grid of its solutions."""

    design: SensorDesign
    fixture: Fixture
    mechanics: Mechanics
    grid: SensorGrid = OWN_GRID

    def simulator(
        self,
        nominal: SensorDesign | None,
        resolution: Resolution,
        protocol: Protocol | None = None,
        touch_model: TouchModel | None = None,
    ) -> Simulator:
        """Simulator of the specimen, which shares meshes and factors with `nominal`, if given."""
        return Simulator(
            self.design,
            resolution,
            self.fixture,
            protocol,
            self.mechanics,
            touch_model,
            nominal=nominal,
            grid=self.grid,
        )


def draw_specimen(spread: Specimens, nominal: Specimen, rng: np.random.Generator) -> Specimen:
    """Random specimen with deviations `spread` from `nominal`; `nominal` where all are zero.

    Every property has its own draws, whichever of the deviations are zero.
    """
    design, fixture, mechanics = nominal.design, nominal.fixture, nominal.mechanics
    # The order of these draws makes the specimens of all recipes: new properties draw at the end.
    conductivity, thickness, gel, around, span, offset = truncated_normal(rng, 6).tolist()
    contacts, places = truncated_normal(rng, 2 * len(design.electrodes)).reshape(2, -1).tolist()

    def factor(name: str, normal: float) -> float:
        return lognormal(getattr(spread, name), normal)

    electrodes = tuple(
        dataclasses.replace(
            moved_along_rim(electrode, spread.electrode_place * place, design),
            contact_impedance=electrode.contact_impedance * factor("contact_impedance", contact),
        )
        for electrode, contact, place in zip(design.electrodes, contacts, places, strict=True)
    )
    widened = spread.hinge_span * span
    design_drawn = dataclasses.replace(
        design, electrodes=electrodes, support=with_wider_gap(design.support, widened)
    )
    design_drawn = scaled_conductivity(design_drawn, factor("conductivity", conductivity))
    if spread.thickness:
        design_drawn = scaled_thickness(design_drawn, factor("thickness", thickness))
    return Specimen(
        design_drawn,
        moved_fixture(fixture, widened, spread.hinge_offset * offset),
        dataclasses.replace(
            mechanics,
            gel=scaled_modulus(mechanics.gel, factor("gel_modulus", gel)),
            encapsulation=scaled_modulus(
                mechanics.encapsulation, factor("encapsulation_modulus", around)
            ),
        ),
        nominal.grid,
    )


def draw_meter(
    spread: Specimens, nominal: FourTerminalMeter, rng: np.random.Generator
) -> FourTerminalMeter:
    """Random meter of one specimen's board with deviations `spread` from `nominal`."""
    normals = truncated_normal(rng, len(SPREAD_LOADS)).tolist()
    return dataclasses.replace(
        nominal,
        **{
            name: getattr(nominal, name) * lognormal(spread.board_loads, normal)
            for name, normal in zip(SPREAD_LOADS, normals, strict=True)
        },
    )


def with_wider_gap(support: Support, extra_gap: float) -> Support:
    """Support whose plates are farther apart `extra_gap` [m]; other supports unchanged."""
    if isinstance(support, Plates) and extra_gap:
        return dataclasses.replace(support, span=support.span + extra_gap)
    return support


def free_length(fixture: Fixture) -> float:
    """Free length of a fixture, or length of its arc [m]."""
    return fixture.length if isinstance(fixture, FreeArc) else fixture.span


def moved_fixture(fixture: _Fixed, span: float, offset: float) -> _Fixed:
    """Fixture of a longer span and a deeper axis, by `span` and `offset` [m]."""
    if isinstance(fixture, FreeArc):
        return dataclasses.replace(fixture, length=fixture.length + span)
    return dataclasses.replace(fixture, span=fixture.span + span, offset=fixture.offset + offset)


def lognormal(deviation: float, normal: float) -> float:
    """Lognormal factor of median one and relative sd `deviation`, from a standard normal draw.

    With s^2 the variance of its logarithm, (deviation / mean)^2 = exp(s^2) - 1.
    """
    return math.exp(math.sqrt(math.log1p(deviation**2)) * normal)


def truncated_normal(rng: np.random.Generator, size: int) -> Array:
    """Standard normal draws (size,), truncated at `MAX_DEVIATIONS` by rejection."""
    drawn = rng.standard_normal(size)
    while (wide := np.abs(drawn) > MAX_DEVIATIONS).any():
        drawn[wide] = rng.standard_normal(int(wide.sum()))
    return drawn


def scaled_conductivity(design: SensorDesign, factor: float) -> SensorDesign:
    """Design with every conductivity times `factor`."""
    if not design.layers:
        own = scale_conductivity(design.conductivity, factor)
        return dataclasses.replace(design, conductivity=own)
    layers = (
        dataclasses.replace(x, conductivity=scale_conductivity(x.conductivity, factor))
        for x in design.layers
    )
    return dataclasses.replace(design, layers=tuple(layers))


def scaled_thickness(design: SensorDesign, factor: float) -> SensorDesign:
    """Design with every height times `factor`."""
    layers = (dataclasses.replace(x, thickness=factor * x.thickness) for x in design.layers)
    return dataclasses.replace(
        design,
        thickness=factor * design.thickness,
        encapsulated_thickness=factor * design.encapsulated_thickness,
        layers=tuple(layers),
        electrodes=tuple(_scaled_height(electrode, factor) for electrode in design.electrodes),
    )


def _scaled_height(electrode: Electrode, factor: float) -> Electrode:
    z = None if electrode.z is None else factor * electrode.z
    upright = electrode.on == "side" and electrode.height is not None
    height = factor * electrode.height if upright and electrode.height else electrode.height
    return dataclasses.replace(electrode, z=z, height=height)


def scaled_modulus(law: NeoHookean | Ogden, factor: float) -> NeoHookean | Ogden:
    """Law with its shear modulus times `factor`."""
    return dataclasses.replace(law, shear_modulus=factor * law.shear_modulus)


def moved_along_rim(electrode: Electrode, distance: float, design: SensorDesign) -> Electrode:
    """Side electrode moved `distance` [m] along the rim, counter-clockwise; others stay."""
    outline = design.outline
    if electrode.on != "side" or not distance or isinstance(outline, Surface):
        return electrode
    x, y = outline.rim_points(outline.locate(electrode.x, electrode.y) + distance).tolist()
    return dataclasses.replace(electrode, x=x, y=y)


def clearance(design: SensorDesign) -> tuple[float, str]:
    """Distance that every side electrode may move without reaching others or corners [m].

    With the electrodes, or the electrode and the corner, that leave so little; negative where an
    electrode goes around a corner.
    """
    outline = design.outline
    numbers = np.array([k for k, e in enumerate(design.electrodes) if e.on == "side"])
    if isinstance(outline, Surface) or not len(numbers):
        return math.inf, ""
    electrodes = [design.electrodes[k] for k in numbers]
    half = 0.5 * np.array([electrode.width for electrode in electrodes])
    places = np.array([outline.locate(e.x, e.y) for e in electrodes])
    order = np.argsort(places)
    after = np.roll(order, -1)
    around = np.diff(places[order], append=places[order[0]] + outline.perimeter)
    gaps = 0.5 * (around - half[order] - half[after])
    nearest = int(gaps.argmin())
    pair = f"electrodes {numbers[order[nearest]]} and {numbers[after[nearest]]}"
    gaps_found = [(float(gaps[nearest]), pair)]
    if isinstance(outline, Rectangle):
        corners = np.append(outline.corners, outline.perimeter)
        gaps = np.abs(places[:, None] - corners).min(axis=1) - half
        nearest = int(gaps.argmin())
        gaps_found.append((float(gaps[nearest]), f"electrode {numbers[nearest]} and a corner"))
    return min(gaps_found)


def _interpolate(ends: tuple[float, float], share: float) -> float:
    low, high = ends
    return low + share * (high - low)
