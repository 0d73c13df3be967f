"""Cost estimate of a dataset: time and size, from a small measured part."""

import itertools
import os
import time
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
    """Measured part of a dataset: frames, seconds, of each flat specimen beside, size [bytes]."""

    frames: int
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
    slow = bool(solved_frames(recipe))
    frames = min(_FIRST_SOLVED if slow else _FIRST_FRAMES, most)
    trials = [_run_trial(recipe, frames)]  # in which everything is new
    if not (slow and trials[0].seconds > _LONG_SECONDS):  # beside which that counts little
        trials.append(_run_trial(recipe, frames, again=True))
        while trials[-1].seconds < _ENOUGH_SECONDS and frames < most:
            frames = min(_GROWTH * frames, most)
            trials.append(_run_trial(recipe, frames, again=True))
    last = trials[-1]
    once = max(0.0, trials[0].seconds - trials[min(1, len(trials) - 1)].seconds)
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
    fewer = next((each for each in trials if each.frames < last.frames), None)
    if fewer is None:
        return recipe.frames * last.size / last.frames
    per_frame = (last.size - fewer.size) / (last.frames - fewer.frames)
    per_file = last.size - last.frames * per_frame
    return recipe.shards * per_file + recipe.frames * per_frame
