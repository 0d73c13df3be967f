"""Parameters of the fits of physical numbers, and those of a four-terminal meter."""

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from eitskin.errors import ConfigurationError
from eitskin.simulator.instrument.meter import LOADS, FourTerminalMeter

Array = NDArray[np.float64]

PER_ELECTRODE = ("leaks", "leads")
FIT_PARAMETERS = (*LOADS, *PER_ELECTRODE, "common_mode", "offset")
"""Terms of a meter that a fit may change, next to its scale."""
USUAL = (*LOADS, "common_mode")
SHORT = 0.999
"""Largest share of a load, Y Z / (1 + Y Z), in a fit: an admittance of 999 / Z is a short."""
MAX_COORDINATE = 3.0
"""Largest coordinate of common mode and offset; 2 and -2 read one sense lead alone."""


@dataclass(frozen=True, slots=True)
class Parameter:
    """Physical number that is fitted, as a function of a dimensionless coordinate x.

    Attributes:
        name: kind of the number.
        centre: number at x = 0.
        spread: change of the number by a unit of x: added to the centre where the number is
            linear, a factor of the centre where it is lognormal, a share where it is one.
        transform: "linear", centre + spread x; "factor", centre spread^x; or "share",
            s / (1 - s) with s = spread x, which is 0 for none and near 1 for as much as there
            can be.
        unit: unit of the number; empty where it has none.
        bounds: smallest and largest coordinate of a fit.
        electrode: number of the electrode; None for numbers of the whole.
        imaginary: whether the number is the imaginary part of a complex one.
        scale: factor of linear numbers and of shares [unit].
    """

    name: str
    centre: float
    spread: float
    transform: Literal["linear", "factor", "share"] = "factor"
    unit: str = ""
    bounds: tuple[float, float] = (-math.inf, math.inf)
    electrode: int | None = None
    imaginary: bool = False
    scale: float = 1.0

    def __str__(self) -> str:
        """Name in reports, such as "sink" or "leaks[3] (imaginary)"."""
        place = "" if self.electrode is None else f"[{self.electrode}]"
        return f"{self.name}{place}{' (imaginary)' if self.imaginary else ''}"

    def number(self, x: float) -> float:
        """Number at a coordinate."""
        if self.transform == "factor":
            return self.centre * float(self.spread**x)
        step = self.spread * x
        return self.centre + (step / (1.0 - step) if self.is_share else step) * self.scale

    def slope(self, x: float) -> float:
        """Derivative of the number by the coordinate."""
        if self.transform == "factor":
            return math.log(self.spread) * self.number(x)
        steepness = 1.0 / (1.0 - self.spread * x) ** 2 if self.is_share else 1.0
        return self.spread * (steepness * self.scale)

    def coordinate(self, number: float) -> float:
        """Coordinate of a number."""
        if self.transform == "factor":
            return math.log(number / self.centre) / math.log(self.spread)
        ratio = (number - self.centre) / self.scale
        return (ratio / (1.0 + ratio) if self.is_share else ratio) / self.spread

    @property
    def is_share(self) -> bool:
        """Whether the coordinate is a share, from 0 on."""
        return self.transform == "share"

    def with_prior(self, deviation: float) -> "Parameter":
        """The same number, its coordinate counted in standard deviations of a prior."""
        low, high = self.bounds
        bounds = (low / deviation, high / deviation)
        return dataclasses.replace(self, spread=deviation * self.spread, bounds=bounds)


def meter_parameters(
    terms: Sequence[str], n_electrodes: int, typical: float, *, complex_terms: bool
) -> tuple[Parameter, ...]:
    """Parameters of the named terms of a meter, in the order of `FIT_PARAMETERS`.

    Admittances Y to ground and resistances R of leads have the coordinates Y Z / (1 + Y Z) and
    R / (R + Z), with an impedance Z typical of the sensor: 0 for none, near 1 for a short and an
    open lead. Offsets, before the scale, are multiples of Z.

    Args:
        terms: names among `FIT_PARAMETERS`.
        n_electrodes: number of electrodes, each with a leak and a lead of its own.
        typical: Z [ohm].
        complex_terms: whether terms have imaginary parts; leads and common mode stay real.

    Raises:
        ConfigurationError: for an unknown term.
    """
    unknown = [term for term in terms if term not in FIT_PARAMETERS]
    if unknown:
        raise ConfigurationError(
            f"expected terms among {', '.join(FIT_PARAMETERS)}, got {', '.join(unknown)}"
        )
    parameters = []
    for term in FIT_PARAMETERS:
        if term not in terms:
            continue
        share = term in (*LOADS, *PER_ELECTRODE)
        unit = "ohm" if term in ("leads", "offset") else "S" if share else ""
        scale = {"ohm": typical, "S": 1.0 / typical, "": 1.0}[unit]
        bounds = (0.0, SHORT) if share else (-MAX_COORDINATE, MAX_COORDINATE)
        transform: Literal["share", "linear"] = "share" if share else "linear"
        is_complex = complex_terms and term not in ("leads", "common_mode")
        parameters += [
            Parameter(term, 0.0, 1.0, transform, unit, bounds, k, part, scale)
            for k in (range(n_electrodes) if term in PER_ELECTRODE else (None,))
            for part in ((False, True) if is_complex else (False,))
        ]
    return tuple(parameters)


def meter_from_coordinates(
    start: FourTerminalMeter,
    parameters: Sequence[Parameter],
    coordinates: Array,
    n_electrodes: int,
) -> FourTerminalMeter:
    """Meter `start` with the numbers that belong to the coordinates (parameters,)."""
    terms: dict[str, complex] = {}
    several: dict[str, list[complex]] = {}
    for parameter, x in zip(parameters, coordinates, strict=True):
        number = parameter.number(float(x)) * (1j if parameter.imaginary else 1.0)
        if parameter.electrode is None:
            terms[parameter.name] = terms.get(parameter.name, 0.0) + number
        else:
            row = several.setdefault(parameter.name, [0.0] * n_electrodes)
            row[parameter.electrode] += number
    rows = {name: tuple(row) for name, row in several.items()}
    return dataclasses.replace(start, **terms, **rows)  # type: ignore[arg-type]


def central_differences(
    function: Callable[[Array], Array], x: Array, bounds: tuple[Array, Array], step: float
) -> Array:
    """Derivatives of a function of coordinates (parameters,), (..., parameters).

    By central differences; to one side at the bounds, (parameters,) each.
    """
    columns = []
    for k, (low, high) in enumerate(zip(*bounds, strict=True)):
        ends = [np.array(x, dtype=float), np.array(x, dtype=float)]
        ends[0][k], ends[1][k] = max(x[k] - step, low), min(x[k] + step, high)
        below, above = (function(end) for end in ends)
        columns.append((above - below) / (ends[1][k] - ends[0][k]))
    return np.stack(columns, axis=-1)
