"""Shards made in the process of the test, where it is not processes that are tried."""

import threading
from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest

from eitskin.datasets import Recipe, generate
from eitskin.datasets.generation import generate as generation
from eitskin.datasets.store.manifest import ShardEntry
from eitskin.threads import one_thread

_one_at_a_time = threading.Lock()  # simulators are shared


def make_shards(
    recipe: Recipe,
    folder: Path,
    shards: Sequence[int],
    workers: int,  # noqa: ARG001
    scheduler: str | None,  # noqa: ARG001
) -> Iterator[tuple[int, ShardEntry]]:
    """As that of `generate`, without the second that each worker takes to load."""
    for shard in shards:
        with _one_at_a_time, one_thread():  # as in workers, on whose sums bytes depend
            entry = generation.make_shard(recipe, folder, shard)
        yield shard, entry


def in_this_process(monkeypatch):
    """Let `generate` make shards here."""
    monkeypatch.setattr(generation, "make_shards", make_shards)


def made_here(recipe: Recipe, folder: Path) -> Path:
    """The folder of a set made in this process."""
    with pytest.MonkeyPatch.context() as patch:
        in_this_process(patch)
        generate(recipe, folder)
    return folder


def contents(folder: Path) -> dict[str, bytes]:
    """Every file of a folder by name."""
    return {path.name: path.read_bytes() for path in folder.iterdir()}
