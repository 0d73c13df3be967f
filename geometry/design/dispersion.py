"""Conductivities that depend on the frequency: Cole-Cole relaxations, and tables."""

import dataclasses
from dataclasses import dataclass
from itertools import pairwise
from typing import TypeAlias

import numpy as np

from eitskin.bounds import LEAST, MOST, require_in_range, require_positive
from eitskin.errors import ConfigurationError

FREQUENCY = 40e3
"""Frequency at which sensors are measured where none is given [Hz]."""
MIN_FREQUENCY, MAX_FREQUENCY = 1e-3, 1e9
_VACUUM = 8.8541878188e-12  # permittivity [F/m]


@dataclass(frozen=True, slots=True)
class ColeCole:
    """Conductivity with relaxations of Cole and Cole (J. Chem. Phys. 9 (1941) 341-351).

    sigma(f) = ionic + j omega eps_0 (permittivity + sum_k s_k / (1 + (j omega tau_k)^(1 - a_k))),
    in which Gabriel, Lau and Gabriel (Phys. Med. Biol. 41 (1996) 2271-2293) tabulate tissues.

    Attributes:
        ionic: conductivity at zero frequency [S/m].
        strengths: s_k, drops of the relative permittivity.
        times: tau_k, relaxation times [s].
        spreads: a_k, from 0 to less than 1; zeros when omitted.
        permittivity: relative permittivity above all relaxations.

    Example:
        >>> from eitskin.geometry import ColeCole
        >>> abs(ColeCole(0.5, strengths=(7000.0,), times=(3.5e-7,)).evaluate(40e3)) > 0.5
        True
    """

    ionic: float
    strengths: tuple[float, ...] = ()
    times: tuple[float, ...] = ()
    spreads: tuple[float, ...] = ()
    permittivity: float = 1.0

    def __post_init__(self) -> None:
        """Check the terms; raises ConfigurationError for others than a passive material has."""
        if not self.spreads:
            object.__setattr__(self, "spreads", (0.0,) * len(self.strengths))
        if not len(self.strengths) == len(self.times) == len(self.spreads):
            raise ConfigurationError(
                "a Cole-Cole conductivity needs a time and a spread for each strength, got "
                f"{len(self.strengths)} strengths, {len(self.times)} times and "
                f"{len(self.spreads)} spreads"
            )
        require_positive("conductivity ionic", self.ionic, "S/m")
        require_in_range("conductivity permittivity", self.permittivity, 0.0, MOST)
        for name, values, least, most in (
            ("strengths", self.strengths, 0.0, MOST),
            ("times", self.times, LEAST, MOST),
            ("spreads", self.spreads, 0.0, 0.999),
        ):
            for value in values:
                require_in_range(f"each of conductivity {name}", value, least, most)

    def evaluate(self, frequency: float) -> complex:
        """Conductivity at a frequency [Hz], as an admittivity [S/m]."""
        j_omega = 2j * np.pi * frequency
        terms = zip(self.strengths, self.times, self.spreads, strict=True)
        parts = (s / (1.0 + (j_omega * tau) ** (1.0 - a)) for s, tau, a in terms)
        return complex(self.ionic + j_omega * _VACUUM * (self.permittivity + sum(parts)))

    def scale(self, factor: float) -> "ColeCole":
        """Conductivity times a factor at every frequency."""
        return dataclasses.replace(
            self,
            ionic=factor * self.ionic,
            strengths=tuple(factor * strength for strength in self.strengths),
            permittivity=factor * self.permittivity,
        )


@dataclass(frozen=True, slots=True)
class ConductivityTable:
    """Conductivities at rising frequencies, linear in the logarithm of the frequency between.

    Attributes:
        frequencies: frequencies, rising [Hz].
        values: conductivity at each frequency, complex for an admittivity [S/m].

    Example:
        >>> from eitskin.geometry import ConductivityTable
        >>> ConductivityTable((1e3, 1e5), (0.4, 0.5 + 0.1j)).evaluate(1e4)
        (0.45+0.05j)
    """

    frequencies: tuple[float, ...]
    values: tuple[complex, ...]

    def __post_init__(self) -> None:
        """Check the table; raises ConfigurationError for frequencies that do not rise."""
        f = self.frequencies
        if len(f) != len(self.values) or not f or any(b <= a for a, b in pairwise(f)):
            raise ConfigurationError(
                "a table of conductivities needs rising frequencies and a value for each, got "
                f"{len(f)} frequencies {f} and {len(self.values)} values"
            )
        for value in f:
            require_frequency(value)
        for each in self.values:
            require_conductivity("each of conductivity values", each)

    def evaluate(self, frequency: float) -> complex:
        """Conductivity at a frequency of the table's range [Hz], as an admittivity [S/m].

        Raises ConfigurationError for a frequency beyond the range.
        """
        low, high = self.frequencies[0], self.frequencies[-1]
        require_in_range("frequency of a table of conductivities", frequency, low, high, "Hz")
        x, values = np.log(self.frequencies), np.array(self.values)
        return complex(np.round(np.interp(np.log(frequency), x, values), 15))

    def scale(self, factor: float) -> "ConductivityTable":
        """Conductivity times a factor at every frequency."""
        return dataclasses.replace(self, values=tuple(factor * value for value in self.values))


Dispersion: TypeAlias = ColeCole | ConductivityTable


def require_conductivity(name: str, value: complex | Dispersion) -> None:
    """Raise ConfigurationError unless a conductivity [S/m] has a positive real part in bounds."""
    if isinstance(value, Dispersion):
        return
    require_positive(name if np.isrealobj(value) else f"{name}'s real part", np.real(value), "S/m")
    require_in_range(f"{name}'s imaginary part", float(np.imag(value)), -MOST, MOST, "S/m")


def require_frequency(frequency: float) -> None:
    """Raise ConfigurationError unless a frequency is within what sensors are measured at."""
    require_in_range("frequency", frequency, MIN_FREQUENCY, MAX_FREQUENCY, "Hz")


def resolve_conductivity(value: complex | Dispersion, frequency: float | None = None) -> complex:
    """Conductivity at a frequency [Hz], real where it has no imaginary part [S/m].

    `FREQUENCY` when omitted. Raises ConfigurationError for a frequency that cannot be.
    """
    if frequency is not None:
        require_frequency(frequency)
    if isinstance(value, Dispersion):
        value = value.evaluate(FREQUENCY if frequency is None else frequency)
    return value if np.imag(value) else float(np.real(value))


def scale_conductivity(value: complex | Dispersion, factor: float) -> complex | Dispersion:
    """Conductivity times a factor, at every frequency."""
    return value.scale(factor) if isinstance(value, Dispersion) else factor * value
