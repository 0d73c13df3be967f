"""Speed of simulation, generation and pipeline: `eitskin bench speed`.

Random presses of 4 to 12 N on the reference sensor in its default clamp, single ones and up to
four, each with a bend of its own, by reanalysis and one by one, on two processes at once; and
specimens of the recipe `training`, each set up and used for some scenes. Errors are those of the
presses' signals against the resolution "fine", of other sensors' signals against "standard".
In the same run: pyEIT, single impedance matrices, and the least time that the operations of a scene
take; frames per second and memory of making a dataset; the time of a frame in the shipped pipeline,
and of the first frame of a process.
"""

import dataclasses
import itertools
import multiprocessing
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor
from dataclasses import dataclass
from functools import cache, partial
from itertools import groupby, repeat
from operator import itemgetter
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from eitskin.benchmarks.forward_models import (
    Frame,
    PointElectrodeModel,
    drops,
    has_pyeit,
    model_frame,
)
from eitskin.benchmarks.forward_models import uniform as uniform_mesh
from eitskin.benchmarks.results import (
    Columns,
    Report,
    ReportTable,
    Watch,
    make_results,
    peak_memory_mb,
    plot_errors,
)
from eitskin.datasets.generation.generate import generate
from eitskin.datasets.recipe.frame_sampling import specimen
from eitskin.datasets.recipe.recipe import Recipe
from eitskin.datasets.recipe.scene_group import SceneGroup, draw_positions
from eitskin.geometry.deformation.fixtures import Bend, Hinge
from eitskin.geometry.design.outline import Disc, Rectangle
from eitskin.geometry.design.regular_layouts import uniform
from eitskin.geometry.design.sensor import Plates, SensorDesign
from eitskin.hardware.opening import open_board
from eitskin.hardware.virtual.stage import Script, Step
from eitskin.simulator.electrical.batch import TOLERANCE
from eitskin.simulator.electrical.forward_model import ForwardModel
from eitskin.simulator.electrical.resolution import Resolution
from eitskin.simulator.scene.scene import Scene, Touch
from eitskin.simulator.simulator import Simulator
from eitskin.threads import one_thread

Array = NDArray[np.float64]

SCENES, QUICK_SCENES = 384, 32  # of each process
FEW_ELECTRODES = 8  # up to which all scenes are solved and `fine` is the truth
FEWER_SCENES = 4  # times fewer with more electrodes
FRAMES, QUICK_FRAMES = 400, 60  # of each scene through the pipeline
SETTLING_FRAMES = 20  # frames before those whose time counts: references are taken then
_COLUMNS: Columns = {
    "scenes": ("name", "", 1),
    "per second": ("scenes_per_second", ".0f", 1),
    "ms, one process alone": ("scene_ms", ".0f", 1),
    "error, median": ("error_median", ".1%", 1),
    "largest": ("error_max", ".1%", 1),
}
ANGLES = (-20.0, 50.0)
FORCES = (4.0, 12.0)
PER_SPECIMEN = 22  # frames, as in the recipe `training`
_TRUE = 1e-6  # tolerance of signals that others are tested by
JUDGED_SCENES = 50  # scenes of which the error is known
PROCESSES = 2


@dataclass(frozen=True, slots=True)
class Workload:
    """Workload: a kind of scenes and how they are solved.

    Attributes:
        name: name of the workload.
        touches: lowest and highest number at once.
        resolution: resolution of the simulator.
        tolerance: tolerance of reanalysis.
        specimens: whether every `PER_SPECIMEN` scenes have a specimen of their own.
        electrodes: electrodes at equal distances around the reference's rectangle.
        disc: whether the sensor is a disc on a hinge, which is bent alone.
        plates: whether it rests on plates; scenes are those that tables hold.
    """

    name: str
    touches: tuple[int, int] = (1, 1)
    resolution: Resolution = "fast"
    tolerance: float = TOLERANCE
    specimens: bool = False
    electrodes: int = 8
    disc: bool = False
    plates: bool = False

    def simulators(self, count: int) -> Iterator[Simulator]:
        """Simulator of each scene."""
        if not self.specimens:
            sim = _simulator(self.resolution, self.electrodes, self.disc)
            yield from repeat(sim, count)
            return
        recipe = Recipe.from_shipped("training")
        for number in range(-(-count // PER_SPECIMEN)):
            sim = specimen(recipe, number).simulator(recipe.sensor, self.resolution)
            yield from repeat(sim, min(PER_SPECIMEN, count - number * PER_SPECIMEN))


WORKLOADS = (
    Workload("one touch"),
    Workload("one to four touches", (1, 4)),
    Workload("one touch, resolution `coarse`", resolution="coarse"),
    Workload("one to four touches, resolution `coarse`", (1, 4), resolution="coarse"),
    Workload("one touch, resolution `standard`", resolution="standard"),
    Workload("one touch, specimens of their own", specimens=True),
    Workload("one touch, specimens, resolution `coarse`", resolution="coarse", specimens=True),
    Workload("one touch, each solved by itself", tolerance=0.0),
    Workload("one touch, on plates", plates=True),
    Workload("one touch, 16 electrodes", electrodes=16),
    Workload("one touch, 32 electrodes", electrodes=32),
    Workload("no touch, a disc", touches=(0, 0), disc=True),
)


@dataclass(frozen=True, slots=True)
class Rate:
    """Speed and error of one workload.

    Attributes:
        name: name of the workload.
        scenes_per_second: scenes per second of two processes, untouched solutions included.
        scene_ms: scene of one scene, processor time of one process alone.
        error_median, error_max: norm of the error over norm of the signal, of some scenes.
    """

    name: str
    scenes_per_second: float
    scene_ms: float
    error_median: float
    error_max: float


def scenes(workload: Workload, count: int, seed: int) -> list[Scene]:
    """Scenes of random presses."""
    rng = np.random.default_rng(seed)
    outline = Rectangle(0.150, 0.060)
    scene_list: list[Scene] = []
    while len(scene_list) < count:
        bend = Bend(float(rng.uniform(*ANGLES)))
        places = draw_positions(
            int(rng.integers(*workload.touches, endpoint=True)), outline, 0.01, 0.03, rng
        )
        touches = tuple(Touch(float(x), float(y), float(rng.uniform(*FORCES))) for x, y in places)
        scene = Scene(bend, touches, support=Plates() if workload.plates else None)
        if not workload.plates or not _simulator("coarse", 8, False).solves_presses(scene):
            scene_list.append(scene)
    return scene_list


def work(workload: Workload, count: int, seed: int) -> tuple[float, float]:
    """Time and processor time [s] of solving `count` scenes, after meshing and a first scene."""
    some = scenes(workload, count, seed)
    _simulate_scenes(workload, some[:1])
    start = time.perf_counter(), time.process_time()
    _simulate_scenes(workload, some)
    return time.perf_counter() - start[0], time.process_time() - start[1]


def rate(workload: Workload, count: int, pool: Executor) -> Rate:
    """Speed and error of a workload."""
    if workload.electrodes > FEW_ELECTRODES:
        count //= FEWER_SCENES
    _, alone = work(workload, count // 2, 0)
    together = [pool.submit(work, workload, count, seed) for seed in range(1, PROCESSES + 1)]
    seconds = [future.result()[0] for future in together]
    errors = signal_errors(workload, pool)
    return Rate(
        name=workload.name,
        scenes_per_second=sum(count / second for second in seconds),
        scene_ms=1e3 * alone / (count // 2),
        error_median=float(np.median(errors)),
        error_max=float(errors.max()),
    )


def signal_errors(workload: Workload, pool: Executor) -> Array:
    """Relative errors of the signals of some scenes, (`JUDGED_SCENES`,)."""
    judged = dataclasses.replace(workload, name="", specimens=False)
    few = judged.electrodes <= FEW_ELECTRODES and not judged.disc
    finest: Resolution = "fine" if few else "standard"
    truth = _true_signals(dataclasses.replace(judged, resolution=finest, tolerance=_TRUE), pool)
    missed = _signals(judged, pool) - truth
    errors: Array = np.linalg.norm(missed, axis=1) / np.linalg.norm(truth, axis=1)
    return errors


@cache
def _true_signals(workload: Workload, pool: Executor) -> Array:
    return _signals(workload, pool)


def _signals(workload: Workload, pool: Executor) -> Array:
    """Signals of the tested scenes' touches, or of bends without, [ohm]."""
    some = scenes(workload, JUDGED_SCENES, 99)
    others = [
        Scene(scene.bend if scene.touches else Bend(0.0), support=scene.support) for scene in some
    ]
    measured, unpressed = pool.map(_simulate_scenes, repeat(workload), (some, others))
    changes: Array = measured - unpressed
    return changes


def _simulate_scenes(workload: Workload, some: Sequence[Scene]) -> Array:
    """Measurements [ohm] of scenes, (scenes, measurements)."""
    pairs = zip(workload.simulators(len(some)), some, strict=True)
    with one_thread():
        frames = [
            sim.measure_all([scene for _, scene in own], workload.tolerance)
            for sim, own in groupby(pairs, key=itemgetter(0))
        ]
    return np.concatenate(frames).real


@cache
def _simulator(resolution: Resolution, electrodes: int, disc: bool) -> Simulator:
    """The reference sensor, or one that differs from it in its outline and electrodes."""
    design = SensorDesign.reference()
    if disc or electrodes != len(design.electrodes):
        outline = Disc(0.05) if disc else design.outline
        ring = uniform(outline, electrodes)
        design = dataclasses.replace(design, outline=outline, electrodes=ring)
    return Simulator(design, resolution, Hinge(0.05) if disc else None)


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


PEER_CASES = {
    "pyEIT": uniform_mesh(4.4e-3, 2),
    "pyEIT, fine": uniform_mesh(2.2e-3, 4),
    "pyEIT, plane": uniform_mesh(2e-3, 0),
}


def pyeit(seed: int, name: str) -> dict[str, float]:
    """Nodes and time of an impedance matrix by pyEIT; nothing where it is not installed."""
    if not has_pyeit():
        return {}
    design, case = SensorDesign.reference(), PEER_CASES[name]
    plane = case.family.startswith("squares")
    model = PointElectrodeModel(design, ForwardModel(design, case.resolution).mesh, plane)
    return {f"{name}.nodes": model.nodes} | _matrix_ms(name, model.frame(1.0), seed)


def impedance(seed: int, resolution: Resolution) -> dict[str, float]:
    """Unknowns and time of an impedance matrix at a resolution."""
    name, model = (
        f"impedance matrix, {resolution}",
        ForwardModel(SensorDesign.reference(), resolution),
    )
    return {f"{name}.unknowns": model.unknowns} | _matrix_ms(name, model_frame(model), seed)


def _matrix_ms(name: str, frame: Frame, seed: int) -> dict[str, float]:
    """Median processor time of the frames of some drops of the conductivity [ms]."""
    times = []
    for drop in drops(SensorDesign.reference(), seed):
        start = time.process_time()
        frame(drop)
        times.append(time.process_time() - start)
    return {f"{name}.matrix_ms": 1e3 * float(np.median(times))}


def floor() -> dict[str, float]:
    """Operations of a scene that is solved on its own, and their time at the rate of products."""
    model = ForwardModel(SensorDesign.reference(), "fast")
    space, fronts = model.assembly.space, model.solver.fronts
    outer, inner, points = space.numbers.shape[1], space.element.inner, len(space.rule.weights)
    entries = (outer + inner) * (outer + inner + 1) // 2
    element = 12 * points * entries + inner**3 // 3 + inner**2 * outer + inner * outer**2
    operations = len(space.numbers) * element + sum(
        front.size**3 // 3 + front.coupled**2 * front.outer + front.coupled * front.outer**2
        for front in fronts
    )
    figures = {"floor.million_operations": 1e-6 * operations}
    for name, kind in {"double": np.float64, "single": np.float32}.items():
        square, times = np.ones((1500, 1500), dtype=kind), []
        for _ in range(5):
            start = time.process_time()
            _ = square @ square
            times.append(time.process_time() - start)
        figures[f"floor, {name}.ms"] = 1e3 * operations * min(times) / (2 * len(square) ** 3)
    return figures


def recipe(frames: int) -> Recipe:
    """Recipe of single touches, each on a bend of its own."""
    group = SceneGroup("touch", frames, ANGLES, force=FORCES)
    return Recipe(name="rate", scenes=(group,), frames_per_shard=256)


def generation(count: int, engine: Rate) -> dict[str, float]:
    """Speed and memory of datasets of eight, one and four times `count` frames of `engine`."""
    frames = 8 * count
    with tempfile.TemporaryDirectory() as folder:
        start = time.perf_counter()
        generate(recipe(frames), Path(folder) / "set", workers=PROCESSES)
        rate_made = frames / (time.perf_counter() - start)
    figures: dict[str, float] = {
        "dataset.frames": frames,
        "dataset.frames_per_second": rate_made,
        "dataset.share_percent": 100.0 * rate_made / engine.scenes_per_second,
    }
    for name, size in {"small": count, "large": 4 * count}.items():
        figures |= {f"memory, {name}.frames": size, f"memory, {name}.mb": memory_mb(size)}
    return figures


def memory_mb(frames: int) -> float:
    """Peak memory [MB] of a worker that made a dataset.

    Found in a process of its own, which is that worker: a system remembers the most it used.
    """
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        return pool.submit(_peak_mb, frames).result()


def _peak_mb(frames: int) -> float:
    with tempfile.TemporaryDirectory() as folder:
        generate(recipe(frames), Path(folder) / "set", workers=1)
    return peak_memory_mb()


def frame_time(name: str, frames: int, seed: int) -> dict[str, float]:
    """Frame time of the shipped pipeline for a live scene with every term of the AD5940's chain."""
    from eitskin.training.pipeline.pipeline import Pipeline

    pipeline = Pipeline.load("reference.eitmodel")
    script = Script((Step(Scene(), 12), Step(LIVE_SCENES[name], 1)), repeat=False)
    settings = {"instrument": "ad5940", "speed": "max", "period": 0.01}
    with open_board("virtual:", scene=script, seed=seed, **settings) as board:
        shown = list(itertools.islice(board.frames(), frames + SETTLING_FRAMES))
    seconds = []
    for frame in shown:
        start = time.perf_counter()
        pipeline.process(frame)
        seconds.append(time.perf_counter() - start)
    median, p99 = np.percentile(1e3 * np.array(seconds[SETTLING_FRAMES:]), (50, 99))
    return {f"pipeline, {name}.median_ms": float(median), f"pipeline, {name}.p99_ms": float(p99)}


FRESH_PROCESSES = 10
_FIRST_FRAME = """
from time import perf_counter
begun = perf_counter()
from eitskin import Scene, SensorDesign, Simulator, Touch
imported = perf_counter()
sim = Simulator(SensorDesign.reference())
meshed = perf_counter()
sim.measure(Scene(touches=(Touch(0.050, 0.020),)))
print(imported - begun, meshed - imported, perf_counter() - meshed)
"""


def first_frame(processes: int) -> dict[str, float]:
    """Time of imports, mesh and first frame of a touch, and of the process: of the fastest [s]."""
    times = []
    for _ in range(processes):
        start = time.perf_counter()
        printed = subprocess.check_output([sys.executable, "-c", _FIRST_FRAME], text=True)  # noqa: S603
        times.append((time.perf_counter() - start, *map(float, printed.split())))
    names = "process_s", "imports_s", "mesh_s", "frame_s"
    named = zip(names, min(times), strict=True)
    return {f"first frame of a process.{name}": seconds for name, seconds in named}


def run(seed: int, quick: bool, watch: Watch = lambda _, items: items) -> Report:
    """Measure everything on two cores.

    Args:
        seed: seed of the virtual board's noise and of the conductivities that pyEIT solves; scenes
            are the same in every run.
        quick: one workload and fewer scenes.
        watch: gives back the items that its text is about; shows progress where wanted.
    """
    began = time.perf_counter()
    count, frames = (QUICK_SCENES, QUICK_FRAMES) if quick else (SCENES, FRAMES)
    workloads = WORKLOADS[:1] if quick else WORKLOADS
    with ProcessPoolExecutor(PROCESSES, multiprocessing.get_context("spawn")) as pool:
        rates = tuple(rate(workload, count, pool) for workload in watch("workloads", workloads))
    figures: dict[str, float] = {}
    with one_thread():
        for name in watch("pyEIT", list(PEER_CASES)[: 1 if quick else None]):
            figures |= pyeit(seed, name)
        names: tuple[Resolution, ...] = ("fast",) if quick else ("fast", "standard", "fine")
        for resolution in watch("impedance matrices", names):
            figures |= impedance(seed, resolution)
        figures |= floor()
        own = {"pyEIT, fine": figures.get("impedance matrix, standard.matrix_ms")}
        for name in PEER_CASES:
            if f"{name}.nodes" in figures:
                compared = own.get(name) or rates[0].scene_ms
                figures[f"{name}.times_longer"] = figures[f"{name}.matrix_ms"] / compared
        for name in watch("pipeline", list(LIVE_SCENES)):
            figures |= frame_time(name, frames, seed)
    for processes in watch("first frame", [2 if quick else FRESH_PROCESSES]):
        figures |= first_frame(processes)
    for make in watch("datasets", [generation]):
        figures |= make(count, rates[0])
    rows = [dataclasses.asdict(each) for each in rates]
    table = ReportTable.from_rows(rows, _COLUMNS)
    points = {
        each.name: [(each.scenes_per_second, 100 * e) for e in (each.error_median, each.error_max)]
        for each in rates
    }
    x, y = "scenes per second, two processes", "error of the signal, median and largest [%]"
    missing = "pyEIT is not installed and was left out: pip install 'eitskin[bench]'"
    return Report(
        results=make_results(
            "speed", (*table.figures(), *figures.items()), began=began, seed=seed, quick=quick
        ),
        rows=rows,
        tables=[table],
        sentences=[
            *(() if "pyEIT.nodes" in figures else (missing,)),
            *(f"{name}: {value:.4g}" for name, value in figures.items()),
        ],
        plots={"speed.png": partial(plot_errors, panels={"": points}, x=x, y=y)},
    )
