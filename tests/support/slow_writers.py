"""Workers in the middle of a solution that takes minutes."""

import time
from pathlib import Path


def slow_but_first(_recipe, _folder: Path, shard: int) -> int:
    """Stands in for the task of a process pool: shard 0 is there at once, the others are not."""
    if shard:
        time.sleep(60.0)
    return shard
