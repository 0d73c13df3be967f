"""Datasets written anew in other shards."""

import errno
import os
from pathlib import Path

import numpy as np
import pytest

from eitskin.datasets import compact, open_dataset, read_shard, save_dataset, verify
from eitskin.datasets.store import worker_processes
from eitskin.errors import ConfigurationError, DataError, PartialError

from shards_here import contents
from small_dataset import assert_same, make
from version_one import save_version_one


@pytest.fixture
def data():
    return make(47, specimens=5, specimen=np.arange(47) // 10)


@pytest.mark.slow
def test_a_set_of_version_one_becomes_one_of_version_two(tmp_path, data):
    cut, counts = 20, [20, 20, 7]
    folder, seen = save_version_one(data, tmp_path / "old", frames_per_shard=12), []
    manifest = compact(folder, tmp_path / "new", cut, lambda *counts: seen.append(counts))
    assert manifest.format_version == 2
    assert [entry.count for entry in manifest.shards] == counts
    assert seen == [(number + 1, len(counts)) for number in range(len(counts))]
    assert_same(open_dataset(tmp_path / "new"), data)
    assert verify(tmp_path / "new").damage == ()
    last = read_shard(tmp_path / "new" / manifest.shards[-1].name)
    assert last.specimen_number.tolist() == sorted({*(data.specimen[-counts[-1] :].tolist())})


def test_shards_may_be_kept_as_they_are_cut(tmp_path, data):
    save_dataset(data, tmp_path / "direct", frames_per_shard=12)
    save_version_one(data, tmp_path / "old", frames_per_shard=12)
    compact(tmp_path / "old", tmp_path / "new", None)
    assert contents(tmp_path / "new") == contents(tmp_path / "direct")


@pytest.mark.slow
def test_bytes_do_not_depend_on_the_workers(tmp_path, data, monkeypatch):
    monkeypatch.setattr(worker_processes, "_SMALL", 0)
    save_dataset(data, tmp_path / "set", frames_per_shard=5)
    for workers in (1, 2):
        compact(tmp_path / "set", tmp_path / f"by-{workers}", 12, workers=workers)
    assert contents(tmp_path / "by-1") == contents(tmp_path / "by-2")
    (tmp_path / "by-1" / "shard-000001.h5").write_bytes(b"rubbish")
    one, other = (verify(tmp_path / "by-1", workers=workers) for workers in (1, 2))
    assert one == other
    assert (one.shards, one.frames) == (3, 35)
    with pytest.raises(DataError, match=r"shard-000001\.h5"):
        compact(tmp_path / "by-1", tmp_path / "again", workers=2)


def test_damage_and_occupied_folders_are_refused_and_nothing_counts_as_complete(tmp_path, data):
    save_dataset(data, tmp_path / "set", frames_per_shard=12)
    with pytest.raises(ConfigurationError, match="not empty"):
        compact(tmp_path / "set", tmp_path / "set")
    with pytest.raises(ConfigurationError, match="frames_per_shard"):
        compact(tmp_path / "set", tmp_path / "new", 0)
    (tmp_path / "set" / "shard-000002.h5").write_bytes(b"rubbish")
    with pytest.raises(DataError, match=r"shard-000002\.h5.*SHA-256"):
        compact(tmp_path / "set", tmp_path / "new", 12)
    assert [path.name for path in tmp_path.iterdir()] == ["set"]


def test_an_interrupt_or_a_full_disk_leaves_nothing(tmp_path, data, monkeypatch):
    save_dataset(data, tmp_path / "set", frames_per_shard=12)

    def interrupt(done, _total):
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        compact(tmp_path / "set", tmp_path / "new", 12, interrupt)
    assert [path.name for path in tmp_path.iterdir()] == ["set"]
    write, room = Path.write_bytes, iter(range(3))

    def full(path, content):
        if next(room, None) is None:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return write(path, content)

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(PartialError, match=r"new: No space left.*compact again"):
        compact(tmp_path / "set", tmp_path / "new", 12)
    assert [path.name for path in tmp_path.iterdir()] == ["set"]
