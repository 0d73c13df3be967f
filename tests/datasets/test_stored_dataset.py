"""Large datasets, whose columns are read when they are first used."""

import copy
import dataclasses
import hashlib
import json

import h5py
import numpy as np
import pytest

from eitskin.datasets import open_dataset, save_dataset
from eitskin.datasets.store import folder as folders
from eitskin.errors import ConfigurationError, DataError

from small_dataset import assert_same, make
from version_one import save_version_one


@pytest.fixture
def data():
    return make(50, specimens=5, specimen=np.arange(50) // 10)


@pytest.fixture
def folder(tmp_path, data, monkeypatch):
    monkeypatch.setattr(folders, "READ_AT_ONCE", 0)
    save_dataset(data, tmp_path / "set", frames_per_shard=12)
    return tmp_path / "set"


def test_use_reads_labels_together_and_other_columns_when_they_are_asked_for(folder, data):
    passes = []
    found = open_dataset(folder, lambda *counts: passes.append(counts))
    assert (len(found), found.channels, found.recipe) == (50, 28, data.recipe)
    assert found.bytes_per_frame == data.bytes_per_frame
    assert passes == []
    assert np.array_equal(found.state, data.state)
    assert found.time is found.time
    assert passes == [(number, 5) for number in range(1, 6)]
    found.read("impedance", "status")
    assert len(passes) == 10
    assert_same(found, data)
    assert len(passes) == 15  # the touch references


@pytest.mark.slow
def test_all_methods_answer_as_those_of_a_dataset_in_memory(folder, data, tmp_path):
    assert_same(open_dataset(folder), data)
    for chosen in (slice(3, 40, 5), [45, 2, 2, -1], data.state == 1, []):
        assert_same(open_dataset(folder).select(chosen), data.select(chosen))
    found = open_dataset(folder)
    assert_same(found.own_specimens(), data)
    assert np.array_equal(found.touch_count, data.touch_count)
    assert np.array_equal(found.frame(7).impedance, data.frame(7).impedance)
    for mine, other in zip(found.split((0.6, 0.4)), data.split((0.6, 0.4)), strict=True):
        assert np.array_equal(mine, other)
    assert_same(copy.deepcopy(found), data)
    changed = dataclasses.replace(found, seed=8)
    assert (changed.seed, len(changed.select([1, 2]))) == (8, 2)
    save_version_one(data, tmp_path / "old", frames_per_shard=12)
    assert_same(open_dataset(tmp_path / "old"), data)
    assert "50 frames" in repr(found)
    with pytest.raises(AttributeError):
        found.impedances  # noqa: B018


def test_damage_is_found_when_the_shard_is_read(folder):
    whole = (folder / "shard-000003.h5").read_bytes()
    found = open_dataset(folder)
    assert len(found.state) == 50
    (folder / "shard-000003.h5").write_bytes(whole[:-1] + b"?")
    with pytest.raises(DataError, match=r"shard-000003\.h5.*SHA-256"):
        found.select([49, 40])
    with pytest.raises(DataError, match=r"shard-000003\.h5.*SHA-256"):
        _ = found.impedance
    (folder / "shard-000003.h5").write_bytes(whole)
    assert len(found.impedance) == 50
    (folder / "shard-000001.h5").unlink()
    with pytest.raises(DataError, match=r"shard-000001\.h5"):
        _ = found.status
    with pytest.raises(DataError, match=r"shard-000001\.h5.*manifest"):
        open_dataset(folder)


def changed(folder, number, change):
    """A shard after `change` of its open file, to which the manifest has been made to agree."""
    path = folder / f"shard-00000{number}.h5"
    with h5py.File(path, "r+") as file:
        change(file)
    manifest = json.loads((folder / "manifest.json").read_text())
    manifest["shards"][number]["sha256"] = hashlib.sha256(path.read_bytes()).hexdigest()
    (folder / "manifest.json").write_text(json.dumps(manifest))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda file: file.attrs.__setitem__("seed", 8), "not made together"),
        (lambda file: file["reference"].__setitem__(0, 1.0), "reference of a specimen"),
        (lambda file: file["state"].__setitem__(0, 9), "shard-000002.*states must be"),
    ],
)
def test_shards_of_other_datasets_are_refused(folder, change, message):
    changed(folder, 2, change)
    found = open_dataset(folder)
    for _ in range(2):  # not only the first time
        with pytest.raises(DataError, match=message):
            _ = found.state


def test_columns_beyond_the_memory_are_refused(folder, monkeypatch):
    found = open_dataset(folder)
    monkeypatch.setattr(folders.os, "sysconf", lambda _: 90)  # 8,100 bytes
    assert len(found.state) == 50
    with pytest.raises(ConfigurationError, match="read_shards"):
        _ = found.impedance
