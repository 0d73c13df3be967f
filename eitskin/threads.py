"""Threads of linear algebra, of which the solvers use one.

On products of small matrices more threads wait for each other longer than they work.
"""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache

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


@contextmanager
def one_thread_per_process() -> Iterator[None]:
    """Limit processes started meanwhile to one thread of linear algebra each.

    More threads would compete for the cores, and sums would depend on the number of threads.
    """
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
