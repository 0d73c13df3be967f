"""What a board adds to noise-free frames: the AD5940's signal chain, term by term."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr, ndtri

from eitskin.config import Location
from eitskin.errors import ConfigurationError
from eitskin.protocol import Protocol
from eitskin.simulator.instrument import ad5940
from eitskin.simulator.instrument.drift import RandomWalk
from eitskin.simulator.instrument.session import Session

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

GAIN_LIMIT = 0.0125
PHASE_LIMIT_DEG = 0.3
# Beyond these a number is a slip, such as per cent for a fraction.
RANGES = {
    "floor": (0.0, 1e-3, "V"),
    "drift": (0.0, 0.1, "of the impedance in 4 h"),
    "gel_drift": (0.0, 0.5, "of the impedance in 4 h"),
    "gain": (0.0, GAIN_LIMIT, "of the impedance, which is as far as a gain may be off"),
    "phase_deg": (0.0, PHASE_LIMIT_DEG, "deg, which is as far as a phase may be off"),
    "reciprocity": (0.0, 0.1, "of the impedance"),
    "measurement_time": (0.0, 1.0, "s"),
}
SNR_RANGE_DB = (60.0, 90.0)
MAX_STRAY = 1e-9
CHOICES = {
    "excitation": (0.0, *ad5940.EXCITATIONS),
    "pga_range": (0.0, *ad5940.PGA_RANGES),
    "rtia": ad5940.TRANSIMPEDANCES,
}


@dataclass(frozen=True, slots=True)
class Instrument:
    """A board that measures. Each term is switched off by 0 or False, and draws for itself.

    What a calibration against RCAL takes out is not here: the terms are what is left after it.
    In TOML, `board = "ad5940"` sets every term to what `ad5940` says, but for those named beside.

    Attributes:
        snr_db: how far white noise, per quadrature, lies below full scale [dB], 60 to 90.
            Published EIT boards have 63 to 80.
        floor: white noise of the front end, per quadrature of the voltage [V]; 1.9 uV by the data
            sheet. Through the current of the excitation it becomes ohms.
        drift: sd of the relative drift of the electronics after 4 h, a random walk from the
            session's start that all measurements share, since one front end makes them; 0.2 % is
            published.
        gel_drift: the same of the gel, which dries or warms as a whole. It is the sensor's, and
            no board's default.
        gain: sd of the relative gain error of a session, cut off at 1.25 % (data sheet).
        phase_deg: sd of the phase error of a session [deg], cut off at 0.3 (data sheet).
        reciprocity: sd of the relative difference of two measurements that reciprocity makes
            equal, published as 0.4 %. Its cause is that each path through the multiplexers has an
            error of its own, which RCAL does not lie behind; so each measurement has, for a
            session, a relative error of this over sqrt 2. A protocol that senses where it drives
            has no two such measurements, but the same paths.
        quantisation: the transforms of voltage and current are rounded to 18 bits.
        clipping: sines are cut off before the transform, the current at 3 mA, both at the range
            of the ADC; the status is CLIPPED.
        excitation: amplitude [V], 0.607, 0.121, 0.075 or 0.015; with 0 the largest of them that
            the measurement does not clip.
        pga_range: of the ADC [V], 0.9, 0.6, 0.3 or 0.133; with 0 the smallest that takes the sine.
        rtia: resistor that turns the current into a voltage [ohm], one of the chip's. With 200
            the full 3 mA are 0.6 V; a sensor of more ohms, whose currents are smaller, may use
            more of the range with a larger one.
        stray_capacitance: from and to [F]; each drive pair draws its own, uniform, per session.
            40 to 100 pF are left by cables and multiplexers (data sheet, estimate).
        measurement_time: from one measurement of a frame to the next [s]; 10.6 ms computed.
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

    def __post_init__(self) -> None:
        """Check the numbers, and say everything that is wrong with them."""
        problems = list(self._problems())
        if problems:
            raise ConfigurationError("no such instrument: " + "; ".join(problems))

    @classmethod
    def ad5940(cls) -> "Instrument":
        """Every term of the AD5940's chain, at the values that the attributes name."""
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
    def named(cls, name: str) -> "Instrument":
        """The board of this name, "ad5940"."""
        if name != "ad5940":
            raise ConfigurationError(f"expected an instrument's name, 'ad5940', got {name!r}")
        return cls.ad5940()

    @classmethod
    def expanded(cls, data: Mapping[str, Any], location: Location) -> Mapping[str, Any]:
        """`data` with the terms of the board that it names."""
        if "board" not in data:
            return data
        try:
            board = cls.named(data["board"])
        except ConfigurationError as error:
            raise location.under("board").error(error) from error
        terms = {name: getattr(board, name) for name in cls.__slots__}
        return terms | {name: value for name, value in data.items() if name != "board"}

    def deviation(self, full_scale: float) -> float:
        """Of the white noise per quadrature [ohm] for a full scale [ohm]."""
        return float(full_scale * 10.0 ** (-self.snr_db / 20.0)) if self.snr_db else 0.0

    def offsets(self, protocol: Protocol) -> Array:
        """When each measurement is taken after its frame's start [s], (measurements,)."""
        return self.measurement_time * np.arange(len(protocol), dtype=np.float64)

    def session(self, protocol: Protocol, full_scale: float, rng: np.random.Generator) -> Session:
        """One session of one board, from one calibration to the next.

        Args:
            protocol: what is measured.
            full_scale: largest resistance of the flat, untouched sensor [ohm].
            rng: decides over what stays the same for the session, and over its drift.

        Raises:
            ConfigurationError: where a term depends on the impedance of a drive pair that no
                measurement of the protocol shows.
        """
        # One stream per term, in a fixed order: none changes what another draws.
        gain, phase, paths, stray, electronics, gel = rng.spawn(6)
        low, high = self.stray_capacitance
        driven = np.arange(len(protocol))
        if high or self.floor or self.quantisation or self.clipping:
            driven = _driven(protocol)
        error = 1.0 + _cut_normal(gain, self.gain, GAIN_LIMIT)
        turn = np.deg2rad(_cut_normal(phase, self.phase_deg, PHASE_LIMIT_DEG))
        mismatch = self.reciprocity / np.sqrt(2.0) * paths.standard_normal(len(protocol))
        return Session(
            driven=driven,
            capacitance=stray.uniform(low, high, len(protocol))[driven],
            factor=error * np.exp(1j * turn) * (1.0 + mismatch),
            drift=RandomWalk(self.drift, int(electronics.integers(2**63))),
            gel_drift=RandomWalk(self.gel_drift, int(gel.integers(2**63))),
            deviation=self.deviation(full_scale),
            front_end=ad5940.FrontEnd(
                self.floor,
                self.quantisation,
                self.clipping,
                self.excitation,
                self.pga_range,
                self.rtia,
            ),
        )

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
                known = ", ".join(f"{choice:g}" for choice in choices)
                yield f"{name} must be one of {known}, got {value:g}"
        low, high = self.stray_capacitance
        if not 0.0 <= low <= high <= MAX_STRAY:
            yield (
                f"stray_capacitance must go from 0 F or more up to {MAX_STRAY:g} F or less, got "
                f"{low:g} to {high:g}"
            )


def _cut_normal(rng: np.random.Generator, deviation: float, limit: float) -> float:
    """One draw of a normal distribution cut off at -+`limit`."""
    if not deviation:
        return 0.0
    tail = ndtr(-limit / deviation)
    drawn = deviation * ndtri(rng.uniform(tail, 1.0 - tail))
    return float(np.clip(drawn, -limit, limit))


@lru_cache(maxsize=64)
def _driven(protocol: Protocol) -> Integers:
    """For each measurement the one that shows its drive pair's own impedance, (measurements,)."""
    own = {row[:2]: number for number, row in enumerate(protocol.table) if row[:2] == row[2:]}
    found = []
    for each, row in enumerate(protocol.table):
        number = own.get(row[:2], own.get(row[1::-1]))
        if number is None:
            raise ConfigurationError(
                f"measurement {protocol.labels[each]} drives {row[0]}-{row[1]}, whose own "
                "impedance decides over the current, and no measurement of the protocol shows it; "
                "add ones that sense where they drive, or switch off floor, quantisation, "
                "clipping and stray_capacitance"
            )
        found.append(number)
    return np.array(found)
