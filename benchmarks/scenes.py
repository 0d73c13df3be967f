"""Scenes per second and the error they buy: `python -m eitskin.benchmarks.scenes`.

Random presses of 5 to 12 N on the reference sensor, by several ways through the simulator: single
ones and up to four, many of one bend and each with its own, by reanalysis and one by one, on two
processes at once; then how many frames per second datasets are made with, and with how much memory.
Errors are those of the presses' signals against the resolution "fine". The hinge has a transition:
without, presses at its ends meet a jump inside cells, which no resolution gets right (one way has
none, to show it). pyEIT solves, in the same run, scenes of a conductivity alone.
"""

import argparse
import dataclasses
import multiprocessing
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from eitskin.benchmarks import cases, peer
from eitskin.benchmarks.provenance import Provenance
from eitskin.benchmarks.tables import write_table
from eitskin.benchmarks.truth import drops
from eitskin.datasets import Recipe
from eitskin.datasets.generate import generate
from eitskin.datasets.places import draw_places
from eitskin.datasets.scene_group import SceneGroup
from eitskin.geometry import Bend, Hinge, Rectangle, SensorDesign
from eitskin.geometry.optional import require
from eitskin.simulator import EXACT, ForwardModel, Scene, Simulator, Tolerance, Touch
from eitskin.simulator.blocks import BlockCholesky
from eitskin.simulator.reanalysis import Reanalysis
from eitskin.simulator.resolution import Resolution
from eitskin.simulator.setting import Setting

Array = NDArray[np.float64]

ANGLES = (-20.0, 50.0)
FORCES = (5.0, 12.0)
PER_BEND = 32
JUDGED = 12  # scenes of which the error is known
PROCESSES = 2


@dataclass(frozen=True, slots=True)
class Way:
    """One way through the simulator.

    Attributes:
        name: of the way.
        touches: lowest and highest number at once.
        per_bend: scenes that share a bend.
        resolution: of the simulator.
        tolerance: of reanalysis; the default when omitted.
        device: of torch, for batches.
        transition: of the hinge [m].
    """

    name: str
    touches: tuple[int, int] = (1, 1)
    per_bend: int = PER_BEND
    resolution: Resolution = "fast"
    tolerance: Tolerance | None = None
    device: str | None = None
    transition: float = 0.010

    def simulator(self, resolution: Resolution) -> Simulator:
        """Of the reference sensor."""
        hinge = Hinge(transition=self.transition)
        return Simulator(SensorDesign.reference(), resolution, fixture=hinge)


JUMPING = Way("one touch, 32 per bend, hinge that jumps", transition=0.0)
WAYS = (
    Way("one touch, 32 per bend"),
    Way("one to four touches, 32 per bend", touches=(1, 4)),
    Way("one touch, bends of their own", per_bend=1),
    Way("one to four touches, bends of their own", (1, 4), 1),
    Way("one touch, 32 per bend, exact", tolerance=EXACT),
    Way("one touch, 32 per bend, standard", resolution="standard"),
    JUMPING,
    Way("one touch, 32 per bend, batches by torch", device="cpu"),
)


@dataclass(frozen=True, slots=True)
class Rate:
    """What one way costs and buys.

    Attributes:
        name: of the way.
        scenes_per_second: of two processes at once, solutions without touches included.
        scene_ms: of one scene, processor time of one process alone.
        error_median, error_max: norm of the error over norm of the signal, of some scenes.
    """

    name: str
    scenes_per_second: float
    scene_ms: float
    error_median: float
    error_max: float


def scenes(way: Way, count: int, seed: int) -> list[Scene]:
    """Random presses; those that share a bend follow each other."""
    rng = np.random.default_rng(seed)
    outline = Rectangle(0.150, 0.060)
    found = []
    for number in range(count):
        if number % way.per_bend == 0:
            bend = Bend(float(rng.uniform(*ANGLES)))
        places = draw_places(
            int(rng.integers(*way.touches, endpoint=True)), outline, 0.01, 0.03, rng
        )
        touches = tuple(Touch(float(x), float(y), float(rng.uniform(*FORCES))) for x, y in places)
        found.append(Scene(bend, touches))
    return found


def work(way: Way, count: int, seed: int) -> tuple[float, float]:
    """Time and processor time of solving so many scenes, after meshing and a first one [s]."""
    with require("threadpoolctl", "bench").threadpool_limits(1):
        if way.device:
            require("torch", "training").set_num_threads(1)
        sim = way.simulator(way.resolution)
        some = scenes(way, count, seed)
        sim.measure(some[0])
        start = time.perf_counter(), time.process_time()
        sim.measure_all(some, way.tolerance, device=way.device)
        return time.perf_counter() - start[0], time.process_time() - start[1]


def rate(way: Way, count: int, pool: ProcessPoolExecutor) -> Rate:
    """Measure one way."""
    _, alone = work(way, count // 2, 0)
    together = [pool.submit(work, way, count, seed) for seed in range(1, PROCESSES + 1)]
    seconds = [future.result()[0] for future in together]
    errors = signal_errors(way)
    return Rate(
        name=way.name,
        scenes_per_second=sum(count / each for each in seconds),
        scene_ms=1e3 * alone / (count // 2),
        error_median=float(np.median(errors)),
        error_max=float(errors.max()),
    )


def signal_errors(way: Way) -> Array:
    """Of some scenes, four to a bend so that they are reanalysed, (JUDGED,)."""
    some = scenes(dataclasses.replace(way, per_bend=min(way.per_bend, 4)), JUDGED, 99)
    truth = _true_signals(tuple(some), way.transition)
    missed = _signals(some, way, way.resolution) - truth
    found: Array = np.linalg.norm(missed, axis=1) / np.linalg.norm(truth, axis=1)
    return found


@cache
def _true_signals(some: tuple[Scene, ...], transition: float) -> Array:
    return _signals(some, Way("", tolerance=EXACT, transition=transition), "fine")


def _signals(some: Sequence[Scene], way: Way, resolution: Resolution) -> Array:
    """What the touches change [ohm], (scenes, measurements)."""
    sim = way.simulator(resolution)
    both = [*some, *(Scene(scene.bend) for scene in some)]
    measured = sim.measure_all(both, way.tolerance, device=way.device).real
    changes: Array = measured[: len(some)] - measured[len(some) :]
    return changes


def other(count: int = 5) -> tuple[float, int]:
    """Median processor time of a scene by pyEIT [s], and the nodes of its mesh."""
    design, case = SensorDesign.reference(), cases.PEERS[0]
    model = peer.PointElectrodeModel(design, ForwardModel(design, case.resolution).mesh, False)
    frame, times = model.frame(design.conductivity), []
    for drop in drops(design, 0, count):
        start = time.process_time()
        frame(drop)
        times.append(time.process_time() - start)
    return float(np.median(times)), model.nodes


def operations(count: int = PER_BEND) -> tuple[float, float, float]:
    """Floating-point operations of one reanalysed touch, their least time, and its time [s].

    Of the elimination of its strips and of its elements' matrices, at the rate of a large product
    of matrices.
    """
    sim = WAYS[0].simulator("fast")
    solver, assembly = sim.model.solver, sim.model.assembly
    if not isinstance(solver, BlockCholesky):
        raise TypeError("the reference sensor is solved strip by strip")
    some = scenes(WAYS[0], count, 5)
    solved = Reanalysis(sim.model, sim.setting(Scene(some[0].bend)))
    before = solved.strips, solved.resolved
    start = time.process_time()
    for scene in some:
        solved.impedance(sim.setting(scene))
    seconds = (time.process_time() - start) / count
    strips, resolved = (
        (now - then) / count
        for now, then in zip((solved.strips, solved.resolved), before, strict=True)
    )
    w, c = (
        float(np.mean([x for x in xs if x]))
        for xs in zip(*((len(s.unknowns), s.carried) for s in solver.strips), strict=True)
    )
    per_strip = w**3 / 3 + w * c**2 + w**2 * c
    q, entries = assembly._reference.shape[0] * 6, assembly._reference.shape[2]
    total = strips * per_strip + 2 * resolved * q * entries
    a = np.random.default_rng(0).normal(size=(1500, 1500))
    a @ a
    start = time.process_time()
    a @ a
    speed = 2 * len(a) ** 3 / (time.process_time() - start)
    return total, total / speed, seconds


@dataclass(frozen=True, slots=True)
class Near:
    """A touched layer, but untouched farther than `distance` [m] from the touch along x."""

    touched: Setting
    untouched: Setting
    x: float
    distance: float

    def entries(self, x: Array) -> Array:
        """As those of `Setting`; a cell, the first axis, is all near or not at all."""
        near = np.abs(x[..., 0].mean(axis=1) - self.x) < self.distance
        both = self.touched.entries(x), self.untouched.entries(x)
        return np.where(near[:, None, None], *both)

    def conductivity(self, x: Array) -> Array:
        """The same as tensors, (..., 3, 3)."""
        return self.entries(x)[..., [[0, 3, 4], [3, 1, 5], [4, 5, 2]]]

    def area_ratio(self, x: Array, normal: Array) -> Array:
        """Of the touched layer."""
        return self.touched.area_ratio(x, normal)


def print_left_out() -> None:
    """Errors of signals: far away left out, taken to first order; the tolerance's own."""
    sim = WAYS[0].simulator("fast")
    for distance in (0.030, 0.040, 0.050):
        left_out, linear = zip(*(_left_out(sim, s, distance) for s in _few()), strict=True)
        print(
            f"beyond {1e3 * distance:.0f} mm: left out {min(left_out):.1%} to {max(left_out):.1%} "
            f"off, to first order {min(linear):.2%} to {max(linear):.2%}"
        )
    errors = []
    for bend in (0.0, 30.0):
        some = [Scene(Bend(bend), scene.touches) for scene in scenes(WAYS[0], JUDGED, 3)]
        whole = sim.measure_all(some, EXACT)
        signal = whole - sim.measure(Scene(Bend(bend))).impedance
        missed = np.linalg.norm(sim.measure_all(some) - whole, axis=1)
        errors.append(missed / np.linalg.norm(signal, axis=1))
    print(f"default tolerance: {np.median(errors):.2%}, at most {np.max(errors):.2%} of a signal")


def _few() -> list[Scene]:
    """Presses of 10 N, three of the flat and three of the bent sensor."""
    places = [scene.touches[0] for scene in scenes(WAYS[0], 6, 3)]
    return [Scene(Bend(30.0 * (k // 3)), (Touch(t.x, t.y),)) for k, t in enumerate(places)]


def _left_out(sim: Simulator, scene: Scene, distance: float) -> tuple[float, float]:
    touched, untouched = sim.setting(scene), sim.setting(Scene(scene.bend))
    near = Near(touched, untouched, scene.touches[0].x, distance)
    both = (touched.conductivity, touched.area_ratio), (near.conductivity, near.area_ratio)
    whole, truncated = (sim.protocol.measure(sim.model.impedance(*each)) for each in both)
    solved = Reanalysis(sim.model, near, Tolerance(0.99, 0.99))  # type: ignore[arg-type]
    linear = sim.protocol.measure(solved.impedance(touched))
    size = np.linalg.norm(whole - sim.measure(Scene(scene.bend)).impedance)
    return tuple(float(np.linalg.norm(each - whole) / size) for each in (truncated, linear))  # type: ignore[return-value]


def recipe(frames: int, per_bend: int = PER_BEND) -> Recipe:
    """Single touches, as many to a bend."""
    group = SceneGroup("touch", frames, ANGLES, force=FORCES, per_bend=per_bend)
    return Recipe(name="rate", scenes=(group,), frames_per_shard=256)


def generation(frames: int) -> float:
    """Frames per second of a dataset, from the call to the manifest."""
    with tempfile.TemporaryDirectory() as folder:
        start = time.perf_counter()
        generate(recipe(frames), Path(folder) / "set", workers=PROCESSES)
        return frames / (time.perf_counter() - start)


def memory(frames: int) -> float:
    """Most memory that a worker used while it made a dataset [MB].

    Found in a process of its own: a system remembers the most that any child used.
    """
    run = subprocess.run(  # noqa: S603
        [sys.executable, "-m", __spec__.name, "--memory-of", str(frames)],
        capture_output=True,
        text=True,
        check=True,
    )
    return float(run.stdout)


def print_memory(frames: int) -> None:
    """What `memory` reads."""
    with tempfile.TemporaryDirectory() as folder:
        generate(recipe(frames), Path(folder) / "set", workers=1)
    print(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1e3)


def main() -> None:
    """Print the tables."""
    options = argparse.ArgumentParser(description="Scenes per second, with the error beside.")
    options.add_argument("--scenes", type=int, default=384, help="per way and process")
    options.add_argument("--only", nargs="*", help="names of ways")
    options.add_argument("--out", type=Path, help="table of the rates")
    options.add_argument("--memory-of", type=int, help="frames; print what memory that took")
    options.add_argument("--left-out", action="store_true", help="what reanalysis leaves out")
    chosen = options.parse_args()
    if chosen.left_out:
        print(Provenance.now(seed=3))
        print_left_out()
        return
    if chosen.memory_of:
        print_memory(chosen.memory_of)
        return
    print(Provenance.now(seed=0), f"\n{PROCESSES} processes of one thread each")
    found: list[Rate] = []
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(PROCESSES, context) as pool:
        for way in WAYS:
            if not chosen.only or way.name in chosen.only:
                found.append(rate(way, chosen.scenes, pool))
                print_rate(found[-1])
    if chosen.out and found:
        write_table(chosen.out, [asdict(one) for one in found], str(Provenance.now(0)))
    if not chosen.only:
        print_rest(found, chosen.scenes)


def print_rate(one: Rate) -> None:
    """One line."""
    print(
        f"{one.name:42} {one.scenes_per_second:6.1f} scenes/s  {one.scene_ms:6.1f} ms alone  "
        f"signal error {one.error_median:.1e}, at most {one.error_max:.1e}",
        flush=True,
    )


def print_rest(found: Sequence[Rate], count: int) -> None:
    """pyEIT, the floor, generation and memory."""
    if peer.is_installed():
        seconds, nodes = other()
        print(
            f"pyEIT, {nodes} nodes: {1e3 * seconds:.0f} ms a scene, "
            f"{1e3 * seconds / found[0].scene_ms:.0f} times as long as the first line"
        )
    total, least, seconds = operations()
    print(
        f"one reanalysed touch: {total / 1e6:.0f} million operations, at the rate of a large "
        f"product of matrices {1e3 * least:.1f} ms; it takes {1e3 * seconds:.1f} ms"
    )
    frames = 8 * count
    made = generation(frames)
    alone = next(one for one in found if one.name == JUMPING.name)
    print(
        f"{frames} frames as a dataset, hinge that jumps: {made:.0f} frames/s, "
        f"{made / alone.scenes_per_second:.0%} of the engine alone"
    )
    small, large = memory(count), memory(4 * count)
    print(f"memory: {small:.0f} MB for {count} frames, {large:.0f} MB for {4 * count}")


if __name__ == "__main__":
    main()
