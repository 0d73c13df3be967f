"""Cost estimate of a dataset: time and size, from a small measured part."""

import itertools
import math
import os
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from eitskin.datasets.generation.generate import free_bytes
from eitskin.datasets.generation.preparation import prepare, solved_frames
from eitskin.datasets.generation.shard_simulation import flat_impedance, simulate_frames
from eitskin.datasets.recipe.frame_sampling import instrument, sample, specimen, specimen_numbers
from eitskin.datasets.recipe.recipe import Recipe
from eitskin.datasets.store.shard import shard_bytes

_FIRST_FRAMES = 16
_FIRST_SOLVED = 2  # where touches are solved in 3D, in about a minute each
_GROWTH = 4
_RUNS = 4
_ENOUGH_SECONDS, _LONG_SECONDS = 1.0, 10.0


@dataclass(frozen=True, slots=True)
class CostEstimate:
    """Estimated cost of a dataset.

    Attributes:
        frames: number of frames.
        shards: number of files.
        seconds: with the given number of workers, as far as this machine has cores for them.
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


@dataclass(frozen=True, slots=True)
class _Trial:
    """Measured part of a dataset.

    Attributes:
        frames: number of frames.
        first_seconds: of a first run, in which everything is new.
        seconds: of a second run, for as many other frames of flat, solved specimens.
        specimen_seconds: for each flat specimen.
        size: of a shard [bytes].
    """

    frames: int
    first_seconds: float
    seconds: float
    specimen_seconds: float
    size: int


def estimate_cost(recipe: Recipe, out: str | Path, workers: int = 2) -> CostEstimate:
    """Cost of `recipe`, extrapolated from some frames simulated in memory; writes nothing.

    The frames come from all parts of the dataset: 16, then 64, then four times as many until a run
    takes a second. Work done once per process counts once, untouched specimens once for each shard
    in which they occur, the rest per frame; the one or two seconds in which workers start are
    neglected.

    Args:
        recipe: of the dataset.
        out: folder of the dataset, for the free space.
        workers: number of processes.

    Raises ConfigurationError for forces beyond the reach of the presses.
    """
    prepare(recipe, workers=workers)
    most = max(len(recipe.shard_range(shard)) for shard in range(recipe.shards))
    first = _FIRST_SOLVED if solved_frames(recipe) else _FIRST_FRAMES
    trials = [_run_trial(recipe, min(first, most))]
    while trials[-1].frames < most and _is_short(trials):
        trials.append(_run_trial(recipe, min(_GROWTH * trials[-1].frames, most)))
    last = trials[-1]
    once = max(0.0, trials[0].first_seconds - trials[0].seconds)
    shards = (specimen_numbers(recipe, recipe.shard_range(n)) for n in range(recipe.shards))
    flat = last.specimen_seconds * sum(map(len, shards))
    at_once = min(workers, recipe.shards, os.cpu_count() or 1)
    return CostEstimate(
        frames=recipe.frames,
        shards=recipe.shards,
        seconds=once + (recipe.frames * last.seconds / last.frames + flat) / at_once,
        megabytes=_size(recipe, trials) / 1e6,
        megabytes_free=free_bytes(Path(out)) / 1e6,
        measured_frames=last.frames,
    )


def _is_short(trials: Sequence[_Trial]) -> bool:
    """Whether a further trial is worth its time: a second one unless the first took long."""
    few = trials[0].frames < _FIRST_FRAMES
    first = _LONG_SECONDS if few else math.inf
    return trials[-1].seconds < (first if len(trials) < 2 else _ENOUGH_SECONDS)


def _run_trial(recipe: Recipe, frames: int) -> _Trial:
    """Time of a first run with `frames` frames, and of a second run with as many others.

    A long first run of few frames, beside which work done once counts little, is not repeated.
    """
    start = time.perf_counter()
    data = simulate_frames(recipe, _frame_numbers(recipe, frames, 0.0))
    first = time.perf_counter()
    if frames < _FIRST_FRAMES and first - start > _LONG_SECONDS:
        return _Trial(frames, first - start, first - start, 0.0, len(shard_bytes(data)))
    others = _frame_numbers(recipe, frames, 0.5)
    specimens = {sample(recipe, index).specimen for index in others}
    for number in specimens:
        flat_impedance(specimen(recipe, number), recipe, instrument(recipe, number))
    solved = time.perf_counter()
    simulate_frames(recipe, others)
    end = time.perf_counter()
    each = (solved - first) / len(specimens)
    return _Trial(frames, first - start, end - solved, each, len(shard_bytes(data)))


def _frame_numbers(recipe: Recipe, frames: int, shift: float) -> list[int]:
    """Numbers of `frames` frames: runs with shared bends, as in a shard, over the whole set."""
    runs = min(_RUNS, frames)
    edges = [frames * run // runs for run in range(runs + 1)]
    numbers: list[int] = []
    for run, (start, stop) in enumerate(itertools.pairwise(edges)):
        first = int((run + shift) * recipe.frames / runs)
        first = min(first, recipe.frames - (stop - start))
        numbers.extend(range(first, first + stop - start))
    return numbers


def _size(recipe: Recipe, trials: list[_Trial]) -> float:
    """Size of all shards [bytes]: a part for each file and a part for each frame."""
    last = trials[-1]
    if len(trials) == 1:
        return recipe.frames * last.size / last.frames
    per_frame = (last.size - trials[-2].size) / (last.frames - trials[-2].frames)
    per_file = last.size - last.frames * per_frame
    return recipe.shards * per_file + recipe.frames * per_frame
