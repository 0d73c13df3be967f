"""Datasets as torch reads them."""

import itertools
import pickle

import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader

from eitskin.datasets import ShuffledShards, TorchDataset, open_dataset, save_dataset
from eitskin.datasets.store.tensors import NAMES
from eitskin.errors import ConfigurationError

from small_dataset import make


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    place = tmp_path_factory.mktemp("torch") / "set"
    save_dataset(make(50), place, frames_per_shard=8)
    return place


@pytest.fixture(scope="module")
def data(folder):
    return open_dataset(folder)


def test_items_are_the_frames(folder, data):
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


def test_opened_frames_give_their_own_also_some_of_them(data):
    """As the first page has it, with workers."""
    chosen = data.select(data.state > 0)
    loader = DataLoader(chosen.torch("impedance", "state"), batch_size=7, num_workers=2)
    found = torch.cat([batch["impedance"] for batch in loader]).numpy()
    assert np.array_equal(found, chosen.impedance)
    assert set(data.torch()[0]) == set(NAMES)


def test_specimens_are_those_of_the_set_in_every_shard(tmp_path):
    made = make(40, specimens=8, specimen=np.arange(40) // 5)
    save_dataset(made, tmp_path / "set", frames_per_shard=10)
    for read in (TorchDataset(tmp_path / "set"), ShuffledShards(tmp_path / "set")):
        for item in read:
            number = int(item["specimen"])
            assert number == made.specimen[round(item["time"].item() * 10)]
            assert np.array_equal(item["reference"].numpy(), made.reference[number])


def test_batches_are_the_same_frames_in_the_same_order(folder):
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


@pytest.mark.slow
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
