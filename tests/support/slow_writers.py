"""Workers in the middle of a solution that takes minutes, or that die."""

import os
import time
from pathlib import Path


def slow_but_first(_recipe, _folder: Path, shard: int) -> None:
    """Stands in for the task of a process pool: shard 0 is there at once, the others are not."""
    if shard:
        time.sleep(60.0)


def die(_recipe, _folder: Path, _shard: int) -> None:
    """Stands in for the task of a process pool: the process ends."""
    os._exit(1)
