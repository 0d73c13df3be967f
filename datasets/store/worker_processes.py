"""Worker processes for tasks that read shards."""

import ctypes
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

from eitskin.errors import PartialError

_SMALL = 30_000_000  # bytes that one process checks in the second in which others start
_POLL = 0.1  # [s]
Item = TypeVar("Item")
Result = TypeVar("Result")


def each_in_turn(
    task: Callable[[Item], Result], items: Sequence[Item], workers: int
) -> Generator[Result, None, None]:
    """Results of `task` for each of `items`, in their order.

    Args:
        task: a function of a module, which worker processes can import.
        items: what `task` is called with.
        workers: number of processes; 1 is this process.

    Workers end at once, in the middle of a task, on Ctrl-C, and where the iterator is closed.
    Raises PartialError where a worker dies; an error of a task ends the others.
    """
    if workers == 1 or len(items) < 2:
        yield from map(task, items)
        return
    context = multiprocessing.get_context("spawn")
    stop = context.RawValue(ctypes.c_bool, False)
    with (
        one_interrupt(stop),
        ProcessPoolExecutor(
            min(workers, len(items)), context, initializer=_start_worker, initargs=(stop,)
        ) as pool,
    ):
        try:
            with interrupts_held_back():  # workers start here and inherit the blocked signal
                results = pool.map(task, items)
            yield from results
        except BaseException as error:
            stop.value = True
            pool.shutdown(cancel_futures=True)  # further interrupts are swallowed meanwhile
            if not isinstance(error, BrokenProcessPool):
                raise
            raise PartialError(
                "a worker process died. Look for lack of memory, or, in a script, for a missing "
                "if __name__ == '__main__'; then do it again with fewer workers"
            ) from error


def worthwhile(workers: int, files: Iterable[Path]) -> int:
    """Number of processes for reading `files`: 1 where starting them would take longer."""
    size = sum(path.stat().st_size for path in files if path.is_file())
    return workers if size > _SMALL else 1


@contextmanager
def one_interrupt(stop: ctypes.c_bool) -> Iterator[None]:
    """Let Ctrl-C set `stop` and be raised once; a second one would disturb the shutdown."""

    def interrupt(number: int, frame: object) -> None:  # noqa: ARG001
        if not stop.value:
            stop.value = True
            raise KeyboardInterrupt

    # Only the main thread may set a signal handler, and only the main thread is interrupted.
    before = signal.getsignal(signal.SIGINT)
    ours = threading.current_thread() is threading.main_thread() and callable(before)
    if ours:
        signal.signal(signal.SIGINT, interrupt)
    try:
        yield
    finally:
        if ours:
            signal.signal(signal.SIGINT, before)


@contextmanager
def interrupts_held_back() -> Iterator[None]:
    """Block Ctrl-C; processes started meanwhile never receive it."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def end_with_parent(stop: ctypes.c_bool, grace: float) -> None:
    """End this worker process `grace` seconds after `stop` is set, or when its parent has ended.

    The process ends in the middle of its work: a file that is half written keeps its temporary
    name.
    """
    threading.Thread(target=_end_with_parent, daemon=True).start()
    threading.Thread(target=_end_when_stopped, args=(stop, grace), daemon=True).start()


def _start_worker(stop: ctypes.c_bool) -> None:
    end_with_parent(stop, grace=0.0)


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _end_when_stopped(stop: ctypes.c_bool, grace: float) -> None:
    while not stop.value:
        time.sleep(_POLL)
    time.sleep(grace)
    os._exit(1)
