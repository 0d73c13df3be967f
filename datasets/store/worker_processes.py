"""Worker processes for tasks that read shards."""

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import TypeVar

from eitskin.errors import PartialError

_SMALL = 30_000_000  # bytes that one process checks in the second in which others start
Item = TypeVar("Item")
Result = TypeVar("Result")


def each_in_turn(
    task: Callable[[Item], Result], items: Sequence[Item], workers: int
) -> Iterator[Result]:
    """Results of `task` for each of `items`, in their order.

    Args:
        task: a function of a module, which worker processes can import.
        items: what `task` is called with.
        workers: number of processes; 1 is this process.

    Raises PartialError where a worker dies; an error of a task ends the others.
    """
    if workers == 1 or len(items) < 2:
        yield from map(task, items)
        return
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(min(workers, len(items)), context, initializer=_start_worker)
    try:
        yield from pool.map(task, items)
    except BrokenProcessPool as error:
        raise PartialError(
            "a worker process died. Look for lack of memory, or, in a script, for a missing "
            "if __name__ == '__main__'; then do it again with fewer workers"
        ) from error
    finally:
        pool.shutdown(cancel_futures=True)


def worthwhile(workers: int, files: Iterable[Path]) -> int:
    """Number of processes for reading `files`: 1 where starting them would take longer."""
    size = sum(path.stat().st_size for path in files if path.is_file())
    return workers if size > _SMALL else 1


def _start_worker() -> None:
    """Leave interrupts to the parent; end this process when the parent has ended."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=end_with_parent, daemon=True).start()


def end_with_parent() -> None:
    """End this worker process when its parent has ended, however that came about."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
