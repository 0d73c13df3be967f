"""Worker processes that read shards: order, errors, Ctrl-C."""

import os
import signal
import threading
import time
from concurrent.futures import ProcessPoolExecutor

import pytest

from eitskin.datasets.store import worker_processes
from eitskin.datasets.store.worker_processes import run_tasks
from eitskin.errors import PartialError

pytestmark = pytest.mark.slow


def test_results_come_in_order_and_an_error_of_a_task_is_raised():
    assert list(run_tasks(abs, [-3, 2, -1], 0)) == [(-3, 3), (2, 2), (-1, 1)]
    results = run_tasks(len, ["three", "to", 5, "four"], 2)
    assert [next(results), next(results)] == [("three", 5), ("to", 2)]
    with pytest.raises(TypeError):
        next(results)
    with pytest.raises(PartialError, match="fewer workers"):
        list(run_tasks(os._exit, [1, 1, 1], 2))


@pytest.fixture
def heard():
    """SIGINT is heard also where the tests run in the background of a shell, which ignores it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


class InterruptedAgain(ProcessPoolExecutor):
    """A pool during whose end Ctrl-C is pressed again; from a thread it might come too late."""

    ended = False

    def shutdown(self, *arguments, **options):
        os.kill(os.getpid(), signal.SIGINT)
        super().shutdown(*arguments, **options)
        InterruptedAgain.ended = True


@pytest.mark.usefixtures("heard")
def test_an_interrupt_ends_tasks_that_would_take_long_once_and_leaves_no_process(monkeypatch):
    """As Ctrl-C twice: the second interrupt does not disturb the end."""
    monkeypatch.setattr(worker_processes, "ProcessPoolExecutor", InterruptedAgain)
    before = signal.getsignal(signal.SIGINT)
    results = run_tasks(time.sleep, [0.0, 600.0, 600.0], 2)
    assert next(results) == (0.0, None)
    threading.Timer(0.1, os.kill, (os.getpid(), signal.SIGINT)).start()
    start = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        next(results)
    assert time.monotonic() - start < 10
    assert InterruptedAgain.ended
    assert signal.getsignal(signal.SIGINT) is before
