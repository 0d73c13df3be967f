"""Processes in which tables are solved."""

import multiprocessing
import signal
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eitskin.errors import PartialError
from eitskin.threads import one_thread_per_process


@contextmanager
def processes(workers: int) -> Iterator[Callable[..., Iterable[Any]]]:
    """Map over arguments in this process, or in several; raises PartialError where one dies."""
    if workers == 1:
        yield map
        return
    context = multiprocessing.get_context("spawn")
    try:
        with (
            one_thread_per_process(),
            ProcessPoolExecutor(workers, context, _end_at_interrupt) as pool,
        ):
            yield pool.map
    except BrokenProcessPool as error:
        raise PartialError(
            "a process died while tables were solved. Look for lack of memory, or, in a script, "
            "for a missing if __name__ == '__main__'; then run it again"
        ) from error


def _end_at_interrupt() -> None:
    """Let Ctrl-C end this process at once, which would go on with the next table otherwise."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def solved_places(
    solve: Callable[[float], tuple[NDArray[np.float64], NDArray[np.float64]]],
    places: Sequence[float],
    report: Callable[[int, int], None] | None,
    workers: int,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Fields and sinkings of presses at every place, in its order.

    Args:
        solve: of one place, coefficients (...,) of the fields and sinkings (...,) [m].
        places: distances [m].
        report: called with the number of places done and their total.
        workers: processes.
    """
    fields, sunk = [], []
    with processes(workers) as run:
        for coefficients, below in run(solve, places):
            fields.append(coefficients)
            sunk.append(below)
            if report:
                report(len(fields), len(places))
    return np.array(fields), np.array(sunk)
