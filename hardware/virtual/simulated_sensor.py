"""Simulated sensor of a virtual board: impedances of scenes, as one instrument reads them."""

import typing
from collections.abc import Callable, Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from eitskin.frame import Frame
from eitskin.protocol import Protocol
from eitskin.simulator.instrument.ad5940 import MEASUREMENT_TIME
from eitskin.simulator.instrument.instrument import Instrument
from eitskin.simulator.instrument.session import Session
from eitskin.simulator.scene.scene import Scene

Measured = tuple[NDArray[np.complex128], NDArray[np.uint8]]
"""Impedances [ohm] and `Status` bits of one frame, (measurements,) each."""
Measure = Callable[[NDArray[np.complex128], int], Measured]
"""Measured values of noise-free impedances, (measurements,) [ohm], in a frame, by its number."""


class SceneSolver(typing.Protocol):
    """A `Simulator`, as far as a virtual board uses it."""

    @property
    def protocol(self) -> Protocol:
        """Stimulation and measurement pattern."""

    @property
    def full_scale(self) -> float:
        """Largest resistance of the flat, untouched sensor [ohm]."""

    def measure(self, scene: Scene) -> Frame:
        """Noise-free frame of `scene`."""

    def measure_all(
        self,
        scenes: Sequence[Scene],
        tolerance: float,
        *,
        instrument: Instrument,
    ) -> NDArray[np.complex128]:
        """Noise-free measurements of scenes on the circuit of an instrument [ohm]."""

    def full_scale_on(self, instrument: Instrument) -> float:
        """Largest transfer impedance of the flat, untouched sensor on an instrument [ohm]."""


class SimulatedSensor:
    """Simulated sensor and instrument in one session; each scene is solved once.

    Attributes:
        protocol: stimulation and measurement pattern.
        solve: noise-free impedances of a scene, (measurements,) [ohm].
    """

    def __init__(
        self,
        simulator: SceneSolver,
        instrument: Instrument | None = None,
        seed: int = 0,
        period: float | None = None,
    ) -> None:
        """Begin the session.

        Args:
            simulator: simulator of the sensor.
            instrument: instrument that measures every frame; noise-free when omitted.
            seed: seed of the session and of every frame's noise, which depends on seed and frame
                number alone.
            period: time from frame to frame [s], for drift; 10.6 ms for each measurement when
                omitted.
        """
        self.protocol = simulator.protocol
        self._seed = seed
        self._period = len(self.protocol) * MEASUREMENT_TIME if period is None else period
        self._session: Session | None = None
        if instrument is not None:
            loaded = instrument.is_loaded
            scale = simulator.full_scale_on(instrument) if loaded else simulator.full_scale
            self._session = instrument.session(self.protocol, scale, self._generator(0))

        def solve(scene: Scene) -> NDArray[np.complex128]:
            if instrument is None or not instrument.is_loaded:
                return simulator.measure(scene).impedance
            solved: NDArray[np.complex128] = simulator.measure_all(
                [scene], 0.0, instrument=instrument
            )[0]
            return solved

        self.solve = lru_cache(maxsize=1024)(solve)

    def measure(self, impedance: NDArray[np.complex128], now: int) -> Measured:
        """Measured impedances [ohm] and status of frame `now`, (measurements,) each.

        Args:
            impedance: noise-free impedances, (measurements,) [ohm].
            now: number of the frame, counted from the session's start.
        """
        if self._session is None:
            return noise_free(impedance, now)
        times = np.array([now * self._period])
        measured, status = self._session.measure(impedance[None], times, self._generator(1, now))
        return measured[0], status[0]

    def _generator(self, *key: int) -> np.random.Generator:
        return np.random.default_rng(np.random.SeedSequence(self._seed, spawn_key=key))


def noise_free(impedance: NDArray[np.complex128], now: int) -> Measured:  # noqa: ARG001
    """Impedances unchanged, (measurements,) [ohm], and a status without any bit."""
    return impedance, np.zeros(len(impedance), np.uint8)
