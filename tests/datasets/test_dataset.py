"""Datasets in memory, touch maps drawn from them, and recording."""

import copy
import dataclasses

import numpy as np
import pytest

from eitskin.datasets import Dataset, ShardWriter, State, open_dataset, save_dataset, touch_maps
from eitskin.datasets.store import folder as folders
from eitskin.datasets.store.summary import DatasetSummary
from eitskin.errors import ConfigurationError, DataError, FrameError
from eitskin.simulator import Frame, Protocol, Status, Touch

from small_dataset import assert_same, make

# Datasets in memory


def test_parts_of_a_split_hold_whole_specimens_whole_touches_or_frames():
    data = make(100, specimens=10)
    train, validate, test = (set(data.specimen[part]) for part in data.split((0.6, 0.2, 0.2), 0))
    assert (len(train), len(validate), len(test)) == (6, 2, 2)
    assert train | validate | test == set(range(10))
    parts = make(100, specimens=1).split((0.6, 0.2, 0.2), seed=3)
    assert [len(part) for part in parts] == [60, 20, 20]
    assert np.array_equal(np.sort(np.concatenate(parts)), np.arange(100))
    again = make(100, specimens=1).split((0.6, 0.2, 0.2), seed=3)
    other = make(100, specimens=1).split((0.6, 0.2, 0.2), seed=4)
    assert all(np.array_equal(a, b) for a, b in zip(parts, again, strict=True))
    assert not np.array_equal(parts[0], other[0])
    data = make(200, specimens=1)
    touch = np.arange(200) // 10 % 10  # ten held touches, each of twenty frames
    for column in (data.touch_x, data.touch_y):
        column[:] = np.nan
        column[:100, 0] = 0.01 * (1 + touch[:100])
    parts = data.split((0.6, 0.2, 0.2), seed=1)
    assert [len(part) for part in parts] == [120, 40, 40]
    assert [len(set(touch[part[part < 100]])) for part in parts] == [6, 2, 2]
    assert np.array_equal(np.sort(np.concatenate(parts)), np.arange(200))
    apart = data.split((0.6, 0.2, 0.2), seed=1, whole_touches=False)
    assert len(set(touch[apart[2][apart[2] < 100]])) > 2


def test_parts_share_the_references_of_their_specimens():
    whole = make(60, specimens=6, specimen=np.arange(60) // 10)
    parts = [whole.select(slice(first, first + 25)).own_specimens() for first in (0, 25, 50)]
    assert [part.specimen_number.tolist() for part in parts] == [[0, 1, 2], [2, 3, 4], [5]]
    assert_same(Dataset.concatenate(parts), whole)
    later = Dataset.concatenate(parts[:0:-1])
    assert later.specimen_number.tolist() == [2, 3, 4, 5]
    frames = np.r_[50:60, 25:50]
    assert np.array_equal(later.reference[later.specimen], whole.reference[whole.specimen[frames]])
    other = dataclasses.replace(parts[1], reference=parts[1].reference * 1.01)
    with pytest.raises(DataError, match=r"specimen 2 differs.*not made together"):
        Dataset.concatenate([parts[0], other])
    with pytest.raises(DataError, match="59 frames in all, got 60"):
        Dataset.collect(parts, 59)


# Touch maps


def test_summaries_count_frames_by_their_touches():
    data, summary = make(12), DatasetSummary()
    crowded = np.where(np.arange(12)[:, None] == 2, 0.05, data.touch_x)
    summary.add(dataclasses.replace(data, touch_x=crowded, touch_y=crowded))
    assert summary.contents()["touches_per_frame"] == {"0": 6, "1": 5, "4": 1}


def test_touch_maps_are_discs_of_the_right_area_and_place():
    x, y = np.array([[0.05, np.nan], [0.10, 0.03]]), np.array([[0.02, np.nan], [0.04, 0.02]])
    maps = touch_maps(x, y, np.where(np.isnan(x), np.nan, 0.0075))
    assert maps.shape == (2, 32, 80)
    assert maps.dtype == np.float32
    assert maps.min() == 0.0
    assert maps.max() == 1.0
    pixel = 0.001875
    assert maps[0].sum() * pixel**2 == pytest.approx(np.pi * 0.0075**2, rel=0.02)
    assert maps[1].sum() * pixel**2 == pytest.approx(2 * np.pi * 0.0075**2, rel=0.02)
    rows, columns = np.mgrid[:32, :80]
    assert (maps[0] * columns).sum() / maps[0].sum() == pytest.approx(0.05 / pixel - 0.5, abs=0.05)
    assert (maps[0] * rows).sum() / maps[0].sum() == pytest.approx(0.02 / pixel - 0.5, abs=0.05)
    assert touch_maps([[0.05, 0.052]], [[0.02, 0.02]], [[0.0075, 0.0075]]).max() == 1.0  # overlap
    assert not touch_maps(*np.full((3, 2, 4), np.nan)).any()


# Recording


def frames(n, protocol=None):
    protocol = protocol or Protocol.pairwise(4)
    for number in range(n):
        values = np.arange(len(protocol)) + 1.0 + number
        yield Frame(values, protocol, time=number * 0.5, number=number, session=number // 4)


def test_recorded_frames_come_back_with_their_labels(tmp_path):
    touch = Touch(0.05, 0.02, 9.0)
    with ShardWriter(tmp_path / "run", frames_per_shard=3) as writer:
        for frame in frames(8):
            writer.append(frame, state=State.TOUCH, bend_angle_deg=5.0, touches=(touch,))
        assert len(open_dataset(tmp_path / "run")) == 6  # up to its last shard, were it killed
        with pytest.raises(FrameError, match="own folder"):
            writer.append(next(frames(1, Protocol.pairwise(5))))
    with pytest.raises(ConfigurationError, match="not empty"):
        ShardWriter(tmp_path / "run")
    data = open_dataset(tmp_path / "run")
    assert (len(data), data.source) == (8, "measured")
    assert len(list((tmp_path / "run").glob("shard-*.h5"))) == 3
    for number, frame in enumerate(frames(8)):
        again = data.frame(number)
        assert np.array_equal(again.impedance, frame.impedance)
        for name in ("protocol", "frequency", "time", "number", "session"):
            assert getattr(again, name) == getattr(frame, name), name
    assert np.array_equal(data.episode, np.arange(8) // 4)
    assert np.array_equal(data.reference[0], data.impedance[0])
    assert data.touch_force[7, 0] == 9.0
    assert np.isnan(data.touch_force[7, 1])
    assert np.isnan(data.touch_reference).all()


def test_recording_keeps_numbers_and_marks_values_that_are_not_finite(tmp_path):
    numbers, bad = [4, 5, 9, 2**32 - 1], (np.nan, complex(np.inf, 1.0), 7.0, 8.0)
    with ShardWriter(tmp_path / "run", frames_per_shard=3) as writer:
        for frame, number, value in zip(frames(4), numbers, bad, strict=True):
            values = frame.impedance.copy()
            values[2] = value
            writer.append(dataclasses.replace(frame, impedance=values, number=number))
    data = open_dataset(tmp_path / "run")
    assert data.number.tolist() == [data.frame(i).number for i in range(4)] == numbers
    assert np.isfinite(data.impedance).all()
    assert np.isnan([data.frame(i).impedance[2] for i in range(3)]).tolist() == [True, True, False]
    assert data.status[:, 2].tolist() == [Status.NOT_FINITE, Status.NOT_FINITE, 0, 0]
    assert data.reference[0, 2] == 7.0  # of the first frame that is whole


# Large datasets, whose columns are read when they are first used


@pytest.fixture
def data():
    return make(50, specimens=5, specimen=np.arange(50) // 10)


@pytest.fixture
def folder(tmp_path, data, monkeypatch):
    monkeypatch.setattr(folders, "READ_AT_ONCE", 0)
    save_dataset(data, tmp_path / "set", frames_per_shard=12)
    return tmp_path / "set"


@pytest.mark.slow
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
def test_all_methods_answer_as_those_of_a_dataset_in_memory(folder, data):
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
    assert "50 frames" in repr(found)
    with pytest.raises(AttributeError):
        found.impedances  # noqa: B018


@pytest.mark.slow
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


@pytest.mark.slow
def test_columns_beyond_the_memory_are_refused(folder, monkeypatch):
    found = open_dataset(folder)
    monkeypatch.setattr(folders.os, "sysconf", lambda _: 90)  # 8,100 bytes
    assert len(found.state) == 50
    monkeypatch.setattr(folders, "READ_AT_ONCE", 1 << 20)
    sizes = (lambda: found.impedance, lambda: found.select(range(40)), lambda: open_dataset(folder))
    for too_much in sizes:
        with pytest.raises(ConfigurationError, match="read_shards"):
            too_much()
    assert len(found.select([3])) == 1
