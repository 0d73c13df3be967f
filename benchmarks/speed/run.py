"""Speed of simulation, generation and pipeline: `eitskin bench speed`.

Scenes per second and errors of several workloads, with pyEIT in the same run; the lower bound of
the arithmetic; frames per second and memory of making a dataset; and the time of a frame in the
shipped pipeline.
"""

import itertools
import multiprocessing
import resource
import tempfile
import time
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from eitskin.benchmarks.accuracy import cases, peer
from eitskin.benchmarks.accuracy.truth import drops
from eitskin.benchmarks.speed.scenes import (
    ANGLES,
    FORCES,
    LIVE_SCENES,
    PER_BEND,
    PROCESSES,
    WORKLOADS,
    Rate,
    rate,
    scenes,
)
from eitskin.compiled import kernels
from eitskin.datasets.generation.generate import generate
from eitskin.datasets.recipe.recipe import Recipe
from eitskin.datasets.recipe.scene_group import SceneGroup
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.hardware.opening import open_board
from eitskin.hardware.virtual.stage import Script, Step
from eitskin.provenance import Provenance
from eitskin.simulator.electrical.forward_model import ForwardModel
from eitskin.simulator.electrical.reanalysis import Reanalysis
from eitskin.simulator.scene.scene import Scene
from eitskin.threads import one_thread

Watch: TypeAlias = Callable[[str, Sequence[Any]], Iterable[Any]]

SCENES_PER_WAY, QUICK_SCENES = 384, 32  # of each process
FRAMES, QUICK_FRAMES = 400, 60  # of each scene through the pipeline
QUICK_WORKLOADS = WORKLOADS[:1]
SETTLED = 20  # frames before those whose time counts: references are taken then


@dataclass(frozen=True, slots=True)
class Peer:
    """Speed of pyEIT on scenes of a conductivity: nodes of its mesh, and time of a scene [ms]."""

    nodes: int
    scene_ms: float


@dataclass(frozen=True, slots=True)
class Floor:
    """Floating-point operations of one reanalysed touch, of its matrices and solutions.

    Attributes:
        operations: how many.
        least_ms: their time at the rate of a large product of matrices.
        ms: the time that the touch takes.
    """

    operations: float
    least_ms: float
    ms: float


@dataclass(frozen=True, slots=True)
class Generation:
    """A dataset of single touches, each on a bend of its own.

    Attributes:
        frames: of the dataset, made by `PROCESSES` workers.
        frames_per_second: from the call to the manifest.
        share: of the scenes per second of the engine alone.
        memory_mb: by number of frames, the most that a worker used [MB].
    """

    frames: int
    frames_per_second: float
    share: float
    memory_mb: dict[int, float]


@dataclass(frozen=True, slots=True)
class FrameTime:
    """Time of `Pipeline.process` for one frame of a scene: median and 99th percentile [ms]."""

    scene: str
    median_ms: float
    p99_ms: float


@dataclass(frozen=True, slots=True)
class Speed:
    """All speeds of one run; None for packages that are not installed."""

    provenance: Provenance
    seconds: float
    quick: bool
    rates: tuple[Rate, ...]
    peer: Peer | None
    floor: Floor
    generation: Generation
    frames: tuple[FrameTime, ...]

    @property
    def peer_ratio(self) -> float:
        """Ratio of pyEIT's time for a scene to that of the first workload."""
        return self.peer.scene_ms / self.rates[0].scene_ms if self.peer else float("nan")


def run(seed: int, quick: bool, watch: Watch = lambda _, items: items) -> Speed:
    """Measure everything on two cores.

    Args:
        seed: of the virtual board's noise and of the conductivities that pyEIT solves; scenes are
            the same in every run.
        quick: two workloads and fewer scenes.
        watch: gives back the items that its text is about; shows progress where wanted.
    """
    start = time.perf_counter()
    count, frames = (QUICK_SCENES, QUICK_FRAMES) if quick else (SCENES_PER_WAY, FRAMES)
    workloads = QUICK_WORKLOADS if quick else WORKLOADS
    with ProcessPoolExecutor(PROCESSES, multiprocessing.get_context("spawn")) as pool:
        rates = tuple(rate(workload, count, pool) for workload in watch("workloads", workloads))
    engine = rates[0]
    with one_thread():
        (other,) = (solve(seed) for solve in watch("pyEIT", [pyeit]))
        least = floor()
        times = tuple(
            frame_time(name, frames, seed) for name in watch("pipeline", list(LIVE_SCENES))
        )
    (made,) = (make(count, engine) for make in watch("datasets", [generation]))
    return Speed(
        provenance=Provenance.now(seed),
        seconds=time.perf_counter() - start,
        quick=quick,
        rates=rates,
        peer=other,
        floor=least,
        generation=made,
        frames=times,
    )


def pyeit(seed: int, count: int = 5) -> Peer | None:
    """Median processor time of a scene by pyEIT; None where it is not installed."""
    if not peer.is_installed():
        return None
    design, case = SensorDesign.reference(), cases.PEERS[0]
    model = peer.PointElectrodeModel(design, ForwardModel(design, case.resolution).mesh, False)
    frame, times = model.frame(design.conductivity), []
    for drop in drops(design, seed, count):
        start = time.process_time()
        frame(drop)
        times.append(time.process_time() - start)
    return Peer(model.nodes, 1e3 * float(np.median(times)))


def floor(count: int = PER_BEND) -> Floor:
    """Cost of the matrices and solutions of one reanalysed touch, and its lower bound.

    Counted are element matrices, static condensation, and for each correction a solution with the
    factors and a product with the element matrices. The scene's fields are not.
    """
    sim = next(WORKLOADS[0].simulators(1))
    some = scenes(WORKLOADS[0], count, 5)
    solved = Reanalysis(sim.model, sim.deformed_layer(Scene()))
    with kernels():
        solved.impedance(sim.deformed_layer(some[0]))
        before = solved.solutions
        start = time.process_time()
        for scene in some:
            solved.impedance(sim.deformed_layer(scene))
        seconds = (time.process_time() - start) / count
    corrections = (solved.solutions - before) / count
    total = _operations(sim.model, corrections)
    return Floor(total, 1e3 * total / _product_rate(), 1e3 * seconds)


def _operations(model: ForwardModel, corrections: float) -> float:
    """Operations, multiplications and additions, for one scene with as many corrections."""
    assembly, solver = model.assembly, model.solver
    elements, outer = assembly.space.numbers.shape
    inner, electrodes = assembly.space.element.inner, assembly.electrodes
    points, components, entries = assembly._reference.shape
    matrices = 2 * elements * points * components * entries
    condensation = elements * (2 * inner**3 / 3 + 2 * inner**2 * outer + 2 * inner * outer**2)
    product = 2 * (elements + len(assembly.facet_numbers)) * outer**2 * electrodes
    # Inverse and lower block of each front, once forward and once backward.
    blocks = sum(front.size * (front.size + front.outer) for front in solver.fronts)
    solution = 4 * blocks * electrodes
    return float(matrices + condensation + product + corrections * (solution + product))


def _product_rate(size: int = 1500) -> float:
    """Operations per second of a product of large matrices."""
    a = np.random.default_rng(0).normal(size=(size, size))
    a @ a
    start = time.process_time()
    a @ a
    return 2 * size**3 / (time.process_time() - start)


def recipe(frames: int) -> Recipe:
    """Recipe of single touches, each on a bend of its own."""
    group = SceneGroup("touch", frames, ANGLES, force=FORCES)
    return Recipe(name="rate", scenes=(group,), frames_per_shard=256)


def generation(count: int, engine: Rate) -> Generation:
    """Speed and memory of datasets of eight, one and four times `count` frames of `engine`."""
    frames = 8 * count
    with tempfile.TemporaryDirectory() as folder:
        start = time.perf_counter()
        generate(recipe(frames), Path(folder) / "set", workers=PROCESSES)
        rate_made = frames / (time.perf_counter() - start)
    return Generation(
        frames=frames,
        frames_per_second=rate_made,
        share=rate_made / engine.scenes_per_second,
        memory_mb={size: memory_mb(size) for size in (count, 4 * count)},
    )


def memory_mb(frames: int) -> float:
    """Peak memory [MB] of a worker that made a dataset.

    Found in a process of its own: a system remembers the most that any child used.
    """
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        return pool.submit(_children_mb, frames).result()


def _children_mb(frames: int) -> float:
    with tempfile.TemporaryDirectory() as folder:
        generate(recipe(frames), Path(folder) / "set", workers=1)
    return resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1e3


def frame_time(name: str, frames: int, seed: int) -> FrameTime:
    """Frame time of the shipped pipeline for a live scene with every term of the AD5940's chain."""
    from eitskin.training.pipeline.pipeline import Pipeline

    pipeline = Pipeline.load("reference.eitmodel")
    script = Script((Step(Scene(), 12), Step(LIVE_SCENES[name], 1)), repeat=False)
    settings = {"instrument": "ad5940", "speed": "max", "period": 0.01}
    with open_board("virtual:", scene=script, seed=seed, **settings) as board:
        shown = list(itertools.islice(board.frames(), frames + SETTLED))
    seconds = []
    for frame in shown:
        start = time.perf_counter()
        pipeline.process(frame)
        seconds.append(time.perf_counter() - start)
    median, p99 = np.percentile(1e3 * np.array(seconds[SETTLED:]), (50, 99))
    return FrameTime(name, float(median), float(p99))
