"""Shards: round trips, equal bytes, damage that is found, hostile files, full disks."""

import dataclasses
import hashlib
import json
import os
import re

import h5py
import numpy as np
import pytest

from eitskin.datasets import (
    UNKNOWN_STATE,
    Dataset,
    open_dataset,
    read_shard,
    save_dataset,
    verify,
    write_shard,
)
from eitskin.datasets.store import folder as folders
from eitskin.datasets.store import shard_reader
from eitskin.datasets.store.schema import FIELDS, FORMAT_VERSION
from eitskin.datasets.store.shard import append_checksum, shard_bytes, verify_checksum
from eitskin.errors import DataError

from small_dataset import assert_same, make

NEWER = FORMAT_VERSION + 1


@pytest.fixture
def shard(tmp_path):
    path = tmp_path / "shard.h5"
    write_shard(path, make())
    return path


# Round trips


UNKNOWN = Dataset.from_arrays(np.arange(12.0).reshape(3, 4) + 1)


@pytest.mark.parametrize("data", [make(), UNKNOWN], ids=["all known", "values alone"])
def test_a_shard_brings_everything_back(tmp_path, data):
    write_shard(tmp_path / "shard.h5", data)
    assert_same(read_shard(tmp_path / "shard.h5"), data)
    assert (data.state == UNKNOWN_STATE).all() == (data is UNKNOWN)


def test_a_shard_describes_itself_and_loses_its_seal_by_changes_of_others(shard):
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
    whole = shard.read_bytes()
    image, was_sealed = verify_checksum(whole)
    assert was_sealed
    assert whole == append_checksum(image)
    shard.write_bytes(image)
    assert_same(read_shard(shard), make())
    shard.write_bytes(whole)
    with h5py.File(shard, "r+") as file:
        file["touch/force"][0, 0] = 3.0
    assert not verify_checksum(shard.read_bytes())[1]
    assert read_shard(shard).touch_force[0, 0] == 3.0


# Damage and hostility


def flipped(content, bit, places):
    for place in places:
        yield content[:place] + bytes([content[place] ^ bit]) + content[place + 1 :]


@pytest.mark.slow
def test_chunks_that_a_flipped_bit_would_leave_compressed_are_refused(shard):
    """The list of filters has another type; a chunk lies elsewhere, or is marked as raw."""
    whole, _ = verify_checksum(shard.read_bytes())
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


def filtered_twice(file):
    properties = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    properties.set_chunk((40,))
    properties.set_deflate(9)
    properties.set_deflate(9)
    space = h5py.h5s.create_simple((40,))
    made = h5py.h5d.create(file.id, b"x", h5py.h5t.IEEE_F64LE, space, properties)
    made.write(h5py.h5s.ALL, h5py.h5s.ALL, np.zeros(40))


def huge_claim(file):
    """Gigabytes of channels in all frames."""
    file.attrs["count"] = 2**20
    for field in FIELDS:
        if field.axes[0] == "frame":
            wide = field.name in ("impedance", "touch_reference", "status")
            shape = (2**20, 4096) if wide else (2**20, *file[field.path].shape[1:])
            replace(file, field.path, shape=shape, dtype=field.dtype, chunks=True)


def added(*shape, **options):
    return lambda file: file.create_dataset("x", *shape, **options)


LOOSE = {"chunks": (1 << 20,), "maxshape": (None,), "compression": "gzip"}
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
        (filtered_twice, "filter twice"),
        (huge_claim, "fewer than any compression"),
        (added((1 << 26,), "f8", chunks=(1 << 26,)), "stores 0"),
        (added(data=np.zeros(4), **LOOSE), "larger than itself"),
        (lambda file: file.attrs.create("seed", np.zeros(4000)), "must be one number"),
        (lambda file: file.attrs.create("engine", np.zeros(4000)), "must be one number"),
    ],
)
def test_files_that_the_format_does_not_allow_are_refused(shard, damage, message):
    with h5py.File(shard, "r+") as file:
        damage(file)
    with pytest.raises(DataError, match=message) as caught:
        read_shard(shard)
    assert str(shard) in str(caught.value)


def test_unfinished_and_absent_datasets_say_what_to_do(tmp_path, shard):
    shard.rename(tmp_path / "shard-000000.h5")
    with pytest.raises(DataError, match=r"1 finished shards .*--resume"):
        open_dataset(tmp_path)
    with pytest.raises(DataError, match="eitskin generate"):
        open_dataset(tmp_path / "absent")
    for rubbish in (b"", b"[]", b"7", b"{", b"\xff", b"[" * 200_000):
        (tmp_path / "manifest.json").write_bytes(rubbish)
        with pytest.raises(DataError, match="manifest"):
            open_dataset(tmp_path)
    os.mkfifo(tmp_path / "pipe.h5")
    with pytest.raises(DataError):
        open_dataset(tmp_path / "pipe.h5")


# Lone shards: damage anywhere, files that harm HDF5, and files without a seal


@pytest.mark.slow
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


def looping(image):
    """Shard with zeros among its texts, of which HDF5 takes one of no length after the other."""
    start = image.index(b"GCOL") + 1024
    return image[:start] + bytes(512) + image[start + 512 :]


@pytest.mark.slow
def test_a_shard_that_harms_hdf5_harms_only_a_child(shard, monkeypatch):
    """The seal of somebody else tells nothing of what he meant."""
    monkeypatch.setattr(shard_reader, "SECONDS", 1)
    image, _ = verify_checksum(shard.read_bytes())
    shard.write_bytes(append_checksum(looping(image)))
    with pytest.raises(DataError, match="processor time"):
        read_shard(shard)


@pytest.mark.slow
def test_shards_from_elsewhere_are_read_in_a_child_once(tmp_path, monkeypatch):
    monkeypatch.setenv("EITSKIN_CACHE", str(tmp_path / "mine"))
    tried = []
    monkeypatch.setattr(shard_reader, "read_in_subprocess", lambda *task: tried.append(task) or ())
    folder = tmp_path / "set"
    save_dataset(make(), folder, frames_per_shard=10)
    open_dataset(folder)
    assert not tried
    path = folder / "manifest.json"  # which has no say in what is known
    path.write_text(path.read_text().replace('"count"', '"known": true, "count"'))
    monkeypatch.setenv("EITSKIN_CACHE", str(tmp_path / "theirs"))
    open_dataset(folder)
    assert len(tried) == 4
    open_dataset(folder)
    assert len(tried) == 4
    monkeypatch.setenv("EITSKIN_CACHE", str(tmp_path / "others"))
    assert not verify(folder).damage
    open_dataset(folder)
    assert len(tried) == 8


# Manifests: what does not fit, rubbish, and every bit that flips


@pytest.fixture(scope="module")
def whole_set(tmp_path_factory):
    folder = tmp_path_factory.mktemp("whole") / "set"
    save_dataset(make(), folder)
    return folder


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"format_version": FORMAT_VERSION + 1, "new": 1}, "newer than .* upgrade"),
        ({"format": "other"}, "expected format"),
        ({"frames": 41}, r"41 frames.*40"),
        ({"shards": []}, r"40 frames.*0"),
        ({"seed": "x"}, "not a manifest"),
        ({"seed": int("9" * 4000)}, "not a manifest"),
        ({"shards": [{"name": "../a", "first_index": 0, "count": 40, "sha256": ""}]}, "next to"),
        ({"shards": [{"name": "a\0", "first_index": 0, "count": 40, "sha256": ""}]}, "next to"),
        (
            {"shards": [{"name": "a", "first_index": 0, "count": 1 << 40, "sha256": ""}]},
            "not a manifest",
        ),
    ],
)
def test_manifests_that_do_not_fit_are_refused(whole_set, change, message):
    path = whole_set / "manifest.json"
    text = path.read_text()
    path.write_text(json.dumps(json.loads(text) | change))
    try:
        with pytest.raises(DataError, match=message):
            open_dataset(whole_set)
    finally:
        path.write_text(text)


# Looking through datasets for damage


@pytest.fixture
def folder(tmp_path):
    save_dataset(make(50), tmp_path / "set", frames_per_shard=10)
    return tmp_path / "set"


def problems(folder):
    return {each.file: each.problem for each in verify(folder).damage}


@pytest.mark.slow
def test_a_sound_set_is_sound_and_all_damage_is_listed(folder, tmp_path):
    seen = []
    verdict = verify(folder, lambda *counts: seen.append(counts))
    assert (verdict.shards, verdict.frames, verdict.damage) == (5, 50, ())
    assert seen == [(number, 5) for number in range(6)]
    save_dataset(Dataset.from_arrays(np.ones((3, 5))), tmp_path / "measured")
    assert verify(tmp_path / "measured").damage == ()
    flipped = folder / "shard-000001.h5"
    content = bytearray(flipped.read_bytes())
    content[5000] ^= 1
    flipped.write_bytes(content)
    (folder / "shard-000002.h5").unlink()
    cut = folder / "shard-000003.h5"
    cut.write_bytes(cut.read_bytes()[:3000])
    (folder / "shard-000007.h5").write_bytes(shard_bytes(make(3)))
    (folder / "recipe.toml").write_text("another")
    (folder / "notes.txt").write_text("mine")
    verdict = verify(folder)
    assert (verdict.shards, verdict.frames) == (2, 20)
    found = problems(folder)
    assert set(found) == {
        "recipe.toml",
        *(f"shard-00000{number}.h5" for number in (1, 2, 3, 7)),
    }
    (folder / "manifest.json").unlink()
    verdict = verify(folder)  # the shards all the same
    assert (verdict.shards, verdict.frames) == (2, 20)
    assert set(problems(folder)) == set(found) - {"shard-000002.h5", "recipe.toml"} | {
        "manifest.json"
    }
    assert "eitskin generate" in problems(folder / "absent")["manifest.json"]


def rewritten(folder, number, n=10, **changes):
    """A shard of other content, to which the manifest has been made to agree."""
    path = folder / f"shard-00000{number}.h5"
    write_shard(path, dataclasses.replace(make(n), **changes), 10 * number)
    manifest = json.loads((folder / "manifest.json").read_text())
    manifest["shards"][number]["sha256"] = hashlib.sha256(path.read_bytes()).hexdigest()
    (folder / "manifest.json").write_text(json.dumps(manifest))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"n": 9}, "must hold 10 frames, got 9"),
        ({"seed": 8}, "recipe or seed"),
        ({"recipe": "other"}, "recipe or seed"),
        ({"frequency": 1e3}, "not made together"),
        ({"reference": np.ones((2, 28), np.complex64)}, "reference of a specimen"),
    ],
)
def test_shards_of_another_set_do_not_belong(folder, changes, message, monkeypatch):
    rewritten(folder, 2, **changes)
    assert message in problems(folder)["shard-000002.h5"]
    monkeypatch.setattr(folders, "READ_AT_ONCE", 0)
    found = open_dataset(folder)
    for _ in range(2):  # not only the first time
        with pytest.raises(DataError, match=r"not made together|must hold"):
            _ = found.state
