"""Simulated sensor of a virtual board: impedances of scenes, as one instrument reads them."""

import typing
from collections.abc import Callable
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from eitskin.protocol import Protocol
from eitskin.simulator.instrument.ad5940 import MEASUREMENT_TIME
from eitskin.simulator.instrument.instrument import Instrument
from eitskin.simulator.scene.scene import Scene

Complex = NDArray[np.complex128]
Measured = tuple[Complex, NDArray[np.uint8]]
"""Impedances [ohm] and `Status` bits of one frame, (measurements,) each."""
Measure = Callable[[NDArray[np.inexact], int], Measured]
"""Measured values of an impedance matrix, (electrodes, electrodes) [ohm], in a frame by number."""


class SceneSolver(typing.Protocol):
    """A `Simulator`, as far as a virtual board uses it."""

    @property
    def protocol(self) -> Protocol:
        """Stimulation and measurement pattern."""

    def impedance_matrix(self, scene: Scene) -> NDArray[np.inexact]:
        """Impedance matrix of the sensor in a scene [ohm], (electrodes, electrodes)."""


class SimulatedSensor:
    """Simulated sensor and instrument in one session; each scene is solved once.

    Attributes:
        protocol: stimulation and measurement pattern.
        solve: impedance matrix of a scene, (electrodes, electrodes) [ohm].
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
        self.solve = lru_cache(maxsize=1024)(simulator.impedance_matrix)
        self._seed = seed
        self._period = len(self.protocol) * MEASUREMENT_TIME if period is None else period
        self._instrument = instrument or Instrument.ideal()
        flat = self._instrument.transfer_impedance(self.solve(Scene()), self.protocol)
        full_scale = float(np.abs(flat).max())
        self._session = self._instrument.session(self.protocol, full_scale, self._generator(0))
        # A scene that stays is one matrix, whose measurements need not be computed anew.
        self._last: tuple[NDArray[np.inexact], Complex] | None = None

    def measure(self, impedance: NDArray[np.inexact], now: int) -> Measured:
        """Measured impedances [ohm] and status of frame `now`, (measurements,) each.

        Args:
            impedance: impedance matrix of the sensor, (electrodes, electrodes) [ohm].
            now: number of the frame, counted from the session's start.
        """
        if self._last is None or self._last[0] is not impedance:
            both = self._instrument.terminal_impedances(impedance, self.protocol)
            self._last = (impedance, both)
        times = np.array([now * self._period])
        terminals = self._last[1][None]
        measured, status = self._session.measure(terminals, times, self._generator(1, now))
        return measured[0], status[0]

    def _generator(self, *key: int) -> np.random.Generator:
        return np.random.default_rng(np.random.SeedSequence(self._seed, spawn_key=key))
