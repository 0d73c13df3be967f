"""Workers in the middle of a solution that takes minutes, or that die."""

import os
import time
from pathlib import Path

from eitskin.datasets.store.manifest import ShardEntry
from eitskin.datasets.store.shard import shard_name


def slow_but_first(_recipe, folder: Path, shard: int) -> ShardEntry:
    """Stands in for the task of a process pool: shard 0 is there at once, the others are not."""
    if shard:
        time.sleep(60.0)
    (folder / shard_name(shard)).touch()
    return ShardEntry(shard_name(shard), 0, 1, "")


def die(_recipe, _folder: Path, _shard: int) -> None:
    """Stands in for the task of a process pool: the process ends."""
    os._exit(1)
