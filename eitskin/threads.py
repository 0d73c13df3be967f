"""Threads of linear algebra, of which the solvers use one.

On products of small matrices more threads wait for each other longer than they work.
"""

import os
import warnings
from collections.abc import Iterator, Sized
from contextlib import contextmanager
from functools import lru_cache
from multiprocessing import resource_tracker

from threadpoolctl import ThreadpoolController

from eitskin.extras import require

_LIMITS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")


@contextmanager
def one_thread() -> Iterator[None]:
    """Limit linear algebra in this process to one thread; serves as a decorator too."""
    with _controller().limit(limits=1):
        yield


@contextmanager
def one_torch_thread() -> Iterator[None]:
    """Limit torch in this process to one thread, on which small networks are faster too."""
    torch = require("torch", "training")
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


@lru_cache(maxsize=1)
def _controller() -> ThreadpoolController:
    return ThreadpoolController()


@lru_cache(maxsize=1)
def _forgive_killed_tracker() -> None:
    """Let a run succeed in silence though Python's tracker of semaphores was killed.

    The next one knows none of those before, and would print an error for each that is released.
    """
    warnings.filterwarnings("ignore", "resource_tracker: process died", UserWarning)
    release = resource_tracker.unregister

    def register_first(name: Sized, rtype: str) -> None:
        resource_tracker.register(name, rtype)  # twice is as good as once
        release(name, rtype)

    resource_tracker.unregister = register_first


@contextmanager
def one_thread_per_process() -> Iterator[None]:
    """Limit processes started meanwhile to one thread of linear algebra each.

    More threads would compete for the cores, and sums would depend on the number of threads.
    """
    _forgive_killed_tracker()
    before = {name: os.environ.get(name) for name in _LIMITS}
    os.environ.update(dict.fromkeys(_LIMITS, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
