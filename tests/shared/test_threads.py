"""Threads of linear algebra."""

import os

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from eitskin.threads import one_thread, one_thread_per_process


def test_the_environment_of_processes_is_as_before(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    monkeypatch.delenv("OPENBLAS_NUM_THREADS", raising=False)
    with one_thread_per_process():
        assert os.environ["OMP_NUM_THREADS"] == os.environ["OPENBLAS_NUM_THREADS"] == "1"
    assert os.environ["OMP_NUM_THREADS"] == "7"
    assert "OPENBLAS_NUM_THREADS" not in os.environ


def test_linear_algebra_has_one_thread_while_it_is_limited() -> None:
    def threads() -> set[int]:
        found = threadpool_info()
        return {each["num_threads"] for each in found if each["user_api"] == "blas"}

    np.ones((2, 2)) @ np.ones((2, 2))
    with threadpool_limits(2):
        before = threads()
        with one_thread():
            assert threads() == {1}
        assert one_thread()(threads)() == {1}
        assert threads() == before
