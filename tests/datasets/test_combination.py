"""Combining different datasets of one sensor: numbers of specimens, and what is refused."""

import dataclasses

import numpy as np
import pytest

from eitskin.datasets import combine, open_dataset, save_dataset
from eitskin.errors import ConfigurationError, DataError
from eitskin.geometry import SensorDesign
from eitskin.simulator import Protocol

from small_dataset import make


@pytest.fixture
def simulated(tmp_path):
    save_dataset(make(40, specimens=3), tmp_path / "simulated", frames_per_shard=15)
    return tmp_path / "simulated"


def own(tmp_path, **changes):
    """Dataset of own presses, with values of about the same size."""
    known = {"source": "measured", "recipe": "", "seed": 0, "quantity": ""} | changes
    data = dataclasses.replace(make(12, specimens=2), **known)
    values = {name: 1.2 * getattr(data, name) for name in ("impedance", "reference")}
    save_dataset(dataclasses.replace(data, **values), tmp_path / "own")
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


def test_magnitudes_go_with_impedances_where_that_is_wanted(simulated, tmp_path):
    folder = own(tmp_path, quantity="magnitude")
    with pytest.raises(DataError, match=r"magnitude, expected impedance.*--magnitudes"):
        combine([simulated, folder], tmp_path / "both")
    combine([simulated, folder], tmp_path / "both", magnitudes=True)
    both = open_dataset(tmp_path / "both")
    assert both.quantity == "magnitude"
    assert np.allclose(both.impedance[:40], np.abs(open_dataset(simulated).impedance))


@pytest.mark.parametrize(
    ("changes", "messages"),
    [
        ({"protocol": None}, ["no known protocol", "pairwise:8", "--protocol"]),
        ({"protocol": Protocol.from_rows(Protocol.pairwise(8).table[::-1], 8)}, ["table"]),
        ({"design": None}, ["--sensor"]),
        (
            {"design": dataclasses.replace(SensorDesign.reference(), thickness=0.004)},
            ["thickness"],
        ),
        ({"frequency": 1e3, "quantity": "voltage"}, ["1000 Hz", "voltage"]),  # all differences
    ],
)
def test_differences_are_named_with_remedies(simulated, tmp_path, changes, messages):
    with pytest.raises(DataError) as caught:
        combine([simulated, own(tmp_path, **changes)], tmp_path / "both")
    assert all(message in str(caught.value) for message in messages)
    assert not (tmp_path / "both").exists()


def test_values_of_another_unit_the_same_frames_and_lone_sets_are_refused(simulated, tmp_path):
    data = make(10)
    save_dataset(
        dataclasses.replace(data, reference=40 * data.reference, quantity=""), tmp_path / "counts"
    )
    with pytest.raises(DataError, match=r"\d\d\.?\d* times the expected"):
        combine([simulated, tmp_path / "counts"], tmp_path / "both")
    with pytest.raises(DataError, match="same frames"):
        combine([simulated, simulated], tmp_path / "both")
    with pytest.raises(ConfigurationError, match="at least two"):
        combine([simulated], tmp_path / "both")
