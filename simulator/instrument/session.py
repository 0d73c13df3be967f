"""Measurement session of one board, from one calibration to the next."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eitskin.errors import ConfigurationError, FrameError
from eitskin.frame import Status
from eitskin.simulator.instrument import ad5940
from eitskin.simulator.instrument.drift import RandomWalk
from eitskin.simulator.instrument.meter import FourTerminalMeter

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

LONGEST_SESSION = 365 * 86400.0
"""Longest duration of a session [s]."""


@dataclass(frozen=True, slots=True, eq=False)
class Session:
    """Errors of an `Instrument` that are constant in a session; `measure` adds noise and drift.

    Attributes:
        pairs: number of one measurement of each measurement's drive pair, the one that senses it
            where there is one, (measurements,).
        unsensed: number of a measurement whose drive pair decides over its reading and is sensed by
            none; None where there is no such one.
        capacitance: stray, across the drive pairs, (measurements,) [F].
        factor: gain, phase and path errors together, (measurements,) complex.
        drift: of the electronics, as the logarithm of a factor.
        gel_drift: of the gel, as the logarithm of a factor.
        deviation: standard deviation of the white noise per quadrature [ohm].
        front_end: signal chain from excitation to ADC.
        meter: scale, offset, limits and codes of the readings; None for an ideal meter.
    """

    pairs: NDArray[np.int64]
    unsensed: int | None
    capacitance: Array
    factor: Complex
    drift: RandomWalk
    gel_drift: RandomWalk
    deviation: float
    front_end: ad5940.FrontEnd
    meter: FourTerminalMeter | None = None

    def measure(
        self, impedance: Complex, times: Array, rng: np.random.Generator
    ) -> tuple[Complex, NDArray[np.uint8]]:
        """Measured impedances [ohm] and `Status` bits, both (frames, measurements).

        Frames of one session may be measured together or one by one, in any order: the drift
        depends on the times alone.

        Args:
            impedance: noise-free, on the circuit of the instrument, transfer and drive-pair
                impedances of `Instrument.terminal_impedances`, (frames, 2, measurements) complex
                [ohm]; or the former alone, (frames, measurements), where the protocol senses its
                drive pairs or no term depends on them.
            times: of the frames since the session's start, (frames,) [s].
            rng: random generator of the noise.

        Raises:
            FrameError: where the shapes do not fit, or an impedance is not finite.
            ConfigurationError: for a time before the session, or a year after its start, or where
                a term depends on the impedance of a drive pair that is not given.
        """
        both, times = self._checked(impedance, times)
        white, floor = rng.spawn(2)
        if self.gel_drift.deviation:
            both = both * np.exp(self.gel_drift(times))[:, None, None]
        if self.capacitance.any():
            both = ad5940.with_stray_capacitance(both, both[:, 1:], self.capacitance)
        Z, driven = both[:, 0] * self.factor, both[:, 1]
        if self.drift.deviation:
            Z = Z * np.exp(self.drift(times))[:, None]
        if self.deviation:
            noise = self.deviation * white.standard_normal((2, *Z.shape))
            Z = Z + noise[0] + 1j * noise[1]
        sensed, status = self.front_end.convert(Z, driven, floor)
        if self.meter is None:
            return sensed, status
        read, beyond = self.meter.reading(sensed)
        status[beyond] |= np.uint8(Status.CLIPPED)
        return read, status

    def _with_drive(self, transfer: Complex) -> Complex:
        """Transfer impedances (frames, m), and those among them that are of their drive pairs."""
        if self.unsensed is not None:
            raise ConfigurationError(
                f"measurement {self.unsensed} is read by a current over which its drive pair "
                "decides, and no measurement of the protocol senses that pair; give transfer and "
                "drive-pair impedances, as Instrument.terminal_impedances does"
            )
        return np.stack([transfer, transfer[:, self.pairs]], axis=1)

    def _checked(self, impedance: Complex, times: Array) -> tuple[Complex, Array]:
        Z, times = np.asarray(impedance, np.complex128), np.asarray(times, np.float64)
        frames, m = times.shape, len(self.pairs)
        if Z.shape not in ((*frames, m), (*frames, 2, m)) or times.ndim != 1:
            raise FrameError(
                f"expected impedances of shape (frames, {m}) or (frames, 2, {m}) and a time for "
                f"each frame, got {Z.shape} and {times.shape}"
            )
        if Z.ndim == 2:
            Z = self._with_drive(Z)
        if not np.isfinite(Z).all():
            raise FrameError(
                "expected finite impedances, got NaN or infinity; leave these frames out"
            )
        if not ((times >= 0.0) & (times <= LONGEST_SESSION)).all():
            raise ConfigurationError(
                f"expected times from 0 to {LONGEST_SESSION:g} s after the session's start, got "
                f"{times.min():g} to {times.max():g} s; start another session"
            )
        return Z, times
