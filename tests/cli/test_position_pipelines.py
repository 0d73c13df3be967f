"""Pipelines of touch positions in every command that takes a saved pipeline."""

import json
from dataclasses import replace

import numpy as np
import pytest
from command_line import run
from touched_dataset import touched_dataset

from eitskin.datasets import State, save_dataset
from eitskin.geometry import SensorDesign
from eitskin.hardware.virtual import virtual_board
from eitskin.simulator import Protocol
from eitskin.training import Pipeline, TrainingSettings

from loopback import FLAT, FakeSimulator

pytestmark = pytest.mark.slow

PROTOCOL = Protocol.pairwise(8)
BOARD = "virtual:?speed=max"


def presses(n=60):
    """Presses of one sensor whose channels change smoothly with the place."""
    rng = np.random.default_rng(0)
    places = rng.uniform([0.02, 0.01], [0.13, 0.05], (n, 2))
    phase = np.linspace(0.0, 3.0, 28)
    change = 0.01 * np.cos(20.0 * places[:, :1] + phase) + 0.01 * np.sin(
        40.0 * places[:, 1:] * phase
    )
    return touched_dataset(
        FLAT * (1.0 + change),
        FLAT,
        places,
        touch_reference=np.tile(FLAT, (n, 1)),
        state=np.full(n, State.TOUCH),
        time=np.arange(n),
        protocol=PROTOCOL,
        design=SensorDesign.reference(),
    )


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Dataset `mine` and its pipeline `mine.eitmodel`."""
    made = tmp_path_factory.mktemp("positions")
    data = presses()
    save_dataset(data, made / "mine")
    Pipeline.fit(data, TrainingSettings("touch position")).save(made / "mine.eitmodel")
    return made


@pytest.fixture(autouse=True)
def _fake_sensor(monkeypatch):
    monkeypatch.setattr(virtual_board, "Simulator", lambda *_, **__: FakeSimulator())


def test_evaluate_and_train_write_a_report(folder, tmp_path):
    model, data = folder / "mine.eitmodel", folder / "mine"
    run("evaluate", model, data, "--out", tmp_path / "report")
    report = json.loads((tmp_path / "report" / "report.json").read_text())
    assert report["report"]["frames"] == 12
    assert report["report"]["mean_error_mm"] < report["report"]["guess_error_mm"]
    assert set(report["pictures"]) == {"error_vectors.png", "localisation_errors.png"}
    assert all((tmp_path / "report" / name).stat().st_size > 5000 for name in report["pictures"])
    assert "mean error [mm]" in (tmp_path / "report" / "report.md").read_text()
    run("train", data, "--out", tmp_path / "again.eitmodel", "--report", tmp_path / "report")
    again = json.loads((tmp_path / "report" / "report.json").read_text())
    assert again["report"] == report["report"]
    few = presses(7)
    save_dataset(replace(few, impedance=np.roll(few.impedance, 3, axis=0)), tmp_path / "few")
    said = run("train", tmp_path / "few", "--out", tmp_path / "few.eitmodel").stderr
    assert said.count("warning: ") == 2  # of few touches, and of an error like that of a guess


def test_check_compares_with_a_stored_reference_alone(folder, tmp_path):
    model, zero = folder / "mine.eitmodel", tmp_path / "zero.json"
    said = run("check", model, "--board", BOARD)
    assert "without expected values" in said.output
    run("tare", model, "--board", BOARD, "--out", zero)
    run("check", model, "--board", BOARD, "--reference", zero, code=0)
    broken = f"{BOARD}&faults=shorted_pair@0:3"
    said = run("check", model, "--board", broken, "--reference", zero, "--json", "-q", code=4)
    found = json.loads(said.stdout)["findings"]
    assert any(PROTOCOL.labels[3] in each["channels"] for each in found)
