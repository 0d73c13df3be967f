"""Mechanical properties of the sensor, its stack of bonded layers, and that under an indenter."""

import math
from dataclasses import InitVar, dataclass, field

import numpy as np
from numpy.typing import NDArray

from eitskin.bounds import LONGEST
from eitskin.errors import ConfigurationError
from eitskin.geometry.design.sensor import SensorDesign, Substrate, warn_of_grid
from eitskin.simulator.mechanics.materials import NeoHookean, Ogden
from eitskin.simulator.mechanics.viscoelasticity import ECOFLEX, GEL, Prony

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Piezoresistivity:
    """Piezoresistivity: conductivity sigma_0 (1 + k_v (J - 1) + k_p p).

    Both coefficients are zero for an ideal ionic conductor.

    Attributes:
        volume: k_v, per change of volume J - 1.
        pressure: k_p, per pressure p under presses, positive in compression [1/Pa]; the pressure
            of bends is left out.
    """

    volume: float = 0.0
    pressure: float = 0.0

    def __post_init__(self) -> None:
        if not (math.isfinite(self.volume) and math.isfinite(self.pressure)):
            raise ConfigurationError(
                f"piezoresistive coefficients must be finite, got {self.volume}, {self.pressure}"
            )

    def factor(self, J: Array, mean_stress: Array | float) -> Array:
        """Conductivity relative to the conductivity at rest, (...).

        Raises ConfigurationError where the factor is not positive.
        """
        factor = 1.0 + self.volume * (J - 1.0) - self.pressure * mean_stress
        if not np.all(factor > 0.0):
            raise ConfigurationError(
                "the piezoresistive conductivity must stay positive, but falls to "
                f"{float(np.min(factor)):.3g} of that at rest; use smaller coefficients or forces"
            )
        return np.asarray(factor)


@dataclass(frozen=True, slots=True)
class Mechanics:
    """Mechanical properties of a gel bonded into an encapsulation.

    Attributes:
        gel: hyperelastic law of the conductive layer; E = 60 kPa.
        encapsulation: hyperelastic law of the encapsulation; Ecoflex 00-30.
        margin: width of the encapsulation beyond the gel on all four sides [m].
        bulk_ratio: kappa / mu of both materials.
        gel_relaxation, encapsulation_relaxation: Prony series of the two materials.
        piezoresistivity: change of the gel's conductivity with volume and pressure.

    Example:
        >>> from eitskin.simulator import Mechanics
        >>> Mechanics(margin=0.004).gel.shear_modulus
        20000.0
    """

    gel: NeoHookean | Ogden = field(default_factory=lambda: NeoHookean(20e3))
    encapsulation: NeoHookean | Ogden = field(default_factory=lambda: NeoHookean(28e3))
    margin: float = 0.005
    bulk_ratio: float = 1e4
    gel_relaxation: Prony = GEL
    encapsulation_relaxation: Prony = ECOFLEX
    piezoresistivity: Piezoresistivity = field(default_factory=Piezoresistivity)
    solved_thickness: InitVar[float | None] = None
    solved_ratio: InitVar[float | None] = None

    def __post_init__(self, solved_thickness: float | None, solved_ratio: float | None) -> None:
        """Check the lengths; laws and solid check the other values."""
        if not 0.0 <= self.margin <= LONGEST:
            raise ConfigurationError(
                f"margin must be a length up to {LONGEST:g} m, got {self.margin}"
            )
        if solved_thickness is not None or solved_ratio is not None:
            warn_of_grid("Mechanics(solved_thickness=..., solved_ratio=...)")

    def stack(self, design: SensorDesign) -> "Stack":
        """Layers of a sensor from below: encapsulation, gel, encapsulation; a substrate below."""
        around = 0.5 * (design.encapsulated_thickness - design.thickness)
        sheets = [Sheet(design.thickness, self.gel)]
        if around > 0.0:
            silicone = Sheet(around, self.encapsulation)
            sheets = [silicone, *sheets, silicone]
        support = design.support
        if isinstance(support, Substrate):
            sheets = [Sheet(support.thickness, NeoHookean(support.shear_modulus)), *sheets]
        return Stack(tuple(sheets), self.bulk_ratio, isinstance(support, Substrate))


@dataclass(frozen=True, slots=True)
class Sheet:
    """One layer of a stack: thickness [m] and hyperelastic law."""

    thickness: float
    law: NeoHookean | Ogden


@dataclass(frozen=True, slots=True)
class Stack:
    """Layers bonded to each other and to a rigid base, from below.

    Attributes:
        sheets: the layers.
        bulk_ratio: kappa / mu of all layers.
        substrate: whether the lowest layer is a substrate, which is no part of the sensor.
    """

    sheets: tuple[Sheet, ...]
    bulk_ratio: float = 1e4
    substrate: bool = False

    @property
    def gel(self) -> int:
        """Number of the conductive layer: the middle one of the sensor."""
        return (len(self.sheets) + self.substrate) // 2

    @property
    def levels(self) -> tuple[float, ...]:
        """Heights of base, interfaces and top [m]."""
        return (0.0, *np.cumsum([sheet.thickness for sheet in self.sheets]).tolist())

    def layer_number(self, heights: Array) -> NDArray[np.int64]:
        """Number of the layer at heights over the base [m]; the lower one at an interface."""
        inner = np.array(self.levels[1:-1])
        numbers: NDArray[np.int64] = np.searchsorted(inner, heights).astype(np.int64)
        return numbers


@dataclass(frozen=True, slots=True, eq=False)
class Indentation:
    """Equilibrium of a stack under an indenter.

    Attributes:
        stack: the layers.
        force: force on the indenter [N].
        depth: depth of the indenter's lowest point under the undeformed top [m].
        contact_radius: radius of the contact area in the deformed body [m].
        radii: radii of points of the deformed contact face, rising [m].
        pressure: contact pressure at these radii [Pa].
        r: undeformed radii of the displacement nodes, (nr,) [m].
        z: undeformed heights of the displacement nodes over the base, (nz,) [m].
        displacement: radial and upward, (nr, nz, 2) [m].
        mean_stress: mean stress of each layer at the corners of cells, r[::2] and z[::2], (layers,
            nr', nz') [Pa]; NaN outside the layer.
        energies: isochoric strain energy of every layer [J].
        volume_ratios: deformed over undeformed volume of every layer.
    """

    stack: Stack
    force: float
    depth: float
    contact_radius: float
    radii: Array
    pressure: Array
    r: Array
    z: Array
    displacement: Array
    mean_stress: Array
    energies: Array
    volume_ratios: tuple[float, ...]

    def thinning(self, layer: int) -> float:
        """Thinning of a layer on the axis: 1 - thickness over undeformed thickness."""
        below, above = np.searchsorted(
            self.z, np.array(self.stack.levels[layer : layer + 2]) - 1e-9
        )
        shortened = self.displacement[0, below, 1] - self.displacement[0, above, 1]
        return float(shortened / (self.z[above] - self.z[below]))
