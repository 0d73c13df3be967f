"""Workloads of the simulator: scenes per second and errors.

Random presses of 4 to 12 N on the reference sensor in its default clamp: single ones and up to
four, each with a bend of its own or many of one bend, by reanalysis and one by one, on two
processes at once; and specimens of the recipe `training`, each set up and used for some scenes.
Errors are those of the presses' signals against the resolution "fine".
"""

import dataclasses
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import cache
from itertools import groupby, repeat
from operator import itemgetter

import numpy as np
from numpy.typing import NDArray

from eitskin.datasets.recipe.frame_sampling import specimen
from eitskin.datasets.recipe.recipe import Recipe
from eitskin.datasets.recipe.scene_group import draw_positions
from eitskin.geometry.deformation.fixtures import Bend
from eitskin.geometry.design.outline import Rectangle
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.simulator.electrical.reanalysis import TOLERANCE
from eitskin.simulator.electrical.resolution import Resolution
from eitskin.simulator.scene.scene import Scene, Touch
from eitskin.simulator.simulator import Simulator
from eitskin.threads import one_thread

Array = NDArray[np.float64]

ANGLES = (-20.0, 50.0)
FORCES = (4.0, 12.0)
PER_BEND = 32
PER_SPECIMEN = 22  # frames, as in the recipe `training`
_TRUE = 1e-6  # tolerance of signals that others are judged by
JUDGED = 50  # scenes of which the error is known
PROCESSES = 2


@dataclass(frozen=True, slots=True)
class Workload:
    """Workload: a kind of scenes and how they are solved.

    Attributes:
        name: of the workload.
        touches: lowest and highest number at once.
        per_bend: scenes that share a bend.
        resolution: of the simulator.
        tolerance: of reanalysis.
        specimens: whether every `PER_SPECIMEN` scenes have a specimen of their own.
    """

    name: str
    touches: tuple[int, int] = (1, 1)
    per_bend: int = 1
    resolution: Resolution = "fast"
    tolerance: float = TOLERANCE
    specimens: bool = False

    def simulators(self, count: int) -> Iterator[Simulator]:
        """Simulator of each scene."""
        if not self.specimens:
            yield from repeat(_reference(self.resolution), count)
            return
        recipe = Recipe.shipped("training")
        for number in range(-(-count // PER_SPECIMEN)):
            sim = specimen(recipe, number).simulator(recipe.sensor, self.resolution)
            yield from repeat(sim, min(PER_SPECIMEN, count - number * PER_SPECIMEN))


WORKLOADS = (
    Workload("one touch"),
    Workload("one to four touches", (1, 4)),
    Workload("one touch, 32 per bend", per_bend=PER_BEND),
    Workload("one touch, resolution `coarse`", resolution="coarse"),
    Workload("one to four touches, resolution `coarse`", (1, 4), resolution="coarse"),
    Workload("one touch, resolution `standard`", resolution="standard"),
    Workload("one touch, specimens of their own", specimens=True),
    Workload("one touch, specimens, resolution `coarse`", resolution="coarse", specimens=True),
    Workload("one touch, each solved by itself", tolerance=0.0),
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
    with one_thread():
        some = scenes(workload, count, seed)
        _measured(workload, some[:1])
        start = time.perf_counter(), time.process_time()
        _measured(workload, some)
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
    """Relative errors of the signals of some scenes, (JUDGED,)."""
    judged = dataclasses.replace(workload, per_bend=1, specimens=False)
    truth = _true_signals(judged.touches)
    missed = _signals(judged) - truth
    found: Array = np.linalg.norm(missed, axis=1) / np.linalg.norm(truth, axis=1)
    return found


@cache
def _true_signals(touches: tuple[int, int]) -> Array:
    return _signals(Workload("", touches, resolution="fine", tolerance=_TRUE))


def _signals(workload: Workload) -> Array:
    """Signals of the touches of the judged scenes [ohm], (JUDGED, measurements)."""
    some = scenes(workload, JUDGED, 99)
    measured = _measured(workload, [*some, *(Scene(scene.bend) for scene in some)])
    changes: Array = measured[:JUDGED] - measured[JUDGED:]
    return changes


def _measured(workload: Workload, some: Sequence[Scene]) -> Array:
    """Measurements [ohm] of scenes, (scenes, measurements)."""
    pairs = zip(workload.simulators(len(some)), some, strict=True)
    found = [
        sim.measure_all([scene for _, scene in own], workload.tolerance)
        for sim, own in groupby(pairs, key=itemgetter(0))
    ]
    return np.concatenate(found).real


@cache
def _reference(resolution: Resolution) -> Simulator:
    return Simulator(SensorDesign.reference(), resolution)


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
