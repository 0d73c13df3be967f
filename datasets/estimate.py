"""What a dataset will cost, from a small measured part of it."""

import dataclasses
import os
import time
from dataclasses import dataclass
from pathlib import Path

from eitskin.datasets.generate import free_bytes
from eitskin.datasets.recipe import Recipe
from eitskin.datasets.shard import shard_bytes
from eitskin.datasets.simulated import prepare, simulate_shard

_FIRST_FRAMES = 16
_GROWTH = 4
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
    """A small shard: its number of frames, the time it took anew and once more, its size."""

    frames: int
    first_seconds: float
    seconds: float
    size: int


def estimate(recipe: Recipe, out: str | Path, workers: int = 2) -> Estimate:
    """Make the first frames of `recipe` in memory, and reckon from them; writes nothing.

    Parts of 16 frames and more are made until one takes a second. What a process does once
    (meshes, untouched specimens) counts once, the rest per frame.

    Raises ConfigurationError for forces beyond reach.
    """
    prepare(recipe)
    parts = [_measure(recipe, min(_FIRST_FRAMES, recipe.frames_per_shard, recipe.frames))]
    while parts[-1].seconds < _ENOUGH_SECONDS:
        frames = min(_GROWTH * parts[-1].frames, recipe.frames_per_shard, recipe.frames)
        if frames == parts[-1].frames:
            break
        parts.append(_measure(recipe, frames))
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
    """Make the first two shards of `frames` each, as far as there are two."""
    small = dataclasses.replace(recipe, frames_per_shard=frames)
    start = time.perf_counter()
    data = simulate_shard(small, 0)
    between = time.perf_counter()
    again = simulate_shard(small, 1 if small.shards > 2 else 0)
    end = time.perf_counter()
    return _Part(len(again), between - start, end - between, len(shard_bytes(data)))


def _size(recipe: Recipe, parts: list[_Part]) -> float:
    """Bytes of all shards: a share for each file and one for each frame."""
    last = parts[-1]
    if len(parts) == 1:
        return recipe.frames * last.size / last.frames
    per_frame = (last.size - parts[-2].size) / (last.frames - parts[-2].frames)
    per_file = last.size - last.frames * per_frame
    return recipe.shards * per_file + recipe.frames * per_frame
