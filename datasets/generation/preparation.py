"""Preparation of a dataset: tables of presses and bends that its recipe needs, and its cost."""

import dataclasses
import os
import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from eitskin.datasets.generation.shard_simulation import flat_impedance, simulate_frames
from eitskin.datasets.recipe.frame_sampling import instrument, sample, specimen, specimen_numbers
from eitskin.datasets.recipe.recipe import Recipe
from eitskin.datasets.recipe.scene_group import SceneGroup
from eitskin.datasets.recipe.specimen import Specimen, free_length
from eitskin.datasets.store.shard import shard_bytes
from eitskin.geometry.deformation.fixtures import Clamp, FreeArc
from eitskin.geometry.design.sensor import SensorDesign, Support
from eitskin.simulator.bends.bend_table import bend_problems, bend_table
from eitskin.simulator.bends.pressed_plates import PlateBend, held_by_plates
from eitskin.simulator.deformation.press_table import press_problems, press_table
from eitskin.simulator.deformation.sensor_grid import SensorGrid
from eitskin.simulator.deformation.solution_store import Problem, missing
from eitskin.simulator.deformation.solution_store import prepare as solve_missing
from eitskin.simulator.deformation.tabled_corrections import (
    correction_problems,
    corrections,
    is_tabulable,
)
from eitskin.simulator.mechanics.layer_stack import Mechanics
from eitskin.simulator.scene.indenters import Cylinder, Footprint
from eitskin.simulator.scene.scene import AnyIndenter

Progress = Callable[[int, int], None]
_Pressed = tuple[SensorDesign, Mechanics, AnyIndenter, SensorGrid]
_OnPlates = tuple[PlateBend, SceneGroup]

_ALL = 48  # specimens up to which none is left out
_LEVELS = 6  # values of each property for which a specimen is taken


def missing_tables(recipe: Recipe, specimens: Sequence[int] | None = None) -> set[Path]:
    """Paths of the tables of bends and presses that `prepare` would solve."""
    return {path for problems, _ in _stages(recipe, specimens) for path in missing(problems)}


def solved_frames(recipe: Recipe) -> int:
    """Largest number of frames whose touches are solved in 3D, as no tables are made for them."""

    def is_solved(support: Support | None, indenter: AnyIndenter | None = None) -> bool:
        sensor = dataclasses.replace(recipe.sensor, support=support or recipe.sensor.support)
        return isinstance(indenter, Footprint) or not is_tabulable(sensor)

    touched = [group for group in recipe.scenes if group.state == "touch"]
    frames = sum(group.frames for group in touched if is_solved(group.support, group.indenter))
    episodes = [episode for episode in recipe.episodes if episode.largest_force]
    if is_solved(None):
        frames += sum(episode.count * episode.frames for episode in episodes)
    return frames


def prepare(
    recipe: Recipe,
    progress: Progress | None = None,
    workers: int = 1,
    specimens: Sequence[int] | None = None,
) -> None:
    """Solve the tables that specimens share, and check the recipe's forces and bends on them.

    `progress` is called with the numbers of solved bends or presses and of all in the tables that
    are being solved. Specimens are `deciding_specimens` when omitted: others find their tables
    solved, and one that needs another table solves it when it is simulated. Raises
    ConfigurationError for forces or bends out of reach on one of the specimens.
    """
    for problems, check in _stages(recipe, specimens):
        solve_missing(problems, progress, workers)
        check()


def _stages(
    recipe: Recipe, specimens: Sequence[int] | None
) -> Iterator[tuple[list[Problem], Callable[[], None]]]:
    """Tables to solve in turn, and checks of the recipe on each of these stages."""
    specimens = deciding_specimens(recipe) if specimens is None else specimens
    clamped = list(_clamped_designs(recipe, specimens))

    def check_bends(clamps: list[tuple[SensorDesign, Clamp, Mechanics, SensorGrid]]) -> None:
        for bent in clamps:
            for angle in recipe.extreme_angles:
                bend_table(*bent).check(angle)

    def check_presses(sensors: list[_Pressed], force: float) -> None:
        for sensor in sensors:
            press_table(*sensor).dent_from_force(force)

    def check_depths(sensors: list[_Pressed], held: list[_OnPlates], force: float) -> None:
        for sensor in filter(lambda each: is_tabulable(each[0]), sensors):
            corrections(*sensor).check_depth(press_table(*sensor).dent_from_force(force).depth)
        for plates, group in held:
            table = press_table(plates.design, plates.mechanics, group.touch_indenter, plates.grid)
            depth = table.dent_from_force(group.force[1]).depth
            for x in _nearest_to_gap(group, plates.design.outline.length):
                plates.check(group.touch_indenter, x, depth)

    for some in (clamped[:1], clamped[1:]):  # bends out of reach are reported after the first table
        yield [p for bent in some for p in bend_problems(*bent)], partial(check_bends, some)
    groups = [group for group in recipe.scenes if group.state == "touch"]
    pairs = bool(recipe.episodes) or any(max(group.touches) > 1 for group in groups)
    for indenter, force in _indenters(recipe).items():
        sensors = list(_pressed_designs(recipe, indenter, specimens))
        held = list(_on_plates(recipe, indenter, specimens))
        dents = [problem for sensor in sensors for problem in press_problems(*sensor)]
        around = [problem for each in sensors for problem in correction_problems(*each, pairs)]
        yield dents, partial(check_presses, sensors, force)
        yield around, partial(check_depths, sensors, held, force)
        yield [each.problem(indenter) for each, _ in held], lambda: None


def _indenters(recipe: Recipe) -> dict[AnyIndenter, float]:
    """Indenters that have tables, each with the largest force of its touches [N]."""
    indenters: dict[AnyIndenter, float] = {}
    groups = [
        (group.touch_indenter, group.force[1]) for group in recipe.scenes if group.state == "touch"
    ]
    episodes = [(Cylinder(), each.largest_force) for each in recipe.episodes if each.largest_force]
    for indenter, force in (*groups, *episodes):
        if not isinstance(indenter, Footprint):
            indenters[indenter] = max(force, indenters.get(indenter, 0.0))
    return indenters


@lru_cache(maxsize=4)
def deciding_specimens(recipe: Recipe) -> tuple[int, ...]:
    """Numbers of the specimens that decide which tables are needed, and what is within reach.

    Few specimens all decide. Among many, those do that are nearest to evenly spaced values, from
    the least to the largest, of a property on which tables depend: the time spent on tables does
    not grow with the number of specimens of one mount.
    """
    count = recipe.specimens.count
    if count <= _ALL:
        return tuple(range(count))
    properties = np.array([_properties(specimen(recipe, number)) for number in range(count)])
    chosen = set(range(min(recipe.mounts.count, count)))  # every mount has tables of its own
    for values in properties.T:
        levels = np.linspace(values.min(), values.max(), _LEVELS)
        chosen.update(int(np.abs(values - level).argmin()) for level in levels)
    return tuple(sorted(chosen))


def _properties(specimen_numbers: Specimen) -> tuple[float, ...]:
    """Properties of a specimen on which its tables and the depth of its presses depend."""
    fixture, height = specimen_numbers.fixture, np.log(specimen_numbers.design.thickness)
    gel = np.log(specimen_numbers.mechanics.gel.shear_modulus)
    around = np.log(specimen_numbers.mechanics.encapsulation.shear_modulus)
    offset = 0.0 if isinstance(fixture, FreeArc) else fixture.offset
    # Depth over thickness depends on force over modulus times thickness squared.
    soft = (gel + 2.0 * height, around + 2.0 * height, gel + around + 4.0 * height)
    return (height, around - gel, free_length(fixture), offset, *soft)


def _clamped_designs(
    recipe: Recipe, specimens: Sequence[int] | None
) -> Iterator[tuple[SensorDesign, Clamp, Mechanics, SensorGrid]]:
    """Designs, clamps, materials and grids of specimens on all supports on which clamps bend."""
    supports = [group.support for group in recipe.scenes if any(group.angle_deg)]
    supports += [None for episode in recipe.episodes if any(episode.angles_deg)]
    for supported in _on_supports(recipe, specimens, supports):
        if isinstance(supported.fixture, Clamp):
            yield supported.design, supported.fixture, supported.mechanics, supported.grid


def _pressed_designs(
    recipe: Recipe, indenter: AnyIndenter, specimens: Sequence[int] | None
) -> Iterator[_Pressed]:
    """Designs, materials and grids of specimens on all supports on which the indenter presses."""
    touched = [group for group in recipe.scenes if group.state == "touch"]
    supports: list[Support | None] = []
    if recipe.episodes and indenter == Cylinder():
        supports.append(None)
    supports += [group.support for group in touched if group.touch_indenter == indenter]
    for supported in _on_supports(recipe, specimens, supports):
        yield supported.design, supported.mechanics, indenter, supported.grid


def _on_plates(
    recipe: Recipe, indenter: AnyIndenter, specimens: Sequence[int] | None
) -> Iterator[_OnPlates]:
    """Specimens on plates at the extreme angles of the groups in which the indenter presses."""
    for group in recipe.scenes:
        if group.state == "touch" and group.touch_indenter == indenter:
            for supported in _on_supports(recipe, specimens, [group.support]):
                for angle in dict.fromkeys(group.angle_deg):
                    fixed = supported.design, supported.fixture, supported.mechanics, supported.grid
                    if (plates := held_by_plates(*fixed, angle)) is not None:
                        yield plates, group


def _nearest_to_gap(group: SceneGroup, length: float) -> list[float]:
    """Places of a group's touches along the sensor, the one nearest to its middle at least [m]."""
    if group.positions:
        return [x for x, _ in group.positions]
    return [0.5 * length + (group.from_middle[0] if group.from_middle else 0.0)]


def _on_supports(
    recipe: Recipe, specimens: Sequence[int] | None, supports: Sequence[Support | None]
) -> Iterator[Specimen]:
    """Specimens on each of the supports, where None is their own."""
    if supports:
        for number in deciding_specimens(recipe) if specimens is None else specimens:
            made = specimen(recipe, number)
            for support in dict.fromkeys(each or made.design.support for each in supports):
                design = dataclasses.replace(made.design, support=support)
                yield dataclasses.replace(made, design=design)


_FIRST_FRAMES = 16
_FIRST_SOLVED = 2  # where touches are solved in 3D, in about a minute each
_GROWTH = 4
_RUNS = 4
_ENOUGH_SECONDS, _LONG_SECONDS = 0.5, 10.0


def free_bytes(folder: Path) -> int:
    """Free space on the disk of `folder`, which need not exist [bytes]."""
    existing = next(path for path in (folder, *folder.absolute().parents) if path.is_dir())
    return shutil.disk_usage(existing).free


@dataclass(frozen=True, slots=True)
class CostEstimate:
    """Estimated cost of a dataset.

    Attributes:
        frames: number of frames.
        shards: number of files.
        seconds: seconds with the given number of workers, as far as this machine has cores for
            them.
        megabytes: size on the disk.
        megabytes_free: free space on the disk now.
        measured_frames: number of frames measured for `seconds` and `megabytes`.
    """

    frames: int
    shards: int
    seconds: float
    megabytes: float
    megabytes_free: float
    measured_frames: int


class _Trial(NamedTuple):
    """Measured part of a dataset: frames, seconds, of each flat specimen as well, size [bytes]."""

    frames: int
    seconds: float
    specimen_seconds: float
    size: int


def estimate_cost(recipe: Recipe, out: str | Path, workers: int = 2) -> CostEstimate:
    """Cost of `recipe`, extrapolated from some frames simulated in memory; writes nothing.

    The frames come from all parts of the dataset: 16, then 64, then four times as many until a run
    takes half a second. Work done once per process counts once, untouched specimens once for each
    shard in which they occur, the rest per frame; the one or two seconds in which workers start are
    neglected. Raises ConfigurationError for forces beyond the reach of the presses.
    """
    prepare(recipe, workers=workers)
    most = max(len(recipe.shard_range(shard)) for shard in range(recipe.shards))
    slow = bool(solved_frames(recipe))
    frames = min(_FIRST_SOLVED if slow else _FIRST_FRAMES, most)
    trials = [_run_trial(recipe, frames)]  # in which everything is new
    if not (slow and trials[0].seconds > _LONG_SECONDS):  # next to which that counts little
        trials.append(_run_trial(recipe, frames, again=True))
        while trials[-1].seconds < _ENOUGH_SECONDS and frames < most:
            frames = min(_GROWTH * frames, most)
            trials.append(_run_trial(recipe, frames, again=True))
    first, last = trials[0], trials[-1]
    grown = last.frames - first.frames
    per_frame = (last.size - first.size) / grown if grown else last.size / last.frames
    per_file = last.size - last.frames * per_frame
    once = max(0.0, trials[0].seconds - trials[min(1, len(trials) - 1)].seconds)
    shards = (specimen_numbers(recipe, recipe.shard_range(n)) for n in range(recipe.shards))
    flat = last.specimen_seconds * sum(map(len, shards))
    at_once = min(workers, recipe.shards, os.cpu_count() or 1)
    return CostEstimate(
        frames=recipe.frames,
        shards=recipe.shards,
        seconds=once + (recipe.frames * last.seconds / last.frames + flat) / at_once,
        megabytes=(recipe.shards * per_file + recipe.frames * per_frame) / 1e6,
        megabytes_free=free_bytes(Path(out)) / 1e6,
        measured_frames=last.frames,
    )


def _run_trial(recipe: Recipe, frames: int, again: bool = False) -> _Trial:
    """Time of `frames` frames; where it is done `again`, of others, after their flat specimens."""
    numbers = _frame_numbers(recipe, frames, 0.5 if again else 0.0)
    start = time.perf_counter()
    specimens = {sample(recipe, index).specimen for index in numbers} if again else set()
    for number in specimens:
        flat_impedance(specimen(recipe, number), recipe, instrument(recipe, number))
    solved = time.perf_counter()
    data = simulate_frames(recipe, numbers)
    each = (solved - start) / max(len(specimens), 1)
    return _Trial(frames, time.perf_counter() - solved, each, len(shard_bytes(data)))


def _frame_numbers(recipe: Recipe, frames: int, shift: float) -> list[int]:
    """Numbers of `frames` frames: runs with shared bends, as in a shard, over the whole set."""
    runs = np.array_split(np.arange(frames), min(_RUNS, frames))
    firsts = ((np.arange(len(runs)) + shift) * recipe.frames / len(runs)).astype(int).tolist()
    starts = [min(n, recipe.frames - len(run)) for n, run in zip(firsts, runs, strict=True)]
    return [start + k for start, run in zip(starts, runs, strict=True) for k in range(len(run))]
