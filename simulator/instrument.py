"""What the instrument adds to noise-free frames."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eitskin.geometry import ConfigurationError
from eitskin.simulator.protocol import Protocol

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]
Measured = tuple[Complex, NDArray[np.uint8]]
"""Impedances [ohm] and their `Status` bits, both (frames, measurements)."""

MEASUREMENT_TIME = 10.6e-3
"""One pair of 2048-point transforms of the AD5940 at an oversampling ratio of 2 [s]."""


@dataclass(frozen=True, slots=True)
class Instrument:
    """A board that measures; each term is switched off by 0.

    Attributes:
        snr_db: how far white noise, per quadrature, lies below full scale [dB].
    """

    snr_db: float = 75.0

    def __post_init__(self) -> None:
        """Check the number."""
        if not math.isfinite(self.snr_db):
            raise ConfigurationError(f"snr_db must be a finite number of dB, got {self.snr_db}")

    def deviation(self, full_scale: float) -> float:
        """Of the white noise per quadrature [ohm] for a full scale [ohm]."""
        return float(full_scale * 10.0 ** (-self.snr_db / 20.0)) if self.snr_db else 0.0

    def offsets(self, protocol: Protocol) -> Array:
        """When each measurement is taken after its frame's start [s], (measurements,)."""
        return np.zeros(len(protocol))

    def session(self, protocol: Protocol, full_scale: float, rng: np.random.Generator) -> "Session":
        """One session of one board: what stays the same from its start to its end.

        Args:
            protocol: what is measured.
            full_scale: largest resistance of the flat, untouched sensor [ohm].
            rng: decides over the session.
        """
        return Session(self, protocol, self.deviation(full_scale))


@dataclass(frozen=True, slots=True, eq=False)
class Session:
    """An instrument between two starts."""

    instrument: Instrument
    protocol: Protocol
    deviation: float

    def measure(self, impedance: Complex, times: Array, rng: np.random.Generator) -> Measured:
        """What the board says of frames.

        Args:
            impedance: noise-free, (frames, measurements) complex [ohm].
            times: of the frames, since the session began, (frames,) [s].
            rng: of what differs from frame to frame.
        """
        noise = rng.standard_normal((2, *impedance.shape)) * self.deviation
        return impedance + noise[0] + 1j * noise[1], np.zeros(impedance.shape, np.uint8)
