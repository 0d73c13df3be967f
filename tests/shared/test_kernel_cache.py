"""Compiled kernels on disk: whatever happened to the files, the kernel runs and is right."""

import errno
import os

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from eitskin.compiled import kernel

numba = pytest.importorskip("numba")


def sum_of_squares(x):
    total = 0.0
    for each in x:
        total += each * each
    return total


def from_disk():
    """Whether the code of the kernel, made anew and right, came from the disk."""
    made = kernel("float64(float64[::1])")(sum_of_squares)
    assert made(np.arange(4.0)) == 14.0
    return sum(made.stats.cache_hits.values()) == 1


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """Index and code of the kernel, with their contents."""
    folder = tmp_path_factory.mktemp("kernels")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(numba.config, "CACHE_DIR", str(folder))
        assert not from_disk()
        assert from_disk()
        files = [path for path in folder.rglob("*") if path.is_file()]
        assert len(files) == 2
        yield {path: path.read_bytes() for path in files}


@pytest.mark.slow
@settings(max_examples=10, deadline=None)
@given(st.data())
def test_a_file_cut_or_changed_anywhere_is_made_again(files, data):
    path = data.draw(st.sampled_from(sorted(files)))
    whole = files[path]
    place = data.draw(st.integers(0, len(whole) - 1))
    changed = whole[:place] + bytes([whole[place] ^ 1 << place % 8]) + whole[place + 1 :]
    path.write_bytes(data.draw(st.sampled_from([whole[:place], changed])))
    assert not from_disk()
    assert from_disk()


def test_a_full_disk_costs_no_more_than_another_compilation(monkeypatch, tmp_path):
    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(os, "replace", full)
    assert not from_disk()
    assert not from_disk()
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]
