"""Simulated sensor of a virtual board: impedances of scenes, as one instrument reads them."""

import typing
from collections.abc import Callable
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
"""What a board reads of noise-free impedances (measurements,) [ohm] in a frame, by its number."""


class SceneSolver(typing.Protocol):
    """What is used of a `Simulator`."""

    @property
    def protocol(self) -> Protocol:
        """What it measures."""

    @property
    def full_scale(self) -> float:
        """Largest resistance of the flat, untouched sensor [ohm]."""

    def measure(self, scene: Scene) -> Frame:
        """The noise-free frame of `scene`."""


class SimulatedSensor:
    """What a virtual board measures, in one session; each scene is computed once.

    Attributes:
        protocol: what is measured.
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
            simulator: of the sensor.
            instrument: that measures every frame; none where the sensor itself is asked for.
            seed: of the session and of what differs from frame to frame; frame and seed decide
                over that, whatever was measured before.
            period: from frame to frame [s], for what drifts; 10.6 ms for each measurement when
                omitted.
        """
        self.protocol = simulator.protocol
        self._seed = seed
        self._period = len(self.protocol) * MEASUREMENT_TIME if period is None else period
        self._session: Session | None = None
        if instrument is not None:
            start = self._generator(0)
            self._session = instrument.session(self.protocol, simulator.full_scale, start)
        self.solve = lru_cache(maxsize=1024)(lambda scene: simulator.measure(scene).impedance)

    def measure(self, impedance: NDArray[np.complex128], now: int) -> Measured:
        """What the board reads in frame `now`: impedances [ohm] and status, (measurements,) each.

        Args:
            impedance: noise-free, (measurements,) [ohm].
            now: the frame, counted from the session's start.
        """
        if self._session is None:
            return noise_free(impedance, now)
        times = np.array([now * self._period])
        measured, status = self._session.measure(impedance[None], times, self._generator(1, now))
        return measured[0], status[0]

    def _generator(self, *key: int) -> np.random.Generator:
        return np.random.default_rng(np.random.SeedSequence(self._seed, spawn_key=key))


def noise_free(impedance: NDArray[np.complex128], now: int) -> Measured:  # noqa: ARG001
    """The impedances as they are, all good."""
    return impedance, np.zeros(len(impedance), np.uint8)
