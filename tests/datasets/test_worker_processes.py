"""Worker processes that read shards: order, errors, Ctrl-C."""

import os

import pytest

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
