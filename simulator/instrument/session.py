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
        driven: number of the measurement of each measurement's drive pair, (measurements,).
        capacitance: stray, across the drive pairs, (measurements,) [F].
        factor: gain, phase and path errors together, (measurements,) complex.
        drift: of the electronics, as the logarithm of a factor.
        gel_drift: of the gel, as the logarithm of a factor.
        deviation: standard deviation of the white noise per quadrature [ohm].
        front_end: signal chain from excitation to ADC.
        meter: scale, offset, limits and codes of the readings; None for an ideal meter.
    """

    driven: NDArray[np.int64]
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
            impedance: noise-free, on the circuit of the instrument, (frames, measurements) complex
                [ohm].
            times: of the frames since the session's start, (frames,) [s].
            rng: random generator of the noise.

        Raises:
            FrameError: where the shapes do not fit, or an impedance is not finite.
            ConfigurationError: for a time before the session, or a year after its start.
        """
        Z, times = self._checked(impedance, times)
        white, floor = rng.spawn(2)
        if self.gel_drift.deviation:
            Z = Z * np.exp(self.gel_drift(times))[:, None]
        if self.capacitance.any():
            Z = ad5940.with_stray_capacitance(Z, Z[:, self.driven], self.capacitance)
        driven = Z[:, self.driven]
        Z = Z * self.factor
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

    def _checked(self, impedance: Complex, times: Array) -> tuple[Complex, Array]:
        Z, times = np.asarray(impedance, np.complex128), np.asarray(times, np.float64)
        if Z.shape != (*times.shape, len(self.driven)) or times.ndim != 1:
            raise FrameError(
                f"expected impedances of shape (frames, {len(self.driven)}) and a time for each "
                f"frame, got {Z.shape} and {times.shape}"
            )
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
