"""Scenes, faults and simulated measurements of a virtual board, changed while it runs."""

import math
import threading
import typing
from collections import OrderedDict, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from eitskin.bounds import require_seed
from eitskin.config import read_toml, toml_table
from eitskin.errors import ConfigurationError
from eitskin.extras import old_names
from eitskin.files import read_text
from eitskin.hardware.virtual.fault import Fault, Hook
from eitskin.hardware.virtual.fault_table import read_faults
from eitskin.protocol import Protocol
from eitskin.simulator.instrument.ad5940 import MEASUREMENT_TIME
from eitskin.simulator.instrument.instrument import Instrument
from eitskin.simulator.mechanics.touch_history import held_touches, recall_touches
from eitskin.simulator.mechanics.viscoelasticity import REFERENCE
from eitskin.simulator.scene.scene import Scene

SceneSource = Callable[[int], Scene]
"""Function from frame number to scene."""

MEMORY = 1000.0
"""Time after which a touch that was held for ever has less than a thousandth of its force [s]."""


@dataclass(frozen=True, slots=True)
class Step:
    """Scene that lasts for a number of frames; the flat, untouched sensor when omitted.

    Example:
        >>> from eitskin import Bend, Scene
        >>> from eitskin.hardware import Step
        >>> Step(Scene(bend=Bend(20.0)), frames=8).frames
        8
    """

    scene: Scene = field(default_factory=Scene)
    frames: int = 1

    def __post_init__(self) -> None:
        if self.frames < 1:
            raise ConfigurationError(f"a step lasts for at least one frame, got {self.frames}")


@dataclass(frozen=True, slots=True)
class Script:
    """Sequence of scenes; a function from frame number to scene.

    Attributes:
        steps: steps in the order in which they are played.
        repeat: begin again after the last step; else the last one stays.
        relaxing: time from frame to frame [s], where touches creep while they last and later ones
            on their place remember them; each frame is then solved when it is due. None for
            touches that are always new.

    Example:
        >>> from eitskin import Bend, Scene
        >>> from eitskin.hardware import Script, Step
        >>> len(Script((Step(Scene(), 8), Step(Scene(bend=Bend(20.0)), 8))).steps)
        2
    """

    steps: tuple[Step, ...]
    repeat: bool = True
    relaxing: float | None = None

    def __post_init__(self) -> None:
        """Require at least one step, and a positive time; raises ConfigurationError otherwise."""
        if not self.steps:
            raise ConfigurationError("a script needs at least one step, got none")
        if self.relaxing is not None and not 0.0 < self.relaxing < math.inf:
            raise ConfigurationError(
                f"relaxing must be a positive time from frame to frame, in s, got {self.relaxing}"
            )

    @classmethod
    def from_toml(cls, path: str | Path) -> "Script":
        """Script of a TOML file: [[steps]] with frames and a scene, or one scene that stays."""
        path = Path(path)
        if path.is_file() and "steps" in _top_keys(path):
            return read_toml(cls, path)
        return cls((Step(Scene.from_toml(path)),))

    def __call__(self, number: int) -> Scene:
        """Scene of frame `number`."""
        total = sum(step.frames for step in self.steps)
        frame = number % total if self.repeat else min(number, total - 1)
        for present in self.steps:
            if frame < present.frames:
                break
            frame -= present.frames
        if self.relaxing is None:
            return present.scene
        last = number // total if self.repeat else 0
        first = min(last, max(0, number - int(MEMORY / self.relaxing)) // total)
        played, start = [], first * total
        for step in self.steps * (last + 1 - first):
            if start <= number:
                played.append((start * self.relaxing, step.scene.touches))
            start += step.frames
        past, now = held_touches(played), number * self.relaxing
        return replace(present.scene, touches=recall_touches(past, now, REFERENCE))


def _top_keys(path: Path) -> set[str]:
    """Keys at the top of a TOML file; none for other files, an error when they are read."""
    try:
        return set(toml_table(read_text(path), str(path)))
    except ConfigurationError:
        return set()


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
            seed: seed of session and noise, which depends on it and the frame's number alone.
            period: time from frame to frame [s], for drift; 10.6 ms per measurement when omitted.
        """
        self.protocol = simulator.protocol
        self.solve = lru_cache(maxsize=1024)(simulator.impedance_matrix)
        require_seed(seed)
        self._seed = seed
        self._period = len(self.protocol) * MEASUREMENT_TIME if period is None else period
        self._instrument = instrument or Instrument.ideal()
        flat = self._instrument.transfer_impedance(self.solve(Scene()), self.protocol)
        full_scale = float(np.abs(flat).max())
        self._session = self._instrument.session(self.protocol, full_scale, self._generator(0))
        # A scene that stays is one matrix, whose measurements need not be computed again.
        self._last: tuple[NDArray[np.inexact], Complex] | None = None

    def measure(self, impedance: NDArray[np.inexact], now: int) -> Measured:
        """Measured impedances [ohm] and status of frame `now`, (measurements,) each.

        Args:
            impedance: impedance matrix of the sensor, (electrodes, electrodes) [ohm].
            now: number of the frame, counted from the session's start.
        """
        if self._last is None or self._last[0] is not impedance:
            impedances = self._instrument.terminal_impedances(impedance, self.protocol)
            self._last = (impedance, impedances)
        times = np.array([now * self._period])
        terminals = self._last[1][None]
        measured, status = self._session.measure(terminals, times, self._generator(1, now))
        return measured[0], status[0]

    def _generator(self, *key: int) -> np.random.Generator:
        return np.random.default_rng(np.random.SeedSequence(self._seed, spawn_key=key))


MAX_REMEMBERED = 4096
"""Number of newest frames whose scene is remembered."""

Matrix = NDArray[np.inexact]
"""Impedance matrix of the sensor, (electrodes, electrodes) [ohm]."""
Solve = Callable[[Scene], Matrix]
Solved = tuple[Scene, Matrix]


@old_names(measured="impedance_at_frame")
class Stage:
    """Scene and faults of a virtual board; may be changed from any thread.

    A new scene is solved, and refused, in the thread that sets it: the board keeps its pace.

    Attributes:
        frames: number of frames measured since the board was made.
        requests: number of requests answered since then.
        changed: called after every change of the faults.

    Example:
        >>> from eitskin import Bend, Scene
        >>> from eitskin.hardware import open_virtual
        >>> with open_virtual(speed="max", resolution="coarse") as board:
        ...     board.stage.set(Scene(bend=Bend(20.0)))
    """

    def __init__(
        self, solve: Solve, scenes: SceneSource | None = None, faults: Sequence[Fault] = ()
    ) -> None:
        """Begin with a script and faults.

        Args:
            solve: impedance matrix of a scene, (electrodes, electrodes) [ohm].
            scenes: a `Script`, or any function from frame number to scene; flat and untouched when
                omitted. The scenes of a script are solved now.
            faults: faults from the first frame on.
        """
        self.frames = self.requests = 0
        self.changed: Callable[[], None] = lambda: None
        self._solve, self._solving = solve, threading.Lock()
        self._faults = tuple(faults)
        self._injected: deque[Fault] = deque()
        self._cleared = False
        self._truth: OrderedDict[int, Scene] = OrderedDict()
        self._newest = Scene()
        self.play(scenes or Script((Step(Scene()),)))

    @property
    def scene(self) -> Scene:
        """Scene of the newest frame; of the first frame before that was measured."""
        return self._newest if self.frames else self._source(0)[0]

    def set(self, scene: Scene) -> None:
        """Set the scene from the next frame on; raises ConfigurationError for an impossible one."""
        self.play(Script((Step(scene),)))

    def play(self, scenes: SceneSource) -> None:
        """Play scenes from the next frame on; raises ConfigurationError for an impossible one.

        The scenes of a `Script` are solved now. Those of any other function are solved when their
        frames are due, which may delay them.
        """
        # Solved here, so that the board's own thread never waits for a solution.
        fixed = isinstance(scenes, Script) and scenes.relaxing is None
        steps = scenes.steps if isinstance(scenes, Script) and fixed else ()
        solutions = {step.scene: self._solve_locked(step.scene) for step in steps}
        first = self.frames

        def solve_frame(now: int) -> Solved:
            scene = scenes(now - first)
            return scene, solutions[scene] if scene in solutions else self._solve_locked(scene)

        self._source = solve_frame

    def impedance_at_frame(self, now: int) -> Matrix:
        """Impedance matrix of frame `now`, counted since the board was made, (n, n) [ohm]."""
        self._newest, impedance = self._source(now)
        return impedance

    def record_truth(self, number: int) -> None:
        """Remember the newest scene as the truth of the frame with this number."""
        self._truth[number] = self._newest
        self._truth.move_to_end(number)
        if len(self._truth) > MAX_REMEMBERED:
            self._truth.popitem(last=False)

    def truth(self, number: int) -> Scene | None:
        """Scene that frame `number` was measured of; None for one no longer remembered."""
        return self._truth.get(number)

    @property
    def active(self) -> tuple[Fault, ...]:
        """Faults for the next frame, for the board's own thread alone.

        Injected faults begin now: only that thread knows the next frame. Faults that are over go.
        """
        if self._cleared:
            self._cleared, self._faults = False, ()
        while self._injected:
            fault = self._injected.popleft()
            fault.frame = self.requests if Hook.REPLY in fault.kind.effects else self.frames
            self._faults += (fault,)
        if any(fault.is_over(self.frames) for fault in self._faults):
            self._faults = tuple(f for f in self._faults if not f.is_over(self.frames))
        return self._faults

    @property
    def faults(self) -> tuple[str, ...]:
        """Faults that act or are yet to act, as "name:index"."""
        begun = () if self._cleared else self._faults
        return tuple(map(str, (*begun, *self._injected)))

    def inject(self, faults: str | Sequence[Fault]) -> None:
        """Inject faults, "name:index,...", from the next frame on; raises ConfigurationError."""
        self._injected.extend(read_faults(faults) if isinstance(faults, str) else faults)
        self.changed()

    def clear(self) -> None:
        """Remove all faults."""
        self._injected.clear()
        self._cleared = True
        self.changed()

    def _solve_locked(self, scene: Scene) -> Matrix:
        with self._solving:
            return self._solve(scene)
