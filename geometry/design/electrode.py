"""Electrode of a sensor: position, size, shape and contact impedance."""

import math
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eitskin.bounds import LONGEST, require_length
from eitskin.errors import ConfigurationError
from eitskin.files import shorten_text

Array = NDArray[np.float64]

On = Literal["side", "top", "bottom", "inside", "surface"]
Shape = Literal["rectangle", "round"]

LEAST_IMPEDANCE, GREATEST_IMPEDANCE = 1e-10, 1e6
_ROUND_SIDES = 32


@dataclass(frozen=True, slots=True)
class Electrode:
    """Contact area of given position, size and contact impedance.

    Attributes:
        x, y: centre [m]; on the outline for an electrode on the side.
        width: extent along the outline, on the side; along x elsewhere; horizontal, on a
            surface [m].
        contact_impedance: z of the complete electrode model [ohm m2].
        height: extent across the width [m]; the full thickness on the side, else the width, when
            omitted.
        z: height of the centre [m]; the middle on the side when omitted, needed inside and on a
            surface, where the nearest point to (x, y, z) is taken.
        on: face that carries the electrode; "inside" is a thin sheet within the layer, "surface"
            is for a `Surface`.
        shape: "round" makes an ellipse of width and height, as a polygon of the same area.

    Example:
        >>> from eitskin.geometry import Electrode
        >>> Electrode(x=0.075, y=0.0, width=0.005).on
        'side'
    """

    x: float
    y: float
    width: float = 0.005
    contact_impedance: complex = 1e-3
    height: float | None = None
    z: float | None = None
    on: On = "side"
    shape: Shape = "rectangle"

    def __post_init__(self) -> None:
        """Check everything that does not depend on the outline."""
        require_length("electrode width", self.width)
        if self.height is not None:
            require_length("electrode height", self.height)
        position = (self.x, self.y, self.z or 0.0)
        if not all(abs(value) <= LONGEST for value in position):
            raise ConfigurationError(
                f"electrode position must be within {LONGEST:g} m, got {position}"
            )
        for name, kind in (("on", On), ("shape", Shape)):
            if getattr(self, name) not in get_args(kind):
                choices = ", ".join(f"'{choice}'" for choice in get_args(kind))
                raise ConfigurationError(
                    f"electrode {name} must be one of {choices}, got {getattr(self, name)!r}"
                )
        self._check_combination()
        require_contact_impedance(self.contact_impedance)

    def footprint(self) -> Array:
        """Corners (k, 2) [m] relative to the centre, counter-clockwise, along width and height."""
        extent = np.array([self.width, self.height or self.width])
        if self.shape == "rectangle":
            unit = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])
        else:
            step = 2.0 * math.pi / _ROUND_SIDES
            angle = step * (np.arange(_ROUND_SIDES) + 0.5)
            # A regular n-gon of circumradius r has the area n r^2 sin(2 pi / n) / 2.
            radius = 0.5 * math.sqrt(step / math.sin(step))
            unit = radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        corners: Array = extent * unit
        return corners

    def _check_combination(self) -> None:
        """Raise ConfigurationError for attributes that contradict the face."""
        if self.on == "side" and self.shape == "round":
            raise ConfigurationError("an electrode on the side is a rectangle; leave out shape")
        if self.on == "side" and self.z is not None and self.height is None:
            raise ConfigurationError(
                "an electrode on the side without height covers the full thickness; give its "
                "height, or leave out z"
            )
        if self.on in ("top", "bottom") and self.z is not None:
            raise ConfigurationError(
                f"the height of an electrode on the {self.on} is known; leave out z"
            )
        if self.on in ("inside", "surface") and self.z is None:
            raise ConfigurationError(
                f'an electrode with on = "{self.on}" needs the height z of its centre, in m'
            )


def require_contact_impedance(value: complex) -> None:
    """Raise ConfigurationError unless `value` [ohm m2] may be the impedance of a contact."""
    z = complex(value)
    if not (z.real > 0.0 and LEAST_IMPEDANCE <= abs(z) <= GREATEST_IMPEDANCE):
        raise ConfigurationError(
            f"electrode contact_impedance must be between {LEAST_IMPEDANCE:g} and "
            f"{GREATEST_IMPEDANCE:g} ohm m2 in magnitude, with a positive real part, got "
            f"{value!r} ohm m2; it is the impedance of a contact times its area"
        )


def read_contact_impedances(given: ArrayLike, count: int) -> NDArray[np.inexact]:
    """Contact impedances of `count` electrodes [ohm m2] from one or all of them, (count,).

    Raises ConfigurationError for others than numbers that can be.
    """
    try:
        z = np.broadcast_to(np.asarray(given, dtype=np.complex128), count)
    except (TypeError, ValueError) as error:
        raise ConfigurationError(
            f"contact_impedance must be a number, or one for each of {count} electrodes, got "
            f"{shorten_text(repr(given))}"
        ) from error
    for each in z:
        require_contact_impedance(complex(each))
    return z if z.imag.any() else z.real
