"""What a dataset will cost, from a small measured part of it."""

import itertools
import os
import time
from dataclasses import dataclass
from pathlib import Path

from eitskin.datasets.generation.generate import free_bytes
from eitskin.datasets.generation.shard_simulation import prepare, simulate
from eitskin.datasets.recipe.recipe import Recipe
from eitskin.datasets.store.shard import shard_bytes

_FIRST_FRAMES = 16
_GROWTH = 4
_RUNS = 4
_ENOUGH_SECONDS = 1.0


@dataclass(frozen=True, slots=True)
class Estimate:
    """The cost of a dataset.

    Attributes:
        frames: of the whole set.
        shards: files.
        seconds: with the workers that were asked for, as far as this machine has cores for them.
        megabytes: on the disk.
        megabytes_free: on the disk now.
        measured_frames: on how many frames seconds and megabytes are founded.
    """

    frames: int
    shards: int
    seconds: float
    megabytes: float
    megabytes_free: float
    measured_frames: int


@dataclass(frozen=True, slots=True)
class _Part:
    """Some frames: how many, the time they took at first and other ones after them, their size."""

    frames: int
    first_seconds: float
    seconds: float
    size: int


def estimate(recipe: Recipe, out: str | Path, workers: int = 2) -> Estimate:
    """Make some frames of `recipe` in memory, and reckon from them; writes nothing.

    They are taken from all parts of the set: 16, then 64, then four times as many until they take
    a second. What a process does once (meshes, untouched specimens) counts once, the rest per
    frame; the second or two in which workers start is left out.

    Raises ConfigurationError for forces beyond reach.
    """
    prepare(recipe)
    most = max(len(recipe.shard_range(shard)) for shard in range(recipe.shards))
    parts = [_measure(recipe, min(_FIRST_FRAMES, most))]
    while parts[-1].frames < most and (len(parts) < 2 or parts[-1].seconds < _ENOUGH_SECONDS):
        parts.append(_measure(recipe, min(_GROWTH * parts[-1].frames, most)))
    last = parts[-1]
    once = max(0.0, parts[0].first_seconds - parts[0].seconds)
    at_once = min(workers, recipe.shards, os.cpu_count() or 1)
    return Estimate(
        frames=recipe.frames,
        shards=recipe.shards,
        seconds=once + recipe.frames * last.seconds / last.frames / at_once,
        megabytes=_size(recipe, parts) / 1e6,
        megabytes_free=free_bytes(Path(out)) / 1e6,
        measured_frames=last.frames,
    )


def _measure(recipe: Recipe, frames: int) -> _Part:
    """Make `frames`, then as many others, which find prepared what a process prepares once."""
    start = time.perf_counter()
    data = simulate(recipe, _spread(recipe, frames, 0.0))
    between = time.perf_counter()
    simulate(recipe, _spread(recipe, frames, 0.5))
    end = time.perf_counter()
    return _Part(frames, between - start, end - between, len(shard_bytes(data)))


def _spread(recipe: Recipe, frames: int, shift: float) -> list[int]:
    """Numbers of `frames` frames: runs, which share bends as in a shard, from the whole set."""
    runs = min(_RUNS, frames)
    edges = [frames * run // runs for run in range(runs + 1)]
    numbers: list[int] = []
    for run, (start, stop) in enumerate(itertools.pairwise(edges)):
        first = int((run + shift) * recipe.frames / runs)
        first = min(first, recipe.frames - (stop - start))
        numbers.extend(range(first, first + stop - start))
    return numbers


def _size(recipe: Recipe, parts: list[_Part]) -> float:
    """Bytes of all shards: a share for each file and one for each frame."""
    last = parts[-1]
    if len(parts) == 1:
        return recipe.frames * last.size / last.frames
    per_frame = (last.size - parts[-2].size) / (last.frames - parts[-2].frames)
    per_file = last.size - last.frames * per_frame
    return recipe.shards * per_file + recipe.frames * per_frame
