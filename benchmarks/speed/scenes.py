"""Workloads of the simulator: scenes per second and errors.

Random presses of 5 to 12 N on the reference sensor: single ones and up to four, many of one bend
and each with its own, by reanalysis and one by one, on two processes at once. Errors are those of
the presses' signals against the resolution "fine". The hinge has a transition: without, presses at
its ends meet a jump inside cells, which no resolution gets right, as one workload shows.
"""

import dataclasses
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from eitskin.datasets.recipe.touch_sampling import draw_positions
from eitskin.extras import require
from eitskin.geometry.deformation.fixtures import Bend, Hinge
from eitskin.geometry.design.outline import Rectangle
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.simulator.electrical.reanalysis import TOLERANCE
from eitskin.simulator.electrical.resolution import Resolution
from eitskin.simulator.scene.scene import Scene
from eitskin.simulator.scene.touch import Touch
from eitskin.simulator.simulator import Simulator

Array = NDArray[np.float64]

ANGLES = (-20.0, 50.0)
FORCES = (5.0, 12.0)
PER_BEND = 32
JUDGED = 12  # scenes of which the error is known
PROCESSES = 2


@dataclass(frozen=True, slots=True)
class Workload:
    """Workload: a kind of scenes and how they are solved.

    Attributes:
        name: of the workload.
        touches: lowest and highest number at once.
        per_bend: scenes that share a bend.
        resolution: of the simulator.
        tolerance: of reanalysis; 0 for scenes that are each solved by itself.
        transition: of the hinge [m].
    """

    name: str
    touches: tuple[int, int] = (1, 1)
    per_bend: int = PER_BEND
    resolution: Resolution = "fast"
    tolerance: float = TOLERANCE
    transition: float = 0.010

    def simulator(self, resolution: Resolution) -> Simulator:
        """Simulator of the reference sensor."""
        hinge = Hinge(transition=self.transition)
        return Simulator(SensorDesign.reference(), resolution, fixture=hinge)


JUMPING = Workload("one touch, 32 per bend, hinge without transition", transition=0.0)
WORKLOADS = (
    Workload("one touch, 32 per bend"),
    Workload("one to four touches, 32 per bend", touches=(1, 4)),
    Workload("one touch, bends of their own", per_bend=1),
    Workload("one to four touches, bends of their own", (1, 4), 1),
    Workload("one touch, 32 per bend, each solved by itself", tolerance=0.0),
    Workload("one touch, 32 per bend, resolution `standard`", resolution="standard"),
    JUMPING,
)


@dataclass(frozen=True, slots=True)
class Rate:
    """Speed and error of one workload.

    Attributes:
        name: of the workload.
        scenes_per_second: of two processes at once, solutions without touches included.
        scene_ms: of one scene, processor time of one process alone.
        error_median, error_max: norm of the error over norm of the signal, of some scenes.
    """

    name: str
    scenes_per_second: float
    scene_ms: float
    error_median: float
    error_max: float


def scenes(workload: Workload, count: int, seed: int) -> list[Scene]:
    """Scenes of random presses; scenes that share a bend follow each other."""
    rng = np.random.default_rng(seed)
    outline = Rectangle(0.150, 0.060)
    found = []
    for number in range(count):
        if number % workload.per_bend == 0:
            bend = Bend(float(rng.uniform(*ANGLES)))
        places = draw_positions(
            int(rng.integers(*workload.touches, endpoint=True)), outline, 0.01, 0.03, rng
        )
        touches = tuple(Touch(float(x), float(y), float(rng.uniform(*FORCES))) for x, y in places)
        found.append(Scene(bend, touches))
    return found


def work(workload: Workload, count: int, seed: int) -> tuple[float, float]:
    """Time and processor time [s] of solving `count` scenes, after meshing and a first scene."""
    with require("threadpoolctl", "bench").threadpool_limits(1):
        sim = workload.simulator(workload.resolution)
        some = scenes(workload, count, seed)
        sim.measure(some[0])
        start = time.perf_counter(), time.process_time()
        sim.measure_all(some, workload.tolerance)
        return time.perf_counter() - start[0], time.process_time() - start[1]


def rate(workload: Workload, count: int, pool: ProcessPoolExecutor) -> Rate:
    """Speed and error of a workload."""
    _, alone = work(workload, count // 2, 0)
    together = [pool.submit(work, workload, count, seed) for seed in range(1, PROCESSES + 1)]
    seconds = [future.result()[0] for future in together]
    errors = signal_errors(workload)
    return Rate(
        name=workload.name,
        scenes_per_second=sum(count / each for each in seconds),
        scene_ms=1e3 * alone / (count // 2),
        error_median=float(np.median(errors)),
        error_max=float(errors.max()),
    )


def signal_errors(workload: Workload) -> Array:
    """Relative errors of the signals of some scenes, four to a bend, (JUDGED,)."""
    some = scenes(dataclasses.replace(workload, per_bend=min(workload.per_bend, 4)), JUDGED, 99)
    truth = _true_signals(tuple(some), workload.transition)
    missed = _signals(some, workload, workload.resolution) - truth
    found: Array = np.linalg.norm(missed, axis=1) / np.linalg.norm(truth, axis=1)
    return found


@cache
def _true_signals(some: tuple[Scene, ...], transition: float) -> Array:
    return _signals(some, Workload("", tolerance=0.0, transition=transition), "fine")


def _signals(some: Sequence[Scene], workload: Workload, resolution: Resolution) -> Array:
    """Signals of the touches [ohm], (scenes, measurements)."""
    sim = workload.simulator(resolution)
    both = [*some, *(Scene(scene.bend) for scene in some)]
    measured = sim.measure_all(both, workload.tolerance).real
    changes: Array = measured[: len(some)] - measured[len(some) :]
    return changes


FOUR = tuple(
    Touch(x, y) for x, y in ((0.025, 0.018), (0.050, 0.042), (0.100, 0.042), (0.125, 0.018))
)
LIVE_SCENES = {
    "idle": Scene(),
    "bent": Scene(Bend(20.0)),
    "one touch, bent": Scene(Bend(20.0), FOUR[:1]),
    "four touches, bent": Scene(Bend(20.0), FOUR),
}
"""What a live board shows when its rate is measured, by name."""
