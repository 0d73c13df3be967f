"""`eitskin train --report` and `evaluate --out`: the report folders of the paper's stages."""

import json

import numpy as np
import pytest

from eitskin.cli.commands import train
from eitskin.datasets import State, save_dataset
from eitskin.training import Pipeline, TrainingSettings

from on_demand import OnDemand
from small_dataset import make

pytestmark = pytest.mark.slow

figure = OnDemand("matplotlib.figure")


@pytest.fixture(scope="module")
def dataset():
    """Frames of nothing in particular: what is learned from them does not matter here."""
    state = np.tile([State.TOUCH, State.BEND, State.TOUCH, State.IDLE], 15)
    return make(60, specimens=1, state=state, status=np.zeros((60, 28)), episode=np.zeros(60))


@pytest.fixture(scope="module")
def trained(dataset, tmp_path_factory):
    """A folder with the dataset, a pipeline trained on it for an epoch, and its report."""
    folder = tmp_path_factory.mktemp("trained")
    save_dataset(dataset, folder / "data")
    report = folder / "report"
    train.command(
        folder / "data",
        out=folder / "some.eitmodel",
        epochs=1,
        preset="quick",
        report=report,
        quiet=True,
    )
    return folder


def read(folder):
    return json.loads((folder / "report.json").read_text())


def test_training_writes_a_report_with_curves_and_reconstructions(trained, dataset):
    report = read(trained / "report")
    assert report["report"]["frames"] == 12
    settings = Pipeline.load(trained / "some.eitmodel").settings
    assert settings == TrainingSettings.preset("quick").with_epochs(1)
    assert set(report["losses"]) == {"state classifier", "touch map"}
    assert all(len(losses["training"]) == 1 for losses in report["losses"].values())
    assert all(len(losses["validation"]) == 1 for losses in report["losses"].values())
    assert set(report["report"]["touches"]["1"]["ssim"]) == {
        "static",
        "dynamic",
        "touch_map",
        "empty",
    }
    assert {"training_curves.png", "touch_maps_angles.png"} <= report["pictures"].keys()
    assert all((trained / "report" / name).is_file() for name in report["pictures"])
    assert report["provenance"]["seed of these frames"] == str(dataset.seed)


def test_a_saved_pipeline_gives_the_same_report(trained, tmp_path, capsys, monkeypatch):
    """Without writing images, which takes most of a report and has tests elsewhere."""
    monkeypatch.setattr(figure.Figure, "savefig", lambda _, path: path.write_bytes(b"PNG"))
    train.evaluate(trained / "some.eitmodel", trained / "data", out=tmp_path / "again")
    said = capsys.readouterr()
    assert "empty picture" in said.out
    assert "structural_similarity" in " ".join(said.out.split())
    first, again = read(trained / "report"), read(tmp_path / "again")
    for name in ("states", "bend", "touches", "untouched"):
        assert first["report"][name] == again["report"][name]
    assert first["losses"] == again["losses"]
    assert first["pictures"].keys() == again["pictures"].keys()
    assert {"machine", "versions", "date"} <= again["provenance"].keys()
