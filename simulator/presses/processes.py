"""Processes in which tables are solved."""

import multiprocessing
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from typing import Any

from eitskin.errors import PartialError


@contextmanager
def processes(workers: int) -> Iterator[Callable[..., Iterable[Any]]]:
    """Map over arguments in this process, or in several; raises PartialError where one dies."""
    if workers == 1:
        yield map
        return
    context = multiprocessing.get_context("spawn")
    try:
        with ProcessPoolExecutor(workers, mp_context=context) as pool:
            yield pool.map
    except BrokenProcessPool as error:
        raise PartialError(
            "a process died while tables were solved. Look for lack of memory, or, in a script, "
            "for a missing if __name__ == '__main__'; then run it again"
        ) from error
