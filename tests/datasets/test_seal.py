"""Lone shards: damage anywhere, files that harm HDF5, and files without a seal."""

import h5py
import numpy as np
import pytest

from eitskin.datasets import open_dataset, read_shard, save_dataset, verify, write_shard
from eitskin.datasets.store import manifest, shard_reader
from eitskin.datasets.store.shard import sealed, unsealed
from eitskin.errors import DataError

from small_dataset import assert_same, make


@pytest.fixture
def shard(tmp_path):
    path = tmp_path / "shard.h5"
    write_shard(path, make())
    return path


def test_damage_anywhere_in_a_lone_shard_is_noticed_before_hdf5_sees_it(shard, monkeypatch):
    monkeypatch.setattr(shard_reader.h5py.h5f, "open_file_image", None)
    whole, rng = shard.read_bytes(), np.random.default_rng(0)
    damaged = [whole[:4096] + bytes(4096) + whole[8192:], whole[:-1], whole + b"\0", whole[:-300]]
    for place in [*rng.integers(0, len(whole), 300), *range(len(whole) - 90, len(whole))]:
        flipped = bytearray(whole)
        flipped[place] ^= 1 << rng.integers(8)
        damaged.append(bytes(flipped))
    for content in damaged:
        shard.write_bytes(content)
        with pytest.raises(DataError, match="not a whole shard"):
            read_shard(shard)


def test_shards_without_a_seal_open_and_changes_by_other_programs_take_it_off(shard):
    whole = shard.read_bytes()
    image, was_sealed = unsealed(whole)
    assert was_sealed
    assert whole == sealed(image)
    shard.write_bytes(image)
    assert_same(read_shard(shard), make())
    shard.write_bytes(whole)
    with h5py.File(shard, "r+") as file:
        file["touch/force"][0, 0] = 3.0
    assert not unsealed(shard.read_bytes())[1]
    assert read_shard(shard).touch_force[0, 0] == 3.0


def looping(image):
    """Shard with zeros among its texts, of which HDF5 takes one of no length after the other."""
    start = image.index(b"GCOL") + 1024
    return image[:start] + bytes(512) + image[start + 512 :]


@pytest.mark.slow
def test_a_shard_that_harms_hdf5_harms_only_a_child(shard, monkeypatch):
    """The seal of somebody else tells nothing of what he meant."""
    monkeypatch.setattr(shard_reader, "SECONDS", 1)
    image, _ = unsealed(shard.read_bytes())
    shard.write_bytes(sealed(looping(image)))
    with pytest.raises(DataError, match="processor time"):
        read_shard(shard)


def large_claims():
    """Changes of a shard that make it claim gigabytes, each with the words of the refusal."""
    return {
        "stores 0": lambda file: file.create_dataset("x", (1 << 26,), "f8", chunks=(1 << 26,)),
        "larger than itself": lambda file: file.create_dataset(
            "x", data=np.zeros(4), chunks=(1 << 20,), maxshape=(None,), compression="gzip"
        ),
        "must be one number": lambda file: file.attrs.create("seed", np.zeros(4000)),
    }


def test_no_file_claims_more_than_it_holds(shard):
    whole = shard.read_bytes()
    for words, change in large_claims().items():
        shard.write_bytes(whole)
        with h5py.File(shard, "r+") as file:
            change(file)
        with pytest.raises(DataError, match=words):
            read_shard(shard)


def test_a_filter_used_twice_is_refused(shard):
    with h5py.File(shard, "r+") as file:
        properties = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        properties.set_chunk((40,))
        properties.set_deflate(9)
        properties.set_deflate(9)
        space = h5py.h5s.create_simple((40,))
        made = h5py.h5d.create(file.id, b"x", h5py.h5t.IEEE_F64LE, space, properties)
        made.write(h5py.h5s.ALL, h5py.h5s.ALL, np.zeros(40))
    with pytest.raises(DataError, match="filter twice"):
        read_shard(shard)


def test_shards_from_elsewhere_are_read_in_a_child_once(tmp_path, monkeypatch):
    monkeypatch.setenv("EITSKIN_CACHE", str(tmp_path / "mine"))
    tried = []
    monkeypatch.setattr(shard_reader, "contained", lambda *task: tried.append(task) or ())
    folder = tmp_path / "set"
    save_dataset(make(), folder, frames_per_shard=10)
    open_dataset(folder)
    assert not tried
    monkeypatch.setenv("EITSKIN_CACHE", str(tmp_path / "theirs"))
    open_dataset(folder)
    assert len(tried) == 4
    open_dataset(folder)
    assert len(tried) == 4
    monkeypatch.setenv("EITSKIN_CACHE", str(tmp_path / "others"))
    assert not verify(folder).damage
    open_dataset(folder)
    assert len(tried) == 8


def test_a_manifest_has_no_say_in_what_is_known(tmp_path, monkeypatch):
    save_dataset(make(), tmp_path / "set")
    path = tmp_path / "set" / "manifest.json"
    path.write_text(path.read_text().replace('"count"', '"known": true, "count"'))
    monkeypatch.setenv("EITSKIN_CACHE", str(tmp_path / "theirs"))
    assert not any(entry.known for entry in manifest.read_manifest(tmp_path / "set").shards)
