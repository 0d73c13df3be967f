"""Datasets as Parquet, Hugging Face and torch: others read what was there."""

import dataclasses
import hashlib
import itertools
import json
import pickle

import numpy as np
import pytest
import torch
import yaml
from command_line import printed_json
from torch.utils.data import DataLoader

from eitskin.datasets import (
    ShuffledShards,
    State,
    TorchDataset,
    export_dataset,
    open_dataset,
    save_dataset,
)
from eitskin.datasets.export.frame_table import SPLITS, parse_split, specimen_splits
from eitskin.datasets.store.frame_tensors import NAMES
from eitskin.datasets.store.manifest import Names
from eitskin.errors import ConfigurationError, DataError

from on_demand import OnDemand
from small_dataset import make

pytestmark = pytest.mark.slow

pd, pq = OnDemand("pandas"), OnDemand("pyarrow.parquet")

FRAMES, SPECIMENS = 90, 30
PUBLISHED = [  # of the specimens 0 to 11 of seed 7: others may have split their sets by these
    *("train", "train", "train", "validation", "train", "train"),
    *("train", "train", "train", "test", "train", "validation"),
]
FLOATS = ("impedance", "touch_reference", "reference")


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    """Folder of a dataset with something unknown in every column that may have it."""
    data = make(FRAMES, SPECIMENS)
    data.touch_depth[::4] = np.nan
    data.bend_angle_deg[3] = np.nan
    data.touch_reference[5] = np.nan
    data.state[[7, 8, 9]] = [State.IDLE, 255, 255]
    data.touch_x[8] = data.touch_y[8] = np.nan
    data.state[9], data.touch_x[9], data.touch_y[9] = State.TOUCH, np.nan, np.nan
    folder = tmp_path_factory.mktemp("sets") / "small"
    save_dataset(data, folder, frames_per_shard=17)
    return folder


@pytest.fixture(scope="module")
def parquet(saved, tmp_path_factory):
    out = tmp_path_factory.mktemp("out") / "parquet"
    export_dataset(saved, out, "parquet")
    return out


@pytest.fixture(scope="module")
def huggingface(saved, tmp_path_factory):
    out = tmp_path_factory.mktemp("out") / "huggingface"
    export_dataset(saved, out, "huggingface", "cc-by-4.0")
    return out


class TestParquet:
    def test_pandas_reads_the_same_numbers(self, saved, parquet):
        data, frames = open_dataset(saved), pd.read_parquet(parquet / "data")
        for name, part in itertools.product(FLOATS, ("real", "imag")):
            values = getattr(data, name)
            values = values[data.specimen] if name == "reference" else values
            rows = [np.full(28, np.nan) if row is None else row for row in frames[f"{name}_{part}"]]
            np.testing.assert_array_equal(np.stack(rows), getattr(values, part))
        np.testing.assert_array_equal(np.stack(frames["status"]), data.status)
        for name in ("bend_angle_deg", "time", "episode", "number"):
            np.testing.assert_array_equal(frames[name], getattr(data, name))
        np.testing.assert_array_equal(frames["specimen"], data.specimen_number[data.specimen])
        names = {0: "idle", 1: "touch", 2: "bend", 255: None}
        read = frames["state"].astype(object).where(frames["state"].notna(), None)
        assert read.tolist() == [names[state] for state in data.state.tolist()]
        assert frames.groupby("specimen")["split"].nunique().max() == 1
        schema = pq.read_schema(next((parquet / "data").iterdir()))
        assert schema.field("impedance_real").metadata[b"units"] == b"ohm"
        about = json.loads(schema.metadata[b"eitskin"])
        assert (about["n_electrodes"], about["frequency_hz"], about["seed"]) == (8, 50e3, 7)
        assert about["protocol"][0] == [0, 1, 0, 1]

    def test_equal_sets_give_equal_bytes_and_sums_that_fit(self, saved, parquet, tmp_path):
        export_dataset(saved, tmp_path / "small", "parquet", file_bytes=20_000)
        files = sorted((tmp_path / "small" / "data").iterdir())
        assert len(files) > 2
        assert files[1].name == f"frames-00001-of-{len(files):05d}.parquet"
        assert all(pq.read_table(file).nbytes < 40_000 for file in files)
        assert pq.read_table(tmp_path / "small" / "data").equals(pq.read_table(parquet / "data"))
        export_dataset(saved, tmp_path / "again", "parquet")
        sums = (parquet / "SHA256SUMS").read_text()
        assert (tmp_path / "again" / "SHA256SUMS").read_text() == sums
        for line in sums.splitlines():
            digest, name = line.split("  ")
            assert hashlib.sha256((parquet / name).read_bytes()).hexdigest() == digest
        assert (parquet / "recipe.toml").read_text() == open_dataset(saved).recipe


class TestHuggingFace:
    def test_its_files_hold_all_frames_once(self, parquet, huggingface):
        parts = [pd.read_parquet(path) for path in (huggingface / "data").iterdir()]
        whole = pd.read_parquet(parquet / "data").drop(columns="split")
        ordered = (each.sort_values("number") for each in (pd.concat(parts), whole))
        both = [each.reset_index(drop=True).to_json() for each in ordered]
        assert both[0] == both[1]

    def test_its_card_says_what_the_files_hold(self, huggingface):
        _, head, text = (huggingface / "README.md").read_text().split("---\n", 2)
        told = yaml.safe_load(head)
        assert told["license"] == "cc-by-4.0"
        for split in told["dataset_info"]["splits"]:
            (file,) = (huggingface / "data").glob(f"{split['name']}-*")
            assert pq.read_metadata(file).num_rows == split["num_examples"] > 0
        stored = pq.read_schema(file)
        assert [each["name"] for each in told["dataset_info"]["features"]] == stored.names
        for each in told["dataset_info"]["features"]:
            kind = stored.field(each["name"]).type
            if "length" in each:
                assert (str(kind.value_type), kind.list_size) == (
                    each["list"].replace("float32", "float"),
                    each["length"],
                )
        paths = [each["path"] for each in told["configs"][0]["data_files"]]
        assert paths == [f"data/{name}-*" for name in SPLITS]
        assert 'name = "made for a test"' in text


class TestSplits:
    def test_a_name_or_a_seed_decides_and_no_other_specimen(self):
        few = specimen_splits(range(20), Names(), 3)
        many = specimen_splits(range(200), Names(), 3)
        assert many.items() >= few.items()
        assert specimen_splits(range(200), Names(), 4) != many
        named = specimen_splits([5, 6], Names({5: "left hand", 6: "right arm"}), 3)
        assert named == specimen_splits([5, 6], Names({5: "left hand", 6: "right arm"}), 9)

    def test_they_stay_as_they_were_published_and_one_alone_is_for_training(self):
        assert [parse_split(f"7:{n}") for n in range(12)] == PUBLISHED
        assert specimen_splits([9], Names(), 7) == {9: "train"}

    def test_shares_are_as_told(self):
        found = [parse_split(f"0:{n}") for n in range(20_000)]
        shares = [found.count(name) / len(found) for name in SPLITS]
        assert shares == pytest.approx([0.8, 0.1, 0.1], abs=4 * 0.4 / 20_000**0.5)


class TestMistakes:
    @pytest.mark.parametrize(
        ("form", "license_name"), [("csv", "mit"), ("parquet", "CC BY"), ("parquet", "a\nb: c")]
    )
    def test_other_formats_licences_and_occupied_folders(self, saved, tmp_path, form, license_name):
        with pytest.raises(ConfigurationError):
            export_dataset(saved, tmp_path / "out", form, license_name)
        assert not (tmp_path / "out").exists()
        with pytest.raises(ConfigurationError, match="not empty"):
            export_dataset(saved, tmp_path.parent, "parquet")

    def test_damage_leaves_nothing(self, saved, tmp_path):
        copy = tmp_path / "copy"
        save_dataset(open_dataset(saved), copy, frames_per_shard=40)
        last = sorted(copy.glob("shard-*"))[-1]
        last.write_bytes(last.read_bytes()[:-100])
        with pytest.raises(DataError, match=last.name):
            export_dataset(copy, tmp_path / "out", "parquet")
        assert [path.name for path in tmp_path.iterdir()] == ["copy"]


def test_the_command_tells_frames_and_units(tmp_path):
    data = dataclasses.replace(make(6), source="measured", recipe="", quantity="voltage")
    save_dataset(data, tmp_path / "set")
    words = ["--out", tmp_path / "out", "--format", "huggingface"]
    said = printed_json("dataset", "export", tmp_path / "set", *words)
    assert said["frames"] == {"train": 6}
    text = (tmp_path / "out" / "README.md").read_text()
    assert "| `impedance_real` | float32 x 28 | V |" in text
    assert not (tmp_path / "out" / "recipe.toml").exists()


# Datasets as torch reads them


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    place = tmp_path_factory.mktemp("torch") / "set"
    save_dataset(make(50), place, frames_per_shard=8)
    return place


@pytest.fixture(scope="module")
def data(folder):
    return open_dataset(folder)


def test_torch_reads_the_frames_alone_opened_and_in_batches(folder, data):
    """As the first page has it, with workers."""
    frames = TorchDataset(folder)
    before = len(pickle.dumps(frames))
    assert len(frames) == 50
    item = frames[13]
    assert np.array_equal(item["impedance"].numpy(), data.impedance[13])
    assert np.array_equal(item["reference"].numpy(), data.reference[1])
    assert np.array_equal(item["touch_x"].numpy(), data.touch_x[13], equal_nan=True)
    assert item["state"].dtype == torch.int64
    assert item["bend_angle_deg"].shape == ()
    assert frames[-1]["time"] == frames[49]["time"] == data.time[49]
    with pytest.raises(IndexError):
        frames[50]
    sent = pickle.dumps(frames)  # to another process, which reads the files itself
    assert len(sent) == before < 2000
    assert torch.equal(pickle.loads(sent)[13]["impedance"], item["impedance"])  # noqa: S301
    frames[0]["impedance"][:] = 0  # of the reader alone
    assert frames[0]["impedance"].abs().min() > 0
    for read in (TorchDataset, ShuffledShards):
        with pytest.raises(ConfigurationError, match=r"reference, got weather"):
            read(folder, names=("impedance", "weather"))
    chosen = data.select(data.state > 0)
    loader = DataLoader(chosen.torch("impedance", "state"), batch_size=7, num_workers=2)
    found = torch.cat([batch["impedance"] for batch in loader]).numpy()
    assert np.array_equal(found, chosen.impedance)
    assert set(data.torch()[0]) == set(NAMES)
    single = ShuffledShards(folder, seed=3)
    batches = ShuffledShards(folder, seed=3, batch=5)
    found = list(DataLoader(batches, batch_size=None))
    assert len(batches) == len(found) == 6 * 2 + 1
    assert {len(item["time"]) for item in found} == {5, 3, 2}
    assert found[0]["impedance"].shape == (5, 28)
    one_by_one = [item["time"].item() for item in single]
    assert torch.cat([item["time"] for item in found]).tolist() == one_by_one
    with pytest.raises(ConfigurationError, match="batch"):
        ShuffledShards(folder, batch=0)


def test_specimens_are_those_of_the_set_in_every_shard(tmp_path):
    made = make(40, specimens=8, specimen=np.arange(40) // 5)
    save_dataset(made, tmp_path / "set", frames_per_shard=10)
    for read in (TorchDataset(tmp_path / "set"), ShuffledShards(tmp_path / "set")):
        for item in read:
            number = int(item["specimen"])
            assert number == made.specimen[round(item["time"].item() * 10)]
            assert np.array_equal(item["reference"].numpy(), made.reference[number])


def test_order_follows_from_seed_and_epoch(folder):
    def order(seed, epoch):
        shards = ShuffledShards(folder, names=("time",), seed=seed)
        shards.set_epoch(epoch)
        return [item["time"].item() for item in shards]

    assert order(3, 0) == order(3, 0)
    assert order(3, 0) != order(3, 1)
    assert order(3, 0) != order(4, 0)
    # A shard's frames stay together: only one of them is in memory at a time.
    assert sorted(order(3, 0)) == open_dataset(folder).time.tolist()
    shards = [round(time * 10) // 8 for time in order(3, 0)]
    assert len([a for a, b in itertools.pairwise(shards) if a != b]) == 6
