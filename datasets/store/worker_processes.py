"""Tasks in worker processes of this machine, or on the workers of a dask cluster."""

import multiprocessing
import os
import signal
import socket
import threading
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import CancelledError, Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from functools import partial
from multiprocessing.synchronize import Event
from pathlib import Path
from typing import Any, TypeAlias, TypeVar
from urllib.parse import urlsplit

from eitskin.datasets.store.shard import PACKAGES
from eitskin.errors import ConfigurationError, PartialError
from eitskin.extras import require
from eitskin.provenance import package_versions
from eitskin.threads import one_thread, one_thread_per_process

CONNECT_SECONDS = 10
WORKERS_SECONDS = 60
_SMALL = 30_000_000  # bytes that one process checks in the second in which others start
Item = TypeVar("Item")
Result = TypeVar("Result")
_Workers: TypeAlias = tuple[Callable[..., Any], type[Exception], Callable[[], bool]]
"""Submission, error of a task whose worker died, and whether any worker has begun."""


def run_tasks(
    task: Callable[[Item], Result],
    items: Sequence[Item],
    workers: int,
    scheduler: str | None = None,
    remedy: str = "do it again with fewer workers",
) -> Generator[tuple[Item, Result], None, None]:
    """Items with their results of `task`, in their order but for those of workers that died.

    Workers end at once, in the middle of a task, on Ctrl-C, and where the iterator is closed: a
    file that is half written keeps its temporary name. Each has one thread of linear algebra.

    Args:
        task: a function of a module, which workers can import.
        items: arguments that `task` is called with.
        workers: number of processes of this machine; one or none runs the tasks in this process.
        scheduler: address of a dask.distributed scheduler, for its workers instead.
        remedy: end of the message where workers died.

    Raises PartialError where workers died twice with the same tasks, or the scheduler goes away;
    ConfigurationError where the scheduler has no workers, or they have other packages.
    """
    if workers <= 1 and scheduler is None:
        for item in items:
            with one_thread():
                result = task(item)
            yield item, result
        return
    leave_worker_that_starts()
    left = list(items)
    for _ in range(2):  # tasks of workers that died, perhaps by the machine's fault, get a second
        lost = []
        started = _on_cluster(scheduler) if scheduler else _in_pool(min(workers, len(left) or 1))
        with started as (submit, died, have_begun):
            futures = [submit(task, item) for item in left]
            for item, future in zip(left, futures, strict=True):
                try:
                    result = future.result()
                except died:
                    lost.append(item)
                    continue
                except CancelledError as error:
                    raise PartialError(
                        f"the dask scheduler at {scheduler} went away, and tasks are left; start "
                        f"it again, then {remedy}"
                    ) from error
                yield item, result
        if not (left := lost):
            return
        if not have_begun():
            raise ConfigurationError(
                "workers cannot begin, since they import this script, and would run it again: "
                "begin what it does by if __name__ == '__main__':, in a file, or choose workers=1, "
                "which works in this process"
            )
    raise PartialError(
        f"workers died twice, {len(left)} of {len(items)} tasks are left. Look for lack of memory; "
        f"then {remedy}"
    )


def leave_worker_that_starts() -> None:
    """End this process where it is a worker that imports a script without a main guard.

    The script would start workers of workers, and each of them would say so at length.
    """
    if getattr(multiprocessing.current_process(), "_inheriting", False):
        raise SystemExit(1)


def worthwhile(workers: int, files: Iterable[Path]) -> int:
    """Number of processes for reading `files`: 0 where starting them would take longer."""
    size = sum(path.stat().st_size for path in files if path.is_file())
    return workers if size > _SMALL and workers > 1 else 0


# Processes of this machine


@contextmanager
def _in_pool(workers: int) -> Iterator[_Workers]:
    """Submission to new processes, and the error of a task whose process died."""
    others = set(multiprocessing.active_children())
    context = multiprocessing.get_context("spawn")
    started = context.Event()
    with (
        _one_interrupt(),
        one_thread_per_process(),
        ProcessPoolExecutor(workers, context, _begin, (started,)) as pool,
    ):

        def submit(task: Callable[[Any], Any], item: Any) -> "Future[Any]":
            try:
                with _interrupts_held_back():  # workers start here and inherit the blocked signal
                    return pool.submit(task, item)
            except BrokenProcessPool as error:
                broken: Future[Any] = Future()
                broken.set_exception(error)
                return broken

        try:
            yield submit, BrokenProcessPool, started.is_set
        except BaseException:
            for process in set(multiprocessing.active_children()) - others:
                process.kill()
            pool.shutdown(wait=True, cancel_futures=True)
            raise


@contextmanager
def _one_interrupt() -> Iterator[None]:
    """Let Ctrl-C be raised once; a second one would separate the pool from its workers."""

    def interrupt(number: int, frame: object) -> None:  # noqa: ARG001
        signal.signal(signal.SIGINT, signal.SIG_IGN)
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
def _interrupts_held_back() -> Iterator[None]:
    """Block Ctrl-C; processes started meanwhile never receive it."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _begin(started_event: Event) -> None:
    """Say that this worker has begun; end it, from a thread, when its parent has ended."""
    started_event.set()

    def wait() -> None:
        if parent := multiprocessing.parent_process():
            parent.join()
            os._exit(1)

    threading.Thread(target=wait, daemon=True).start()


# Workers of a cluster


def check_scheduler(address: str) -> None:
    """Raise ConfigurationError unless a server answers at `address`, ImportError without dask."""
    require("distributed", "cluster")
    try:
        url = urlsplit(address)
        if url.scheme not in ("tcp", "tls") or not url.hostname or not url.port:
            raise ValueError("expected tcp://HOST:PORT")
        socket.create_connection((url.hostname, url.port), CONNECT_SECONDS).close()
    except (OSError, ValueError) as error:
        raise ConfigurationError(
            f"no dask scheduler answers at '{address}': {error}; start one with 'dask scheduler' "
            "and give the address that it prints, such as tcp://127.0.0.1:8786"
        ) from error


@contextmanager
def _on_cluster(address: str) -> Iterator[_Workers]:
    """Submission to the workers at `address`, and the error of a task whose workers all died."""
    distributed = require("distributed", "cluster")
    with distributed.Client(address, timeout=CONNECT_SECONDS, set_as_default=False) as client:
        try:
            client.wait_for_workers(1, timeout=WORKERS_SECONDS)
        except TimeoutError as error:
            raise ConfigurationError(
                f"the dask scheduler at {address} has no workers; start some with "
                f"'dask worker {address} --nthreads 1'"
            ) from error
        # Not pure: results are files, of which the scheduler knows nothing.
        submit = partial(client.submit, _run_on_worker, package_versions(PACKAGES), pure=False)
        yield submit, distributed.KilledWorker, lambda: True


# Simulators, and the limit on BLAS threads, are shared by all threads of a worker process.
_one_at_a_time = threading.Lock()


def _run_on_worker(
    versions: Mapping[str, str], task: Callable[[Item], Result], item: Item
) -> Result:
    """Run a task on a worker of a cluster."""
    worker_versions = package_versions(PACKAGES)
    if worker_versions != versions:
        raise ConfigurationError(
            f"a dask worker has other packages, so its numbers would differ: expected {versions}, "
            f"got {worker_versions}; install the same on all machines"
        )
    # More BLAS threads would compete for the cores, and sums would depend on their number.
    with _one_at_a_time, one_thread():
        return task(item)
