"""Process pool: shards simulated by worker processes on this machine."""

import ctypes
import multiprocessing
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path

from eitskin.datasets.generation.shard_simulation import simulate_shard
from eitskin.datasets.recipe.recipe import Recipe
from eitskin.datasets.store.shard import shard_name, write_shard
from eitskin.datasets.store.worker_processes import (
    end_with_parent,
    interrupts_held_back,
    one_interrupt,
)
from eitskin.threads import one_thread_per_process

_GRACE = 1.0  # for workers to end by themselves after Ctrl-C [s]; a scene may take minutes


def make_shards(
    recipe: Recipe,
    folder: Path,
    shards: Sequence[int],
    workers: int,
    report: Callable[[int], None],
) -> list[int]:
    """Simulate `shards` of `recipe` into `folder` with `workers` processes.

    Calls `report` with the number of each finished shard. Returns the numbers of shards that were
    lost because a worker died.
    """
    context = multiprocessing.get_context("spawn")
    # Shared memory without a lock, which a killed process could hold for ever.
    stop = context.RawValue(ctypes.c_bool, False)
    lost = set(shards)
    with (
        one_interrupt(stop),
        one_thread_per_process(),
        ProcessPoolExecutor(
            min(workers, len(shards)), context, initializer=_start_worker, initargs=(stop,)
        ) as pool,
    ):
        try:
            with interrupts_held_back():  # workers start here and inherit the blocked signal
                futures = [pool.submit(pool_task, recipe, folder, shard) for shard in shards]
            for future in as_completed(futures):
                if isinstance(future.exception(), BrokenProcessPool):
                    continue
                lost.remove(future.result())
                report(future.result())
        except BrokenProcessPool:  # from submit
            pass
        except BaseException:
            stop.value = True
            # Waits here, where further interrupts are swallowed: after a shutdown without waiting,
            # an interrupt could separate the pool from its workers.
            pool.shutdown(wait=True, cancel_futures=True)
            raise
    return sorted(lost)


# From here on: code that runs in a worker.

_stop: ctypes.c_bool | None = None


class _Stopped(Exception):  # noqa: N818 - it is no error
    """Raised in a worker when the parent has asked for the end."""


def _start_worker(stop: ctypes.c_bool) -> None:
    """Keep the flag `stop`, which the parent sets; end soon after that, or with the parent."""
    global _stop  # noqa: PLW0603 - the one way to reach tasks from a pool's initializer
    _stop = stop
    end_with_parent(stop, _GRACE)


def pool_task(recipe: Recipe, folder: Path, shard: int) -> int:
    """Simulate and write `shard`; returns its number."""
    data = simulate_shard(recipe, shard, before_solve=_check_stop)
    write_shard(folder / shard_name(shard), data, recipe.shard_range(shard).start)
    return shard


def _check_stop() -> None:
    if _stop is not None and _stop.value:
        raise _Stopped
