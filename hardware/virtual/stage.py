"""Scene and faults of a virtual board, changed while it runs."""

import threading
from collections import OrderedDict, deque
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from eitskin.hardware.virtual.fault import Fault, Hook
from eitskin.hardware.virtual.fault_table import read_faults
from eitskin.hardware.virtual.scene_script import SceneSource, Script, Step
from eitskin.simulator.scene.scene import Scene

REMEMBERED = 4096
"""Number of newest frames whose scene is remembered."""

Matrix = NDArray[np.inexact]
"""Impedance matrix of the sensor, (electrodes, electrodes) [ohm]."""
Solve = Callable[[Scene], Matrix]
Solved = tuple[Scene, Matrix]


class Stage:
    """Scene and faults of a virtual board; may be changed from any thread.

    A new scene is solved in the thread that sets it, so that an impossible one is refused there and
    the board keeps its pace.

    Attributes:
        frames: number of frames measured since the board was made.
        requests: number of requests answered since then.
        changed: called after every change of the faults.
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
        self._source: Callable[[int], Solved] = self._lazily(lambda _: Scene())
        self.play(scenes or Script((Step(Scene()),)))

    @property
    def scene(self) -> Scene:
        """Scene of the newest frame; of the first frame before that was measured."""
        return self._newest if self.frames else self._source(0)[0]

    def set(self, scene: Scene) -> None:
        """Set the scene from the next frame on; raises ConfigurationError for an impossible one."""
        solved = scene, self._solved(scene)
        self._source = lambda _: solved

    def play(self, scenes: SceneSource) -> None:
        """Play scenes from the next frame on; raises ConfigurationError for an impossible one.

        The scenes of a `Script` are solved now. Those of any other function are solved when their
        frames are due, which may delay them.
        """
        first = self.frames
        if not isinstance(scenes, Script):
            self._source = self._lazily(lambda now: scenes(now - first))
            return
        # Solved here, so that the board's own thread never waits for a solution.
        known = {step.scene: self._solved(step.scene) for step in scenes.steps}

        def told(now: int) -> Solved:
            scene = scenes(now - first)
            return scene, known[scene]

        first = self.frames
        self._source = told

    def measured(self, now: int) -> Matrix:
        """Impedance matrix of frame `now`, counted since the board was made, (n, n) [ohm]."""
        self._newest, impedance = self._source(now)
        return impedance

    def record_truth(self, number: int) -> None:
        """Remember the newest scene as the truth of the frame with this number."""
        self._truth[number] = self._newest
        self._truth.move_to_end(number)
        if len(self._truth) > REMEMBERED:
            self._truth.popitem(last=False)

    def truth(self, number: int) -> Scene | None:
        """Scene that frame `number` was measured of; None for one no longer remembered."""
        return self._truth.get(number)

    @property
    def active(self) -> tuple[Fault, ...]:
        """Faults for the next frame, for the board's own thread alone.

        Injected faults begin now, since only that thread knows the next frame; faults that are over
        are removed.
        """
        if self._cleared:
            self._cleared, self._faults = False, ()
        while self._injected:
            fault = self._injected.popleft()
            fault.frame = self.requests if Hook.REPLY in fault.kind.effects else self.frames
            self._faults += (fault,)
        if any(fault.over(self.frames) for fault in self._faults):
            self._faults = tuple(f for f in self._faults if not f.over(self.frames))
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

    def _lazily(self, scenes: SceneSource) -> "Callable[[int], Solved]":
        def solved(now: int) -> Solved:
            scene = scenes(now)
            return scene, self._solved(scene)

        return solved

    def _solved(self, scene: Scene) -> Matrix:
        with self._solving:
            return self._solve(scene)
