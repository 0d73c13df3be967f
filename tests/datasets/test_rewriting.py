"""Combining different datasets of one sensor: numbers of specimens, and what is refused."""

import dataclasses

import numpy as np
import pytest
from command_line import printed_json, run

from eitskin.datasets import combine, compact, open_dataset, read_shard, save_dataset, verify
from eitskin.datasets.store import worker_processes
from eitskin.datasets.store.manifest import Names
from eitskin.datasets.store.summary import specimens_in_words
from eitskin.errors import ConfigurationError, DataError
from eitskin.geometry import SensorDesign
from eitskin.simulator import Protocol

from shards_here import contents
from small_dataset import assert_same, make

pytestmark = pytest.mark.slow


@pytest.fixture
def simulated(tmp_path):
    save_dataset(make(40, specimens=3), tmp_path / "simulated", frames_per_shard=15)
    return tmp_path / "simulated"


def own(tmp_path, **changes):
    """Dataset of own presses, with values of about the same size."""
    known = {"source": "measured", "recipe": "", "seed": 0, "quantity": ""} | changes
    data = dataclasses.replace(make(12, specimens=2), **known)
    values = {name: 1.2 * getattr(data, name) for name in ("impedance", "reference")}
    save_dataset(dataclasses.replace(data, **(values | changes)), tmp_path / "own")
    return tmp_path / "own"


def test_own_presses_follow_simulated_ones(simulated, tmp_path):
    done = []
    manifest = combine(
        [simulated, own(tmp_path)], tmp_path / "both", progress=lambda *at: done.append(at)
    )
    assert (manifest.frames, len(manifest.shards), done[-1]) == (52, 4, (4, 4))
    both, first, second = (open_dataset(tmp_path / n) for n in ("both", "simulated", "own"))
    assert (both.source, both.recipe, both.design) == ("measured", "", first.design)
    assert np.array_equal(both.impedance, np.concatenate([first.impedance, second.impedance]))
    assert both.specimen_number.tolist() == [0, 1, 2, 3, 4]
    assert np.array_equal(both.reference, np.concatenate([first.reference, second.reference]))
    assert np.array_equal(both.specimen[40:], second.specimen + 3)
    assert np.array_equal(both.episode[40:], second.episode + 4)


def test_numbers_of_averaged_frames_stay_where_all_sets_have_the_same(simulated, tmp_path):
    recipe = 'name = "other"\nreference_frames = 16\ntouch_frames = 8\n'
    for place in ("first", "second"):
        data = dataclasses.replace(make(12, specimens=2), recipe=recipe + f"# {place}\n")
        save_dataset(dataclasses.replace(data, seed=len(place)), tmp_path / place)
    combine([tmp_path / "first", tmp_path / "second"], tmp_path / "both")
    counts = {
        name: (data.reference_frames, data.touch_frames)
        for name in ("first", "both")
        if (data := open_dataset(tmp_path / name))
    }
    assert counts == {"first": (16, 8), "both": (16, 8)}
    with pytest.raises(DataError, match="means of 1 frames, expected 16"):
        combine([tmp_path / "first", simulated], tmp_path / "mixed")


def test_magnitudes_go_with_impedances_where_that_is_wanted(simulated, tmp_path):
    one_dead = make(12, specimens=2).reference * (np.arange(28) > 0)
    measured = own(tmp_path, quantity="magnitude", reference=one_dead)
    combine([measured, simulated], tmp_path / "both", magnitudes=True)
    both = open_dataset(tmp_path / "both")
    assert both.quantity == "magnitude"
    assert np.allclose(both.impedance[12:], np.abs(open_dataset(simulated).impedance))


@pytest.mark.parametrize(
    ("changes", "messages"),
    [
        ({"quantity": "magnitude"}, ["magnitude, expected impedance", "--magnitudes"]),
        ({"reference": 48 * make(12).reference, "quantity": ""}, ["times the expected"]),
        ({"protocol": None}, ["no known protocol", "pairwise:8", "--protocol"]),
        ({"protocol": Protocol.from_rows(Protocol.pairwise(8).table[::-1], 8)}, ["table"]),
        ({"design": None}, ["--sensor"]),
        (
            {"design": dataclasses.replace(SensorDesign.reference(), thickness=0.004)},
            ["differs (thickness: import"],
        ),
        ({"frequency": 1e3, "quantity": "voltage"}, ["1000 Hz", "voltage"]),  # all differences
    ],
)
def test_differences_are_named_with_remedies(simulated, tmp_path, changes, messages):
    with pytest.raises(DataError) as caught:
        combine([simulated, own(tmp_path, **changes)], tmp_path / "both")
    assert all(message in str(caught.value) for message in messages)
    assert not (tmp_path / "both").exists()
    with pytest.raises(DataError, match="same frames"):
        combine([simulated, simulated], tmp_path / "both")
    with pytest.raises(ConfigurationError, match="at least two"):
        combine([simulated], tmp_path / "both")


# Datasets written anew in other shards


@pytest.fixture
def data():
    return make(47, specimens=5, specimen=np.arange(47) // 10)


def test_a_set_is_cut_anew_with_the_specimens_of_each_shard(tmp_path, data):
    cut, counts, seen = 20, [20, 20, 7], []
    save_dataset(data, tmp_path / "set", frames_per_shard=12)
    compact(tmp_path / "set", tmp_path / "as cut", None)
    assert contents(tmp_path / "as cut") == contents(tmp_path / "set")
    manifest = compact(tmp_path / "set", tmp_path / "new", cut, lambda *done: seen.append(done))
    assert [entry.count for entry in manifest.shards] == counts
    assert seen == [(number + 1, len(counts)) for number in range(len(counts))]
    assert_same(open_dataset(tmp_path / "new"), data)
    for number, specimens in enumerate(([0, 1], [2, 3], [4])):  # those of its frames alone
        part = read_shard(tmp_path / "new" / manifest.shards[number].name)
        assert part.specimen_number.tolist() == specimens
        assert np.array_equal(part.reference, data.reference[specimens])


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


def test_an_interrupt_damage_or_an_occupied_folder_leaves_nothing(tmp_path, data):
    save_dataset(data, tmp_path / "set", frames_per_shard=12)

    def interrupt(done, _total):
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        compact(tmp_path / "set", tmp_path / "new", 12, interrupt)
    assert [path.name for path in tmp_path.iterdir()] == ["set"]
    with pytest.raises(ConfigurationError, match="not empty"):
        compact(tmp_path / "set", tmp_path / "set")
    with pytest.raises(ConfigurationError, match="frames_per_shard"):
        compact(tmp_path / "set", tmp_path / "new", 0)
    (tmp_path / "set" / "shard-000002.h5").write_bytes(b"rubbish")
    with pytest.raises(DataError, match=r"shard-000002\.h5.*SHA-256"):
        compact(tmp_path / "set", tmp_path / "new", 12)
    assert [path.name for path in tmp_path.iterdir()] == ["set"]


# Names of specimens and sessions, from a recording through datasets made of it


ROWS = """specimen,sensor,session,x,y,v0,v1,v2
gel B,left,monday,0.01,0.02,1.0,2.0,3.0
gel A,left,monday,0.01,0.02,1.1,2.0,3.0
gel B,left,tuesday,0.01,0.02,1.2,2.0,3.0
gel A,right,tuesday,0.01,0.02,1.3,2.0,3.0
"""
SPECIMENS = {0: "gel B left", 1: "gel A left", 2: "gel A right"}
SESSIONS = {0: "monday", 1: "tuesday"}


@pytest.fixture
def named(tmp_path):
    (tmp_path / "mine.csv").write_text(ROWS)
    out = tmp_path / "mine"
    run("import", tmp_path / "mine.csv", "--out", out, "--protocol", "pairwise:3")
    return out


def test_names_of_an_import_stay_with_copies_and_combinations(named, tmp_path):
    data = open_dataset(named)
    compact(named, tmp_path / "compact")
    assert open_dataset(tmp_path / "compact").names == data.names == Names(SPECIMENS, SESSIONS)
    info = printed_json("dataset", "info", named)
    assert info["specimen_names"] == {str(k): name for k, name in SPECIMENS.items()}
    assert info["session_names"] == {str(k): name for k, name in SESSIONS.items()}
    assert data.specimen_names == tuple(SPECIMENS.values())
    assert data.select([1, 3]).specimen_names == ("gel A left", "gel A right")
    assert specimens_in_words(data.select([3])) == "1 specimen (gel A right)"
    data = dataclasses.replace(open_dataset(named), names=Names(), impedance=np.ones((4, 3)))
    save_dataset(data, tmp_path / "yours")
    run("dataset", "combine", tmp_path / "yours", named, "--out", tmp_path / "both", code=0)
    both = open_dataset(tmp_path / "both")
    unnamed = ("yours 0", "yours 1", "yours 2")
    assert both.specimen_names == (*unnamed, *SPECIMENS.values())
    assert both.names.sessions == {2: "monday", 3: "tuesday"}
    assert both.select(both.specimen == 4).specimen_names == ("gel A left",)
