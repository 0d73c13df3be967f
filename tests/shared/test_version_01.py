"""Files that version 0.1 saved open, and give the values that version 0.1 gave.

A dataset in two shards, a recording of a live session, a pipeline of the paper's method and one of
touch positions; `expected.json` has what version 0.1 read from and estimated with them, and
`names.txt` its public names.
Values of datasets are the same to the last bit. Estimates are the same up to the order in which
another machine sums.
"""

import hashlib
import json
import zipfile
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

from eitskin.datasets import compact, open_dataset, verify
from eitskin.datasets.store import folder as folders
from eitskin.hardware import open_board
from eitskin.training import Pipeline, RecordedTouches, open_pipeline
from eitskin.training.evaluation.evaluate import held_out_positions

pytestmark = pytest.mark.slow

DATA = Path(__file__).parents[1] / "data" / "v0.1"
EXPECTED = json.loads((DATA / "expected.json").read_text())


@pytest.fixture(scope="module")
def saved(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("version-01")
    with zipfile.ZipFile(DATA / "saved.zip") as archive:
        archive.extractall(folder)
    return folder


def same(values, expected) -> bool:
    return np.asarray(values) == pytest.approx(
        np.asarray(expected), rel=1e-5, abs=1e-5, nan_ok=True
    )


@pytest.mark.parametrize("by", ["shard", "column", "copy in another form"])
@pytest.mark.parametrize("name", ["dataset", "recording", "presses"])
def test_a_dataset_has_the_same_values_to_the_last_bit(saved, name, by, tmp_path, monkeypatch):
    folder, expected = saved / name, EXPECTED[name]
    if by == "column":
        monkeypatch.setattr(folders, "READ_AT_ONCE", 0)
    if by.startswith("copy"):
        folder = tmp_path / "new"
        assert compact(saved / name, folder, frames_per_shard=11).format_version == 2
        assert not verify(folder).damage
    dataset = open_dataset(folder)
    for field, (dtype, shape, digest) in expected["arrays"].items():
        array = getattr(dataset, field)
        assert (array.dtype.str, list(array.shape)) == (dtype, shape), field
        content = np.ascontiguousarray(array).tobytes()
        assert hashlib.sha256(content).hexdigest() == digest, field
    for field in ("frequency", "source", "seed"):
        assert getattr(dataset, field) == expected[field]
    table = dataset.protocol and [list(row) for row in dataset.protocol.table]
    assert table == expected["table"]
    electrodes = dataset.design and [[e.x, e.y] for e in dataset.design.electrodes]
    assert electrodes == expected["electrodes"]


def test_pipelines_recordings_positions_and_names_are_those_of_version_01(saved):
    pipeline, expected = Pipeline.load(saved / "paper.eitmodel"), EXPECTED["paper"]
    shown = pipeline.perceive(open_dataset(saved / "dataset"))
    assert same(shown.probabilities, expected["probabilities"])
    assert same(shown.bend_angle_deg, expected["bend_angle_deg"])
    assert same(shown.touch_map.mean(axis=(1, 2)), expected["touch_map_mean"])
    for touches, known in zip(shown.touches, expected["touches"], strict=True):
        assert same(touches.triples, known)
    assert set(shown.state.tolist()) == {0, 1, 2}
    assert any(expected["touches"])
    pipeline = Pipeline.load(saved / "paper.eitmodel")
    with open_board(f"replay:{saved / 'recording'}") as board:
        estimates = [pipeline.process(frame) for frame in board.frames()]
    for estimate, known in zip(estimates, EXPECTED["paper, recording"], strict=True):
        assert (estimate.number, estimate.state.name) == (known["number"], known["state"])
        assert same(estimate.probabilities, known["probabilities"])
        assert same(estimate.bend_angle_deg, known["bend_angle_deg"])
        assert same(estimate.touches, known["touches"])
    presses = open_dataset(saved / "presses")
    found = held_out_positions(open_pipeline(saved / "positions.eitmodel"), presses)[1].place
    assert same(found, EXPECTED["positions"])
    with pytest.warns(DeprecationWarning, match="use Pipeline"):
        old = RecordedTouches.load(saved / "positions.eitmodel")
    assert same(old.found(presses)[1], EXPECTED["positions"])
    assert old.protocol is old.layout.known_protocol
    assert old.design is old.layout.known_design
    assert (old.frequency, old.extent) == pytest.approx((old.layout.frequency, None), nan_ok=True)
    assert old.described(presses).protocol == (presses.protocol or old.protocol)
    assert not hasattr(old, "colour")
    names = [line.split() for line in (DATA / "names.txt").read_text().splitlines()]
    assert len(names) == 80
    for room, name in names:
        assert hasattr(import_module(f"eitskin.{room}"), name), f"eitskin.{room}.{name}"
