"""Instrument: error terms of a board, each of which can be switched off."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import ndtr, ndtri

from eitskin.bounds import sample_uniform
from eitskin.config import Location, read_toml, write_toml
from eitskin.errors import ConfigurationError
from eitskin.extras import old_names
from eitskin.geometry.design.dispersion import FREQUENCY
from eitskin.protocol import Protocol
from eitskin.simulator.instrument import ad5940
from eitskin.simulator.instrument.drift import GelCourse, RandomWalk, Session
from eitskin.simulator.instrument.meter import FourTerminalMeter, Quantity

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]
Integers = NDArray[np.int64]

GAIN_LIMIT = 0.0125
PHASE_LIMIT_DEG = 0.3
# Ranges that exclude slips, such as per cent in place of a fraction.
RANGES = {
    "floor": (0.0, 1e-3, "V"),
    "drift": (0.0, 0.1, "of the impedance in 4 h"),
    "gel_drift": (0.0, 0.5, "of the impedance in 4 h"),
    "gain": (0.0, GAIN_LIMIT, "of the impedance, the data sheet's limit of a gain error"),
    "phase_deg": (0.0, PHASE_LIMIT_DEG, "deg, the data sheet's limit of a phase error"),
    "reciprocity": (0.0, 0.1, "of the impedance"),
    "measurement_time": (0.0, 1.0, "s"),
}
SNR_RANGE_DB = (20.0, 120.0)
MAX_STRAY = 1e-9
CHOICES = {
    "excitation": (0.0, *ad5940.EXCITATIONS),
    "pga_range": (0.0, *ad5940.PGA_RANGES),
    "rtia": ad5940.TRANSIMPEDANCES,
}


@old_names(expanded="expand_data", named="from_name")
@dataclass(frozen=True, slots=True)
class Instrument:
    """Error terms of a board; 0 or False switches a term off, and each has its own random stream.

    The terms are the errors that remain after a calibration against the reference resistor RCAL.
    In TOML, `board = "ad5940"` sets every term to its value in `Instrument.ad5940`, and
    `board = "FILE.toml"` to its value in the instrument file, except for terms in the same table.
    "sd" is a standard deviation.

    Attributes:
        snr_db: full scale over the sd of the white noise per quadrature [dB], 20 to 120. Published
            EIT boards have 63 to 80.
        floor: sd of the front end's white noise, per quadrature of the voltage [V]; 1.9 uV by the
            data sheet. Divided by the excitation current, this noise becomes ohms.
        drift: sd of the relative drift of the electronics after 4 h, a random walk shared by all
            measurements; 0.2 % is published.
        gel_drift: sd of the relative drift of the gel after 4 h, as the gel dries or warms.
        gain: sd of the relative gain error of a session, truncated at 1.25 % (data sheet).
        phase_deg: sd of the phase error of a session [deg], truncated at 0.3 (data sheet).
        reciprocity: sd of the relative difference between two reciprocal measurements, published
            as 0.4 %. Each path through the multiplexers has an error of `reciprocity` / sqrt 2.
        quantisation: whether the transforms of voltage and current are rounded to 18 bits.
        clipping: whether sines are clipped, the current at 3 mA, both at the range of the ADC.
        excitation: amplitude, 0.607, 0.121, 0.075 or 0.015 V; 0 for the largest without clipping.
        pga_range: full scale of the ADC, 0.9, 0.6, 0.3 or 0.133 V; 0 for the smallest that holds
            the sine.
        rtia: feedback resistor of the transimpedance amplifier [ohm], one of the chip's.
        stray_capacitance: range of the capacitance of each drive pair, drawn per session [F];
            40 to 100 pF by data sheet and estimate.
        measurement_time: time from one measurement of a frame to the next [s]; 10.6 ms computed.
        gel_warming: range of the temperature that the gel gains in a session [K], which it takes
            with a time constant of half an hour; 2 % of the conductivity a kelvin.
        gel_drying: range of the share of its water that the gel loses in a day.
        meter: circuit and reading of a board that is no ideal four-terminal meter.

    Example:
        >>> from eitskin.simulator import Instrument
        >>> Instrument.ad5940().gain
        0.002
    """

    snr_db: float = 75.0
    floor: float = 0.0
    drift: float = 0.0
    gel_drift: float = 0.0
    gain: float = 0.0
    phase_deg: float = 0.0
    reciprocity: float = 0.0
    quantisation: bool = False
    clipping: bool = False
    excitation: float = 0.0
    pga_range: float = 0.0
    rtia: float = 200.0
    stray_capacitance: tuple[float, float] = (0.0, 0.0)
    measurement_time: float = 0.0
    meter: FourTerminalMeter | None = None
    gel_warming: tuple[float, float] | None = None
    gel_drying: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        """Check the terms; the ConfigurationError lists everything that is wrong."""
        problems = list(self._problems())
        if problems:
            raise ConfigurationError("no such instrument: " + "; ".join(problems))

    @classmethod
    def ad5940(cls) -> "Instrument":
        """Instrument with every term of the AD5940's signal chain, at the values named above."""
        return cls(
            floor=1.9e-6,
            drift=0.002,
            gain=0.002,
            phase_deg=0.1,
            reciprocity=0.004,
            quantisation=True,
            clipping=True,
            stray_capacitance=(40e-12, 100e-12),
            measurement_time=ad5940.MEASUREMENT_TIME,
        )

    @classmethod
    def ideal(cls) -> "Instrument":
        """Instrument without noise or error."""
        return cls(snr_db=0.0)

    @classmethod
    def from_toml(cls, path: str | Path) -> "Instrument":
        """Read an instrument file; raises ConfigurationError where the file does not fit."""
        return read_toml(cls, path)

    def to_toml(self, path: str | Path) -> None:
        """Write an instrument file for `from_toml`, atomically."""
        write_toml(self, path)

    @classmethod
    def from_name(cls, name: str, folder: Path | None = Path()) -> "Instrument":
        """Instrument by its name, "ideal" or "ad5940", or from an instrument file.

        Args:
            name: a name, or the path of a TOML file.
            folder: start of relative paths; None where no file may be named.

        Raises:
            ConfigurationError: for another name, or a file that does not fit.
        """
        makers = {"ideal": cls.ideal, "ad5940": cls.ad5940}
        if name in makers:
            return makers[name]()
        if folder is None or not name.endswith(".toml"):
            raise ConfigurationError(
                "expected an instrument: the path of a TOML file, 'ideal' or 'ad5940', got "
                f"{name!r}"
            )
        return cls.from_toml(folder / name)

    @classmethod
    def expand_data(cls, data: Mapping[str, Any], location: Location) -> Mapping[str, Any]:
        """TOML table `data` with the name under `board` replaced by the terms of that board."""
        if "board" not in data:
            return data
        where = location.child("board")
        try:
            board = cls.from_name(str(data["board"]), location.folder)
        except ConfigurationError as error:
            raise where.error(error) from error
        terms = {name: getattr(board, name) for name in cls.__slots__}
        return terms | {name: value for name, value in data.items() if name != "board"}

    @property
    def reads(self) -> Quantity:
        """Kind of the readings: "complex", "signed" or "magnitude"."""
        return "complex" if self.meter is None else self.meter.reads

    @property
    def needs_drive(self) -> bool:
        """Whether readings depend on the current, and so on the impedance of the drive pair."""
        _, stray = self.stray_capacitance
        return bool(stray or self.floor or self.quantisation or self.clipping)

    def terminal_impedances(self, impedance: NDArray[np.inexact], protocol: Protocol) -> Complex:
        """Transfer and drive-pair impedances on this board's circuit [ohm], for `Session.measure`.

        The shape is (..., 2, measurements). Arguments and errors are those of `transfer_impedance`.
        """
        meter = self.meter or FourTerminalMeter()
        return meter.terminal_impedances(impedance, protocol)

    def transfer_impedance(self, impedance: NDArray[np.inexact], protocol: Protocol) -> Complex:
        """Transfer impedances on this board's circuit [ohm], (..., measurements).

        Args:
            impedance: electrode impedance matrices, (..., electrodes, electrodes) [ohm].
            protocol: drive and sense pairs.

        Raises:
            ConfigurationError: for a meter or matrices of another number of electrodes.
        """
        meter = self.meter or FourTerminalMeter()
        return meter.transfer_impedance(impedance, protocol)

    def deviation(self, full_scale: float) -> float:
        """Standard deviation of the white noise per quadrature [ohm] for a full scale [ohm]."""
        return float(full_scale * 10.0 ** (-self.snr_db / 20.0)) if self.snr_db else 0.0

    def offsets(self, protocol: Protocol) -> Array:
        """Time of each measurement since its frame's start [s], (measurements,)."""
        return self.measurement_time * np.arange(len(protocol), dtype=np.float64)

    def session(
        self,
        protocol: Protocol,
        full_scale: float,
        rng: np.random.Generator,
        frequency: float = FREQUENCY,
    ) -> Session:
        """Session of one board, from one calibration to the next.

        Args:
            protocol: drive and sense pairs.
            full_scale: largest transfer impedance of the flat, untouched sensor [ohm].
            rng: random generator of the session's constant errors, and of the drifts' seeds.
            frequency: frequency of the excitation [Hz], on which the effect of stray capacitances
                depends.

        Raises:
            ConfigurationError: for a meter of another protocol.
        """
        if self.meter is not None:
            self.meter.require_fit(protocol)
        # One random stream per term, in a fixed order: no term changes the draws of another.
        gain, phase, paths, stray, electronics, gel = rng.spawn(6)
        low, high = self.stray_capacitance
        relative = frequency / FREQUENCY
        pairs, sensed = _drive_measurements(protocol)
        error = 1.0 + _truncated_normal(gain, self.gain, GAIN_LIMIT)
        turn = np.deg2rad(_truncated_normal(phase, self.phase_deg, PHASE_LIMIT_DEG))
        mismatch = self.reciprocity / np.sqrt(2.0) * paths.standard_normal(len(protocol))
        return Session(
            pairs=pairs,
            unsensed=None if sensed.all() or not self.needs_drive else int(sensed.argmin()),
            capacitance=sample_uniform(stray, (low, high), len(protocol))[pairs] * relative,
            factor=error * np.exp(1j * turn) * (1.0 + mismatch),
            drift=RandomWalk(self.drift, int(electronics.integers(2**63))),
            gel=self._gel_course(gel),
            deviation=self.deviation(full_scale),
            front_end=ad5940.FrontEnd(
                self.floor,
                self.quantisation,
                self.clipping,
                self.excitation,
                self.pga_range,
                self.rtia,
            ),
            meter=self.meter,
        )

    def _gel_course(self, rng: np.random.Generator) -> GelCourse | None:
        """Change of the gel in a session; None without any."""
        walk, still = RandomWalk(self.gel_drift, int(rng.integers(2**63))), (0.0, 0.0)
        warming, drying = (
            float(sample_uniform(rng, limits or still))
            for limits in (self.gel_warming, self.gel_drying)
        )
        return GelCourse(walk, warming, drying) if self.gel_drift or warming or drying else None

    def _problems(self) -> Iterator[str]:
        low, high = SNR_RANGE_DB
        if self.snr_db != 0.0 and not low <= self.snr_db <= high:
            yield f"snr_db must be from {low:g} to {high:g} dB, or 0 for none, got {self.snr_db:g}"
        for name, (low, high, unit) in RANGES.items():
            value = getattr(self, name)
            if not low <= value <= high:
                yield f"{name} must be from {low:g} to {high:g} {unit}, got {value:g}"
        for name, choices in CHOICES.items():
            value = getattr(self, name)
            if value not in choices:
                choice_text = ", ".join(f"{choice:g}" for choice in choices)
                yield f"{name} must be one of {choice_text}, got {value:g}"
        for name, least, most, unit in (
            ("gel_warming", -30.0, 30.0, "K"),
            ("gel_drying", 0.0, 0.9, "of the water in a day"),
        ):
            low, high = getattr(self, name) or (0.0, 0.0)
            if not least <= low <= high <= most:
                yield f"{name} must rise from {least:g} to {most:g} {unit}, got {low:g} to {high:g}"
        low, high = self.stray_capacitance
        if not 0.0 <= low <= high <= MAX_STRAY:
            yield (
                f"stray_capacitance must go from 0 F or more up to {MAX_STRAY:g} F or less, got "
                f"{low:g} to {high:g}"
            )


def _truncated_normal(rng: np.random.Generator, deviation: float, limit: float) -> float:
    """One draw of a normal distribution truncated at -+`limit`, by inversion."""
    if not deviation:
        return 0.0
    tail = ndtr(-limit / deviation)
    drawn = deviation * ndtri(rng.uniform(tail, 1.0 - tail))
    return float(np.clip(drawn, -limit, limit))


@lru_cache(maxsize=64)
def _drive_measurements(protocol: Protocol) -> tuple[Integers, NDArray[np.bool_]]:
    """Number of one measurement of each measurement's drive pair, and whether it senses that pair.

    Both are (measurements,); where no measurement senses a drive pair, the first that drives it is
    reported.
    """
    driven = [frozenset(row[:2]) for row in protocol.table]
    first = {pair: number for number, pair in reversed(list(enumerate(driven)))}
    own = {row[:2]: number for number, row in enumerate(protocol.table) if row[:2] == row[2:]}
    numbers = [own.get(row[:2], own.get(row[1::-1])) for row in protocol.table]
    pairs = [first[pair] if at is None else at for pair, at in zip(driven, numbers, strict=True)]
    return np.array(pairs), np.array([at is not None for at in numbers])


def snr_db(frames: ArrayLike) -> float:
    """Full scale over the white noise of flat frames [dB], as `Instrument.snr_db`.

    Args:
        frames: readings of the flat, untouched sensor, (frames, measurements).
    """
    values = np.asarray(frames, np.complex128)
    return decibels(float(np.abs(values.mean(axis=0)).max()), white_noise(values))


def decibels(full_scale: float, noise: float) -> float:
    """Full scale over noise [dB], within the range of `Instrument.snr_db`; 0 without noise."""
    return float(np.clip(20.0 * np.log10(full_scale / noise), *SNR_RANGE_DB)) if noise else 0.0


def white_noise(frames: NDArray[np.inexact]) -> float:
    """Standard deviation of one quadrature of one reading; 0 for fewer than three frames.

    It is that of differences between successive frames (frames, measurements), which slow drifts
    leave alone.
    """
    steps = np.diff(frames, axis=0)
    quadratures = 2.0 if np.imag(frames).any() else 1.0
    square = float(np.mean(np.abs(steps) ** 2)) if len(steps) > 1 else 0.0
    return float(np.sqrt(square / (2.0 * quadratures)))
