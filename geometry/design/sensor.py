"""Design of a sensor: outline, thickness, electrodes, conductivity, support."""

import dataclasses
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eitskin.bounds import (
    MOST_ELECTRODES,
    require_axes,
    require_count,
    require_length,
    require_positive,
)
from eitskin.config import Location, build, choose, read, read_toml, to_toml, write_toml
from eitskin.errors import ConfigurationError
from eitskin.extras import old_names
from eitskin.geometry.design.contact_areas import contact_areas, require_disjoint
from eitskin.geometry.design.dispersion import (
    Dispersion,
    require_conductivity,
    resolve_conductivity,
)
from eitskin.geometry.design.electrode import Electrode
from eitskin.geometry.design.outline import Outline, Rectangle
from eitskin.geometry.design.patches import Patch
from eitskin.geometry.design.regular_layouts import grid, uniform
from eitskin.geometry.design.surface import Surface

Array = NDArray[np.float64]
_THICKNESS_TOLERANCE = 1e-9  # relative difference of thicknesses that count as equal
_HEIGHT_TOLERANCE = 1e-6  # likewise for the height of a surface, which files give in few digits
_POINTS_PER_EDGE = 8


def warn_of_grid(call: str) -> None:
    """Warn of arguments of version 0.2 that reported about which values solutions are shared."""
    warnings.warn(
        f"{call}: these arguments have no effect any more; give "
        "Simulator(..., grid=SensorGrid(...)) to share solutions between similar sensors",
        DeprecationWarning,
        stacklevel=4,
    )


@dataclass(frozen=True, slots=True)
class Rigid:
    """Rigid base: the whole bottom face is bonded, and follows a bend.

    Example:
        >>> from eitskin.geometry import Rigid, SensorDesign
        >>> SensorDesign.reference().support == Rigid()
        True
    """


@dataclass(frozen=True, slots=True)
class Plates:
    """Two rigid plates of a hinge: the bottom face is bonded to them and free between them.

    Attributes:
        span: free length along x between the plates, centred on the sensor [m]. The bottom is
            bonded where |x - length / 2| >= span / 2.

    Example:
        >>> from eitskin.geometry import Plates
        >>> Plates(span=0.030).span
        0.03
    """

    span: float = 0.040

    def __post_init__(self) -> None:
        require_length("support span", self.span)

    def gap(self, outline: Outline) -> tuple[float, float]:
        """Minimum and maximum x of the free part of the bottom face [m]."""
        middle = 0.5 * outline.length
        return middle - 0.5 * self.span, middle + 0.5 * self.span


@dataclass(frozen=True, slots=True)
class Substrate:
    """Soft layer on rigid ground, bonded to the ground and to the whole bottom face.

    Attributes:
        thickness: thickness of the substrate [m].
        shear_modulus: modulus of the substrate, neo-Hookean, compressible as the sensor is [Pa].

    Example:
        >>> from eitskin.geometry import Substrate
        >>> Substrate(thickness=0.010, shear_modulus=5e3).thickness
        0.01
    """

    thickness: float
    shear_modulus: float

    def __post_init__(self) -> None:
        require_length("support thickness", self.thickness)
        require_positive("support shear_modulus", self.shear_modulus, "Pa")


@dataclass(frozen=True, slots=True)
class Free:
    """No base: the sensor is a membrane, its outer sides held, its bottom face free.

    Example:
        >>> from eitskin.geometry import Free, SensorDesign
        >>> import dataclasses
        >>> dataclasses.replace(SensorDesign.reference(), support=Free()).support
        Free()
    """


Support = Rigid | Plates | Substrate | Free


def require_fit(support: Support, outline: Outline) -> None:
    """Raise ConfigurationError unless a body of this outline can rest on the support."""
    if isinstance(outline, Surface) and not isinstance(support, Rigid):
        raise ConfigurationError(
            "the support of a body given by a surface must be 'rigid', got "
            f"{support}; leave it out, or give the rim of a flat sensor as "
            "outline = { points = [...] }"
        )
    if isinstance(support, Plates) and not support.span < outline.length:
        raise ConfigurationError(
            "the span between the plates must be less than the sensor's length of "
            f"{outline.length:g} m, got {support.span:g} m; for a sensor without a base say "
            "support = 'free'"
        )


@dataclass(frozen=True, slots=True)
class Layer:
    """Conductive sheet of a layered sensor: thickness [m], conductivity [S/m], as of a design.

    Example:
        >>> from eitskin.geometry import Layer
        >>> Layer(thickness=0.002, conductivity=0.5).conductivity
        0.5
    """

    thickness: float
    conductivity: complex | Dispersion

    def __post_init__(self) -> None:
        require_length("layer thickness", self.thickness)
        require_conductivity("layer conductivity", self.conductivity)


@lru_cache(maxsize=64)  # many designs differ in materials alone
def _check_contacts(electrodes: tuple[Electrode, ...], outline: Outline, thickness: float) -> None:
    require_disjoint(contact_areas(electrodes, outline, thickness))


@old_names(conductivity_at="evaluate_conductivity", expanded="expand_data")
@dataclass(frozen=True, slots=True)
class SensorDesign:
    """Conductive body with electrodes, flat or of any shape, inside a soft encapsulation.

    Attributes:
        outline: shape of the body. The bounding box of a plane outline starts at the origin; the
            body extends from z = 0 to `thickness`; a surface keeps the coordinates of its file.
        thickness: thickness of the conductive body, along z [m].
        electrodes: list of electrodes, in the order of their numbers.
        conductivity: conductivity of the body [S/m], complex for an admittivity, or by the
            frequency.
        layers: sheets from the bottom upwards; their thicknesses add up to `thickness`.
        encapsulated_thickness: thickness of body and encapsulation together, body centred [m].
        support: base that the bottom face of the encapsulation rests on.

    Example:
        >>> from eitskin import SensorDesign
        >>> design = SensorDesign.reference()
        >>> len(design.electrodes), design.thickness
        (8, 0.005)
    """

    outline: Outline
    thickness: float
    electrodes: tuple[Electrode, ...]
    conductivity: complex | Dispersion = 1.0
    layers: tuple[Layer, ...] = ()
    encapsulated_thickness: float = 0.012
    support: Support = field(default_factory=Rigid)

    def __post_init__(self) -> None:
        """Check that sizes, layers and electrodes agree, and that no electrodes overlap."""
        for name in ("electrodes", "layers"):  # lists are taken, too: designs are keys of tables
            object.__setattr__(self, name, tuple(getattr(self, name)))
        self._check_thickness()
        require_conductivity("conductivity", self.conductivity)
        self._check_layers()
        require_fit(self.support, self.outline)
        require_count("the number of electrodes", len(self.electrodes), 2, MOST_ELECTRODES)
        _check_contacts(self.electrodes, self.outline, self.thickness)

    @classmethod
    def reference(cls) -> "SensorDesign":
        """Reference sensor of the paper: 150 x 60 x 5 mm, eight 5 mm electrodes."""
        outline = Rectangle(0.150, 0.060)
        return cls(outline, thickness=0.005, electrodes=uniform(outline, 8, start=0.0225))

    @classmethod
    def from_toml(cls, path: str | Path) -> "SensorDesign":
        """Read a design from a TOML file; raises ConfigurationError where the file is invalid."""
        return read_toml(cls, path)

    @classmethod
    def expand_data(cls, data: Mapping[str, Any], location: Location) -> Mapping[str, Any]:
        """Plain data of a design, its layout (`electrodes` as one table) replaced by electrodes."""
        table = data.get("electrodes")
        if not isinstance(table, Mapping):
            return data
        if "outline" not in data:
            raise location.error("missing required field `outline`, which the layout goes around")
        where = location.child("electrodes")
        outline = read(Outline, data["outline"], location.child("outline"))
        layout = choose([partial(make, outline) for make in (uniform, grid)], table, where)
        return {**data, "outline": outline, "electrodes": build(layout, table, where)}

    def to_toml(self, path: str | Path | None = None) -> str:
        """TOML text of the design, for `from_toml`; also written to `path` where one is given.

        Raises ConfigurationError where the file cannot be written; an older file is kept.
        """
        return to_toml(self) if path is None else write_toml(self, path)

    @property
    def centre(self) -> tuple[float, float, float]:
        """Middle of the body's bounding box [m]."""
        if isinstance(self.outline, Surface):
            x, y, z = self.outline.bounds.mean(axis=0).tolist()
            return (x, y, z)
        return (0.5 * self.outline.length, 0.5 * self.outline.width, 0.5 * self.thickness)

    def patches(self) -> tuple[Patch, ...]:
        """Contact area of each electrode, on the boundary of the body or inside it."""
        contacts = contact_areas(self.electrodes, self.outline, self.thickness)
        return tuple(contact.patch() for contact in contacts)

    @property
    def contact_impedance(self) -> NDArray[np.inexact]:
        """Contact impedances [ohm m2], (electrodes,); complex where any electrode's is."""
        z = np.array([electrode.contact_impedance for electrode in self.electrodes])
        return z if np.any(np.imag(z)) else np.real(z)

    @property
    def is_complex(self) -> bool:
        """Whether a contact impedance, or a conductivity at 40 kHz, is complex."""
        values = [self.conductivity, *(layer.conductivity for layer in self.layers)]
        own = any(np.iscomplexobj(resolve_conductivity(value)) for value in values)
        return own or np.iscomplexobj(self.contact_impedance)

    def edges(self, spacing: float | None = None) -> Array:
        """Points (k, 3) [m] along the electrodes' edges, where potentials are singular.

        Edges of the body are left out: the potential continues mirrored across them.

        Args:
            spacing: largest distance between points of one edge; an eighth of the smallest
                electrode's extent when omitted [m].

        Raises ConfigurationError for a spacing that is no length.
        """
        if spacing is not None:
            require_length("spacing", spacing)
        extents = [e.width for e in self.electrodes]
        extents += [e.height or self.thickness for e in self.electrodes]
        spacing = spacing or min(extents) / _POINTS_PER_EDGE
        contacts = contact_areas(self.electrodes, self.outline, self.thickness)
        return np.concatenate([contact.edges(spacing) for contact in contacts])

    def resolve_frequency(self, frequency: float | None) -> "SensorDesign":
        """Design whose conductivities are the numbers at a frequency [Hz]; 40 kHz for None.

        Raises ConfigurationError for a frequency that cannot be, or is beyond a table.
        """
        values = (self.conductivity, *(layer.conductivity for layer in self.layers))
        own, *sheets = (resolve_conductivity(value, frequency) for value in values)
        if not any(isinstance(value, Dispersion) for value in values):
            return self
        layers = (
            dataclasses.replace(layer, conductivity=sheet)
            for layer, sheet in zip(self.layers, sheets, strict=True)
        )
        return dataclasses.replace(self, conductivity=own, layers=tuple(layers))

    def evaluate_conductivity(self, points: ArrayLike) -> NDArray[np.inexact]:
        """Conductivity (...) [S/m] at points (..., 3) [m], complex where that of any layer is.

        A point between two layers belongs to the upper one, an outer point to the nearest layer.
        Where conductivities depend on the frequency, they are those at 40 kHz.
        """
        places = np.asarray(points, dtype=float)
        require_axes("points", places, 3)
        z = places[..., 2]
        if not self.layers:
            return np.full(z.shape, resolve_conductivity(self.conductivity))
        bottom = self.outline.bounds[0, 2] if isinstance(self.outline, Surface) else 0.0
        tops = bottom + np.cumsum([layer.thickness for layer in self.layers])
        values = np.array([resolve_conductivity(layer.conductivity) for layer in self.layers])
        inside: NDArray[np.inexact] = values[np.searchsorted(tops[:-1], z, side="right")]
        return inside

    def _check_thickness(self) -> None:
        require_length("thickness", self.thickness)
        require_length("encapsulated_thickness", self.encapsulated_thickness)
        if not self.encapsulated_thickness >= self.thickness:
            raise ConfigurationError(
                f"encapsulated_thickness must be at least the layer's {self.thickness:g} m, "
                f"got {self.encapsulated_thickness:g} m"
            )
        if isinstance(self.outline, Surface):
            height = self.outline.height
            if abs(self.thickness - height) > _HEIGHT_TOLERANCE * height:
                raise ConfigurationError(
                    f"thickness must be the height of the surface, {height:.9g} m, "
                    f"got {self.thickness:g} m"
                )

    def _check_layers(self) -> None:
        if not self.layers:
            return
        total = sum(layer.thickness for layer in self.layers)
        if abs(total - self.thickness) > _THICKNESS_TOLERANCE * self.thickness:
            raise ConfigurationError(
                f"the layers' thicknesses must add up to the thickness of {self.thickness:g} m, "
                f"got {total:.9g} m"
            )
        if self.conductivity != 1.0:
            raise ConfigurationError(
                "give either one conductivity or layers with conductivities of their own, got "
                f"conductivity {self.conductivity} and {len(self.layers)} layers"
            )
