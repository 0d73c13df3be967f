"""Shards: round trips, equal bytes, damage, hostile files, full disks."""

import errno
import json
import os
import re
from concurrent.futures import ThreadPoolExecutor

import h5py
import numpy as np
import pytest

from eitskin.datasets import (
    UNKNOWN_STATE,
    Dataset,
    open_dataset,
    read_shard,
    read_shards,
    save_dataset,
    write_shard,
)
from eitskin.datasets.store.schema import FIELDS, FORMAT_VERSION
from eitskin.datasets.store.shard import shard_bytes, unsealed
from eitskin.errors import DataError, PartialError

from small_dataset import assert_same, make
from version_one import as_version_one, save_version_one

NEWER = FORMAT_VERSION + 1


@pytest.fixture
def shard(tmp_path):
    path = tmp_path / "shard.h5"
    write_shard(path, make())
    return path


# Round trips


def test_everything_comes_back(shard):
    assert_same(read_shard(shard), make())


def test_what_is_unknown_comes_back_as_unknown(tmp_path):
    data = Dataset.from_arrays(np.arange(12.0).reshape(3, 4) + 1)
    write_shard(tmp_path / "s.h5", data)
    again = read_shard(tmp_path / "s.h5")
    assert_same(again, data)
    assert again.protocol is None
    assert again.design is None
    assert (again.state == UNKNOWN_STATE).all()
    assert np.isnan(again.touch_reference).all()
    assert np.isnan(again.bend_angle_deg).all()
    assert np.array_equal(again.reference, data.impedance[:1])


def test_files_from_before_frames_had_numbers_count_them(tmp_path):
    write_shard(tmp_path / "s.h5", make(5), first_index=40)
    as_version_one(tmp_path / "s.h5", make(5))
    with h5py.File(tmp_path / "s.h5", "r+") as file:
        del file["number"]
    assert read_shard(tmp_path / "s.h5").number.tolist() == [40, 41, 42, 43, 44]


def test_folder_of_several_shards_comes_back_as_one(tmp_path):
    manifest = save_dataset(make(50), tmp_path / "set", frames_per_shard=20)
    assert [entry.count for entry in manifest.shards] == [20, 20, 10]
    assert_same(open_dataset(tmp_path / "set"), make(50))


def test_a_shard_holds_only_its_own_specimens(tmp_path):
    data = make(40, specimens=8, specimen=np.arange(40) // 5)
    save_dataset(data, tmp_path / "set", frames_per_shard=20)
    part = read_shard(tmp_path / "set" / "shard-000001.h5")
    assert part.specimen_number.tolist() == [4, 5, 6, 7]
    assert part.specimen.tolist() == (np.arange(20) // 5).tolist()
    assert np.array_equal(part.reference, data.reference[4:])
    assert_same(open_dataset(tmp_path / "set"), data)
    lone = data.select([17])
    write_shard(tmp_path / "one.h5", lone)
    assert read_shard(tmp_path / "one.h5").specimen_number.tolist() == [3]


def test_sets_of_version_one_are_read_alike(tmp_path):
    data = make(40, specimens=8, specimen=np.arange(40) // 5)
    save_version_one(data, tmp_path / "set", frames_per_shard=20)
    assert len(read_shard(tmp_path / "set" / "shard-000001.h5").reference) == 8
    assert_same(open_dataset(tmp_path / "set"), data)
    assert [len(part) for part in read_shards(tmp_path / "set")] == [20, 20]


def test_bytes_do_not_depend_on_when_python_lets_go_of_objects(monkeypatch):
    expected, kept = shard_bytes(make()), []
    create, find = h5py.Group.create_dataset, h5py.Group.__getitem__

    def keep(made):
        kept.append(made)
        return made

    monkeypatch.setattr(
        h5py.Group, "create_dataset", lambda *given, **named: keep(create(*given, **named))
    )
    monkeypatch.setattr(h5py.Group, "__getitem__", lambda *given: keep(find(*given)))
    assert shard_bytes(make()) == expected
    assert len(kept) > 13


@pytest.mark.slow
def test_threads_do_not_disturb_each_other():
    with ThreadPoolExecutor(8) as pool:
        assert len(set(pool.map(lambda _number: shard_bytes(make(600)), range(32)))) == 1


def test_file_describes_itself(shard):
    with h5py.File(shard) as file:
        assert file.attrs["format"] == "eitskin-dataset"
        assert file.attrs["format_version"] == FORMAT_VERSION
        assert (file.attrs["first_index"], file.attrs["count"], file.attrs["seed"]) == (0, 40, 7)
        assert json.loads(file.attrs["packages"])["numpy"] == np.__version__
        assert h5py.check_enum_dtype(file["state"].dtype) == {
            "idle": 0,
            "touch": 1,
            "bend": 2,
            "unknown": 255,
        }
        for path in (*(field.path for field in FIELDS), "protocol"):
            stored = file[path]
            assert stored.attrs["units"]
            assert stored.attrs["description"]
            assert (stored.compression, stored.shuffle, stored.fletcher32) == ("gzip", True, True)
            assert all(dimension.label for dimension in stored.dims)
        assert file["impedance"].dims[0][0] == file["time"]
        assert set(file) == {f.path.split("/")[0] for f in FIELDS} | {"protocol"}


# Damage and hostility


def flipped(content, bit, places):
    for place in places:
        yield content[:place] + bytes([content[place] ^ bit]) + content[place + 1 :]


def test_flipped_bytes_are_noticed_everywhere_or_without_a_manifest_in_values(shard, tmp_path):
    save_dataset(make(), tmp_path / "set")
    path, rng = tmp_path / "set" / "shard-000000.h5", np.random.default_rng(0)
    whole = path.read_bytes()
    for path_content in flipped(whole, 0x10, rng.integers(0, len(whole), 100)):
        path.write_bytes(path_content)
        with pytest.raises(DataError, match="SHA-256"):
            open_dataset(tmp_path / "set")
    with h5py.File(shard) as file:
        chunk = file["impedance"].id.get_chunk_info(0)
    places = chunk.byte_offset + rng.integers(0, chunk.size, 50)
    for broken in flipped(unsealed(shard.read_bytes())[0], 0x01, places):
        shard.write_bytes(broken)
        with pytest.raises(DataError, match="make or copy"):
            read_shard(shard)


def test_chunks_that_a_flipped_bit_would_leave_compressed_are_refused(shard):
    """The list of filters has another type; a chunk lies elsewhere, or is marked as raw."""
    whole, _ = unsealed(shard.read_bytes())
    pipeline = bytes.fromhex("0b00500001000000")  # type of message, size, flags
    places = [place for place in range(len(whole)) if whole[place : place + 8] == pipeline]
    assert len(places) >= len(FIELDS) - 1
    for broken in flipped(whole, 0x10, places):
        shard.write_bytes(broken)
        with pytest.raises(DataError, match="damaged"):
            read_shard(shard)
    for tree in re.finditer(b"TREE\x01\x00\x01\x00", whole):  # then two addresses and the first key
        for bit in (0x01, 0x20):
            place = tree.end() + 16 + 8
            shard.write_bytes(next(flipped(whole, bit, [place])))
            with pytest.raises(DataError, match=r"damaged|not a whole shard"):
                read_shard(shard)
    shard.write_bytes(whole)
    with h5py.File(shard, "r+") as file:
        raw = np.zeros((40, 28), "u1").tobytes()
        file["status"].id.write_direct_chunk((0, 0), raw, filter_mask=7)
    with pytest.raises(DataError, match=r"'status'.*damaged"):
        read_shard(shard)


@pytest.mark.parametrize("length", [0, 100, 5000, -1])
def test_cut_files_are_refused(shard, length):
    shard.write_bytes(shard.read_bytes()[:length])
    with pytest.raises(DataError, match="not a whole shard"):
        read_shard(shard)


def replace(file, name, **options):
    del file[name]
    return file.create_dataset(name, **options)


def attribute(name, value):
    return lambda file: file.attrs.__setitem__(name, value)


def value(name, place, bad):
    return lambda file: file[name].__setitem__(place, bad)


def other(name, **options):
    return lambda file: replace(file, name, **options)


def link(name, target):
    def provoke(file):
        file.pop(name, None)
        file[name] = target or file["/"]

    return provoke


def virtual(file):
    del file["time"]
    layout = h5py.VirtualLayout(shape=(40,), dtype="f8")
    layout[:] = h5py.VirtualSource("other.h5", "time", shape=(40,))
    file.create_virtual_dataset("time", layout)


TEXT = {"data": np.array(["a"] * 40, dtype=object), "dtype": h5py.string_dtype()}
OUTSIDE = {"shape": (40,), "dtype": "f8", "external": [("/etc/hostname", 0, 320)]}
FILTERED = {"data": np.zeros(40), "chunks": (40,), "scaleoffset": 3}


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (attribute("format_version", NEWER), f"version {NEWER} is newer .* upgrade"),
        (attribute("format", "something"), "'eitskin-dataset', got 'something'"),
        (lambda file: file.attrs.__delitem__("format"), r"'eitskin-dataset'.*None"),
        (attribute("recipe", "forged"), r"recipe.*checksum"),
        (attribute("count", 2**40), "expected at most"),
        (lambda file: file.pop("touch/x"), "not a whole shard"),
        (lambda file: file.pop("specimen_number"), "not a whole shard"),
        (value("specimen_number", 0, 1), r"specimen_number must rise.*\[1 1\]"),
        (value("specimen_number", 1, 2**16), r"specimen_number.* below 65536"),
        (other("time", data=np.zeros(3)), r"'time'.*\(40,\), got \(3,\)"),
        (other("impedance", data=np.ones((40, 28))), r"'impedance'.*complex64, got float64"),
        (other("time", **TEXT), r"'time'.*float64.*object"),
        (value("impedance", (3, 4), np.nan), r"impedance.*finite.*frame 3"),
        (value("state", 0, 9), r"states.*got \[9\]"),
        (value("specimen", 0, 2), r"specimen 2.*reference"),
        (value("touch/x", (0, 0), np.nan), r"touch_x.*touch_y"),
        (link("time", h5py.ExternalLink("other.h5", "/time")), "link"),
        (link("time", h5py.SoftLink("/bend_angle_deg")), "link"),
        (link("touch/x", h5py.ExternalLink("other.h5", "/x")), "link"),
        (link("touch/again", None), "virtual"),
        (other("time", **OUTSIDE), "virtual"),
        (virtual, "virtual"),
        (other("time", **FILTERED), "uses filter"),
    ],
)
def test_files_that_the_format_does_not_allow_are_refused(shard, damage, message):
    with h5py.File(shard, "r+") as file:
        damage(file)
    with pytest.raises(DataError, match=message) as caught:
        read_shard(shard)
    assert str(shard) in str(caught.value)


def test_a_huge_claim_costs_no_memory(shard):
    with h5py.File(shard, "r+") as file:
        file.attrs["count"] = 2**20
        for field in FIELDS:
            if field.axes[0] == "frame":
                shape = (2**20, *file[field.path].shape[1:])
                if field.name in ("impedance", "touch_reference", "status"):
                    shape = (2**20, 4096)
                replace(file, field.path, shape=shape, dtype=field.dtype, chunks=True)
    with pytest.raises(DataError, match="fewer than any compression"):
        read_shard(shard)


def test_unfinished_and_absent_datasets_say_what_to_do(tmp_path, shard):
    shard.rename(tmp_path / "shard-000000.h5")
    with pytest.raises(DataError, match=r"1 finished shards .*--resume"):
        open_dataset(tmp_path)
    with pytest.raises(DataError, match="eitskin generate"):
        open_dataset(tmp_path / "absent")


# Disks


def test_full_disk_leaves_the_old_file_and_nothing_else(tmp_path, shard, monkeypatch):
    before = shard.read_bytes()

    def full(_handle):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(PartialError, match=r"shard\.h5: No space left.*--resume") as caught:
        write_shard(shard, make(60))
    assert caught.value.exit_code == 5
    assert shard.read_bytes() == before
    assert list(tmp_path.iterdir()) == [shard]
