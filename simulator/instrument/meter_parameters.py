"""Parameters of a four-terminal meter as bounded, dimensionless numbers for a fit."""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eitskin.errors import ConfigurationError
from eitskin.simulator.instrument.meter import LOADS, FourTerminalMeter

Array = NDArray[np.float64]

PER_ELECTRODE = ("leaks", "leads")
FITTED = (*LOADS, *PER_ELECTRODE, "common_mode", "offset")
"""Terms of a meter that a fit may change, beside its scale."""
USUAL = (*LOADS, "common_mode")
SHORT = 0.999
"""Largest share of a load, Y Z / (1 + Y Z), in a fit: an admittance of 999 / Z is a short."""
LARGEST = 3.0
"""Largest coordinate of common mode and offset; 2 and -2 read one sense lead alone."""


@dataclass(frozen=True, slots=True)
class MeterParameter:
    """One real number of a meter: a term, or the part of a term, of one electrode.

    A fit sees the number as a coordinate: admittances Y to ground and resistances R of leads as
    Y Z / (1 + Y Z) and R / (R + Z) with an impedance Z typical of the sensor, which are 0 for none
    and near 1 for a short and an open lead; offsets, before the scale, as a multiple of Z.

    Attributes:
        term: attribute of `FourTerminalMeter`.
        electrode: number of the electrode in `leaks` and `leads`; None for other terms.
        imaginary: whether the number is the imaginary part of the term.
    """

    term: str
    electrode: int | None = None
    imaginary: bool = False

    def __str__(self) -> str:
        """Name in reports, such as "sink" or "leaks[3] (imaginary)"."""
        place = "" if self.electrode is None else f"[{self.electrode}]"
        return f"{self.term}{place}{' (imaginary)' if self.imaginary else ''}"

    @property
    def is_share(self) -> bool:
        """Whether the coordinate is a share from 0 to 1."""
        return self.term in (*LOADS, *PER_ELECTRODE)

    @property
    def unit(self) -> str:
        """Unit of the number; empty where it has none."""
        if self.term in ("leads", "offset"):
            return "ohm"
        return "S" if self.is_share else ""

    @property
    def bounds(self) -> tuple[float, float]:
        """Least and largest coordinate."""
        if self.is_share:
            return 0.0, SHORT
        return -LARGEST, LARGEST

    def per_unit(self, typical: float) -> float:
        """Number per unit of the coordinate, and for shares per Y Z or R / Z [S, ohm or 1]."""
        if self.unit == "ohm":
            return typical
        return 1.0 / typical if self.unit == "S" else 1.0

    def number(self, coordinate: float, typical: float) -> float:
        """Number of the meter for a coordinate and a typical impedance [ohm]."""
        whole = coordinate / (1.0 - coordinate) if self.is_share else coordinate
        return whole * self.per_unit(typical)

    def slope(self, coordinate: float, typical: float) -> float:
        """Derivative of the number by the coordinate."""
        steepness = 1.0 / (1.0 - coordinate) ** 2 if self.is_share else 1.0
        return steepness * self.per_unit(typical)


def meter_parameters(
    terms: Sequence[str], n_electrodes: int, *, complex_terms: bool
) -> tuple[MeterParameter, ...]:
    """Parameters of the named terms, in the order of `FITTED`.

    Args:
        terms: names among `FITTED`.
        n_electrodes: number of electrodes, each with a leak and a lead of its own.
        complex_terms: whether terms have imaginary parts; leads and common mode stay real.

    Raises:
        ConfigurationError: for an unknown term.
    """
    unknown = [term for term in terms if term not in FITTED]
    if unknown:
        raise ConfigurationError(
            f"expected terms among {', '.join(FITTED)}, got {', '.join(unknown)}"
        )
    found = []
    for term in FITTED:
        if term not in terms:
            continue
        numbers = range(n_electrodes) if term in PER_ELECTRODE else (None,)
        parts = (
            (False, True) if complex_terms and term not in ("leads", "common_mode") else (False,)
        )
        found += [MeterParameter(term, k, part) for k in numbers for part in parts]
    return tuple(found)


def meter_with(
    start: FourTerminalMeter,
    parameters: Sequence[MeterParameter],
    coordinates: Array,
    typical: float,
    n_electrodes: int,
) -> FourTerminalMeter:
    """Meter `start` with the numbers that belong to the coordinates (parameters,)."""
    terms: dict[str, complex] = {}
    several: dict[str, list[complex]] = {}
    for parameter, coordinate in zip(parameters, coordinates, strict=True):
        number = parameter.number(float(coordinate), typical) * (1j if parameter.imaginary else 1.0)
        if parameter.electrode is None:
            terms[parameter.term] = terms.get(parameter.term, 0.0) + number
        else:
            row = several.setdefault(parameter.term, [0.0] * n_electrodes)
            row[parameter.electrode] += number
    rows = {name: tuple(row) for name, row in several.items()}
    return dataclasses.replace(start, **terms, **rows)  # type: ignore[arg-type]
