"""General four-terminal meter: loads and leaks, common mode, gains, offsets, limits, codes.

And parameters of fits of physical numbers, the meter's among them.

The sensor is the network between its electrodes, floating: with currents I into the electrodes that
sum to zero the potentials are U = Z I + c, with the impedance matrix Z and one potential c common
to all. Each electrode hangs on a lead of series resistance R_k and, at the meter's end of the lead,
on an admittance Y_k to ground. A balanced source sends J = +1 A into source and -1 A into sink.
Kirchhoff's current law at the meter's ends, I = J - Y V, gives

    (1 + (Z + R) Y) V - c = (Z + R) J,    sum(Y V) = 0.

Without any admittance the sensor floats; ground is then the mean of the electrode potentials.
"""

import dataclasses
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from eitskin.bounds import require_axes
from eitskin.errors import ConfigurationError
from eitskin.protocol import Protocol

Complex = NDArray[np.complex128]
Bools = NDArray[np.bool_]
Quantity: TypeAlias = Literal["complex", "signed", "magnitude"]

LOADS = ("source", "sink", "sense_plus", "sense_minus", "idle")
MAX_LOAD = 1e3
MAX_LEAD = 1e6
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
class FourTerminalMeter:
    """Four-terminal meter, by its circuit and its reading; the defaults are an ideal meter.

    A balanced source sends a current through source and sink, and the meter reads

        scale (V+ - V- + common_mode (V+ + V-) / 2) + offset

    per unit current, with the potentials V of its sense leads against ground. Admittances and
    resistances may be complex, `[real, imaginary]` in TOML: a capacitance C is [0, 2 pi f C].

    Attributes:
        source, sink, sense_plus, sense_minus: admittance from an electrode to ground while it has
            this role [S]; `sink = 1e3` makes a single-ended source.
        idle: admittance from every electrode without a role to ground [S].
        leaks: admittance from each electrode to ground, whatever its role [S]; empty for none.
        leads: resistance of each electrode's lead and multiplexer path [ohm]; empty for none.
        common_mode: inverse of the common-mode rejection ratio; 2 reads sense+ alone, twice.
        scale: reading per ohm; any other unit than the ohm, and its sign, is here.
        offset: offset of every reading.
        channel_scale: further factor of each measurement; empty for 1.
        channel_offset: further offset of each measurement; empty for 0.
        saturation: largest reading, of either sign and in each quadrature; 0 for no limit.
        step: distance between two codes, to which readings are rounded; 0 for none.
        reads: both quadratures, the real part, or the magnitude of both.

    Example:
        >>> from eitskin.simulator import FourTerminalMeter, Instrument
        >>> Instrument(meter=FourTerminalMeter(sink=1e-3)).meter.sink
        0.001
    """

    source: complex = 0.0
    sink: complex = 0.0
    sense_plus: complex = 0.0
    sense_minus: complex = 0.0
    idle: complex = 0.0
    leaks: tuple[complex, ...] = ()
    leads: tuple[complex, ...] = ()
    common_mode: complex = 0.0
    scale: complex = 1.0
    offset: complex = 0.0
    channel_scale: tuple[complex, ...] = ()
    channel_offset: tuple[complex, ...] = ()
    saturation: float = 0.0
    step: float = 0.0
    reads: Quantity = "complex"

    def __post_init__(self) -> None:
        """Check the terms; the ConfigurationError lists everything that is wrong."""
        if problems := list(self._problems()):
            raise ConfigurationError("no such meter: " + "; ".join(problems))

    @property
    def is_loaded(self) -> bool:
        """Whether the circuit differs from that of an ideal meter, before the reading's scale."""
        terms = (*(getattr(self, name) for name in LOADS), *self.leaks, *self.leads)
        return any(terms) or self.common_mode != 0.0

    def transfer_impedance(self, impedance: NDArray[np.inexact], protocol: Protocol) -> Complex:
        """Sensed voltage per unit current, before scale and offset [ohm], (..., measurements).

        Without loads, leaks and common mode this is `protocol.measure(impedance)`. The arguments
        and errors are those of `terminal_impedances`.
        """
        sensed: Complex = self.terminal_impedances(impedance, protocol)[..., 0, :]
        return sensed

    def terminal_impedances(self, impedance: NDArray[np.inexact], protocol: Protocol) -> Complex:
        """Sensed and driving voltage per unit current [ohm], (..., 2, measurements).

        The first is the transfer impedance, the second the impedance of the drive pair, as the
        source sees it: with its contacts, leads and loads.

        Args:
            impedance: electrode impedance matrices Z, (..., electrodes, electrodes) [ohm].
            protocol: drive and sense electrodes of each measurement.

        Raises:
            ConfigurationError: for leaks, leads or matrices of another number of electrodes.
        """
        transfer = protocol.measure(impedance)
        if not self.is_loaded:
            own = _drive_pairs(protocol).measure(impedance)
            return np.stack([transfer, own], axis=-2).astype(np.complex128)
        n = protocol.n_electrodes
        leads = _full_values("leads", self.leads, n, 0.0, "electrodes")
        V = _potentials(impedance, protocol, self.admittance(protocol), leads)
        rows, table = np.arange(len(protocol)), np.array(protocol.table).T
        source, sink, plus, minus = (V[..., rows, electrodes] for electrodes in table)
        sensed = plus - minus + 0.5 * self.common_mode * (plus + minus)
        return np.stack([sensed, source - sink], axis=-2).astype(np.complex128)

    def admittance(self, protocol: Protocol) -> Complex:
        """Admittance to ground of each electrode in each measurement, (measurements, n) [S]."""
        n = protocol.n_electrodes
        has_role = np.array(protocol.table).T[..., None] == np.arange(n)
        has_role = np.concatenate([has_role, ~has_role.any(axis=0, keepdims=True)])
        loads = np.array([getattr(self, name) for name in LOADS], np.complex128)
        leaks = _full_values("leaks", self.leaks, n, 0.0, "electrodes")
        return np.asarray(leaks + np.einsum("r,rmn->mn", loads, has_role))

    def reading(self, sensed: Complex) -> tuple[Complex, Bools]:
        """Readings, and whether each is beyond the limit; both of the shape of `sensed`.

        Args:
            sensed: sensed voltage per unit current, (..., measurements) [ohm].

        Raises:
            ConfigurationError: for scales or offsets of another number of measurements.
        """
        require_axes("sensed", sensed, None)
        m = sensed.shape[-1]
        gain = self.scale * _full_values(
            "channel_scale", self.channel_scale, m, 1.0, "measurements"
        )
        zero = self.offset + _full_values(
            "channel_offset", self.channel_offset, m, 0.0, "measurements"
        )
        value: Complex = gain * sensed + zero
        if self.reads == "magnitude":
            value = np.abs(value).astype(complex)
        elif self.reads == "signed":
            value = value.real.astype(complex)
        parts = np.stack([value.real, value.imag], axis=-1)
        beyond = np.zeros(value.shape, bool)
        if self.saturation:
            beyond = np.abs(parts).max(axis=-1) > self.saturation
            parts = np.clip(parts, -self.saturation, self.saturation)
        if self.step:
            parts = self.step * np.round(parts / self.step)
        return parts[..., 0] + 1j * parts[..., 1], beyond

    def require_fit(self, protocol: Protocol) -> None:
        """Raise ConfigurationError where numbers per electrode or channel do not fit."""
        for name in ("leaks", "leads"):
            _full_values(name, getattr(self, name), protocol.n_electrodes, 0.0, "electrodes")
        for name in ("channel_scale", "channel_offset"):
            _full_values(name, getattr(self, name), len(protocol), 0.0, "measurements")

    def _problems(self) -> Iterator[str]:
        for name, value in (
            *((name, getattr(self, name)) for name in LOADS),
            *((f"leaks[{k}]", value) for k, value in enumerate(self.leaks)),
        ):
            if not (min(np.real(value), np.imag(value)) >= 0.0 and abs(value) <= MAX_LOAD):
                yield (
                    f"{name} must be an admittance from 0 to {MAX_LOAD:g} S, in both parts "
                    f"not negative, got {value:g}; an impedance of Z ohm is 1 / Z"
                )
        for k, value in enumerate(self.leads):
            if not (np.real(value) >= 0.0 and abs(value) <= MAX_LEAD):
                yield f"leads[{k}] must be from 0 to {MAX_LEAD:g} ohm, got {value:g}"
        for name in ("saturation", "step"):
            if not getattr(self, name) >= 0.0:
                yield f"{name} must be 0 or more, got {getattr(self, name):g}"
        if not (self.scale and all(self.channel_scale)):
            yield "scales must not be 0: such channels read nothing but their offset"
        factors = (self.scale, self.offset, self.common_mode)
        if not np.isfinite((*factors, *self.channel_scale, *self.channel_offset)).all():
            yield "scales, offsets and common_mode must be finite"


@lru_cache(maxsize=64)
def _drive_pairs(protocol: Protocol) -> Protocol:
    """Protocol that senses the drive pair of each measurement."""
    rows = tuple((row[0], row[1], row[0], row[1]) for row in protocol.table)
    return Protocol(rows, protocol.n_electrodes)


def _full_values(
    name: str, values: tuple[complex, ...], count: int, missing: complex, counted: str
) -> Complex:
    """Values as an array (count,), filled with `missing` where empty."""
    if values and len(values) != count:
        raise ConfigurationError(
            f"{name} of the meter must have one value for each of {count} {counted}, got "
            f"{len(values)}; this instrument is of another sensor or protocol"
        )
    return np.array(values or (missing,) * count, np.complex128)


def _potentials(
    impedance: NDArray[np.inexact], protocol: Protocol, admittance: Complex, leads: Complex
) -> NDArray[np.inexact]:
    """Potentials of the electrodes per unit current [ohm], then c, (..., measurements, n + 1).

    Args:
        impedance: electrode impedance matrices Z, (..., electrodes, electrodes) [ohm].
        protocol: drive and sense electrodes of each measurement.
        admittance: admittance to ground, of each electrode during each measurement, (measurements,
            electrodes) [S].
        leads: resistance in series with each electrode, (electrodes,) [ohm].
    """
    n = protocol.n_electrodes
    drive, _ = protocol.patterns()
    Z = np.asarray(impedance) + np.diag(_real_where_possible(leads))
    Y = _real_where_possible(admittance)
    total = Y.sum(axis=-1, keepdims=True)
    floating = total == 0.0
    # One row per measurement: weights of the potentials in the definition of ground.
    ground = np.where(floating, 1.0 / n, Y / np.where(floating, 1.0, total))
    kind = np.result_type(Z, Y, np.float64)
    system = np.zeros((*Z.shape[:-2], len(protocol), n + 1, n + 1), kind)
    system[..., :n, :n] = np.eye(n) + Z[..., None, :, :] * Y[:, None, :]
    system[..., :n, n] = -1.0
    system[..., n, :n] = ground
    right = np.zeros((*system.shape[:-1], 1), kind)
    right[..., :n, 0] = np.swapaxes(Z @ drive, -1, -2)
    return np.asarray(np.linalg.solve(system, right)[..., 0])


def _real_where_possible(values: Complex) -> NDArray[np.inexact]:
    return values if values.imag.any() else values.real


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
