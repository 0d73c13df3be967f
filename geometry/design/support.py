"""Supports of a sensor: what its bottom face rests on."""

from dataclasses import dataclass

from eitskin.bounds import require_length, require_positive
from eitskin.errors import ConfigurationError
from eitskin.geometry.design.outline import Outline
from eitskin.geometry.design.surface import Surface


@dataclass(frozen=True, slots=True)
class Rigid:
    """Rigid base: the whole bottom face is bonded, and follows a bend."""


@dataclass(frozen=True, slots=True)
class Plates:
    """Two rigid plates of a hinge: the bottom face is bonded to them and free between them.

    Attributes:
        span: free length along x between the plates, centred on the sensor [m]. The bottom is
            bonded where |x - length / 2| >= span / 2.
    """

    span: float = 0.040

    def __post_init__(self) -> None:
        require_length("support span", self.span)

    def gap(self, outline: Outline) -> tuple[float, float]:
        """Least and greatest x of the free part of the bottom face [m]."""
        middle = 0.5 * outline.length
        return middle - 0.5 * self.span, middle + 0.5 * self.span


@dataclass(frozen=True, slots=True)
class Substrate:
    """Soft layer on rigid ground, bonded to the ground and to the whole bottom face.

    Attributes:
        thickness: of the substrate [m].
        shear_modulus: of the substrate, neo-Hookean and as little compressible as the sensor [Pa].
    """

    thickness: float
    shear_modulus: float

    def __post_init__(self) -> None:
        require_length("support thickness", self.thickness)
        require_positive("support shear_modulus", self.shear_modulus, "Pa")


@dataclass(frozen=True, slots=True)
class Free:
    """No base: the sensor is a membrane, its outer sides held, its bottom face free."""


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
