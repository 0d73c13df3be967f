"""Pipelines on disk: the same after loading, refused when anything is wrong with them."""

import hashlib
import json
import os
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import load_file, save_file

from eitskin.cli.commands import train
from eitskin.datasets import Dataset, State, save_dataset
from eitskin.errors import ConfigurationError, DataError, PartialError
from eitskin.geometry import SensorDesign
from eitskin.simulator import Frame, Protocol
from eitskin.training import NetworkSettings, Pipeline, PositionScore, TrainingSettings
from eitskin.training.pipeline.saved_form import (
    SUMS,
    SavedPipeline,
    read_pipeline,
    require_writable,
    write_pipeline,
)

FLAT = np.linspace(400.0, 820.0, 28)
FILES = ["README.md", "SHA256SUMS", "golden.safetensors", "pipeline.json", "weights.safetensors"]


@pytest.fixture(scope="module")
def dataset():
    """Sixty frames of nothing in particular: what is learned from them does not matter here."""
    rng = np.random.default_rng(0)
    state = np.arange(60) % 3
    x = np.full((60, 4), np.nan)
    x[state == State.TOUCH, 0] = rng.uniform(0.02, 0.04, 20)
    return Dataset.from_arrays(
        FLAT * (1 + rng.normal(size=(60, 28)) * 1e-3),
        FLAT,
        specimen=np.zeros(60),
        state=state,
        bend_angle_deg=np.where(state == State.BEND, rng.uniform(5, 50, 60), 0.0),
        touch_x=x,
        touch_y=x,
        touch_radius=np.where(np.isfinite(x), 0.0075, np.nan),
        protocol=Protocol.pairwise(8),
        design=SensorDesign.reference(),
    )


@pytest.fixture(scope="module")
def pipeline(dataset):
    brief = NetworkSettings(1e-3, epochs=1, batch=32)
    pipeline = Pipeline.fit(
        dataset, TrainingSettings(classifier=brief, postprocessor=brief, seed=3)
    )
    pipeline.metrics["bend"] = {"r2": 0.5}
    return pipeline


@pytest.fixture
def folder(pipeline, tmp_path):
    return pipeline.save(tmp_path / "some.eitmodel")


def reseal(folder):
    """What someone does who changes a file and its checksum."""
    names = [name for name in FILES if name != SUMS]
    sums = [f"{hashlib.sha256((folder / n).read_bytes()).hexdigest()}  {n}\n" for n in names]
    (folder / SUMS).write_text("".join(sums))


@pytest.mark.slow
def test_loaded_pipeline_is_the_one_that_was_saved(dataset, pipeline, folder):
    loaded = Pipeline.load(folder)
    np.testing.assert_array_equal(loaded.held_out(dataset), pipeline.held_out(dataset))
    assert len(loaded.held_out(dataset)) == 12
    rng = np.random.default_rng(1)
    frames = FLAT * (1 + rng.normal(size=(6, 28)) * 1e-3 * np.arange(6)[:, None])
    pipeline.reset()
    for number, impedance in enumerate(frames):
        frame = Frame(impedance, Protocol.pairwise(8), 0.1 * number, number)
        ours, theirs = pipeline.process(frame), loaded.process(frame)
        np.testing.assert_array_equal(ours.probabilities, theirs.probabilities)
        np.testing.assert_array_equal(ours.touch_map, theirs.touch_map)
        assert ours.bend_angle_deg == theirs.bend_angle_deg
    assert loaded.settings == pipeline.settings
    assert loaded.metrics == pipeline.metrics
    assert loaded.layout.design == pipeline.layout.design
    assert loaded.noise == pipeline.noise


def test_folder_says_what_it_is_and_holds_no_pickle(folder):
    assert sorted(path.name for path in folder.iterdir()) == FILES
    document = json.loads((folder / "pipeline.json").read_text())
    assert document["format"] == "eitskin-pipeline"
    assert document["layout"]["units"]["impedance"] == "ohm"
    assert len(document["layout"]["protocol"]["table"]) == 28
    assert document["settings"]["seed"] == 3
    assert "torch" in document["made_with"]
    card = (folder / "README.md").read_text()
    assert "150 x 60 mm sensor with 8 electrodes, 28\nmeasurements" in card
    for path in folder.iterdir():
        assert b"\x80\x02" not in path.read_bytes()[:2]
        assert not path.read_bytes().startswith(b"PK")


@pytest.mark.skipif(shutil.which("sha256sum") is None, reason="sha256sum is not installed")
def test_sums_are_what_sha256sum_reads(folder):
    subprocess.run(["sha256sum", "--check", "--strict", SUMS], cwd=folder, check=True)


@pytest.mark.parametrize("name", [name for name in FILES if name != SUMS])
def test_changed_or_missing_files_are_refused(folder, name):
    data = (folder / name).read_bytes()
    (folder / name).write_bytes(data[:-3] + bytes([data[-3] ^ 1]) + data[-2:])
    with pytest.raises(DataError, match="not the file"):
        Pipeline.load(folder)
    (folder / name).unlink()
    with pytest.raises(DataError, match="not a whole pipeline"):
        Pipeline.load(folder)


def test_a_signature_of_the_sums_is_passed_over_and_ends_with_them(folder):
    signature = folder / f"{SUMS}.sig"
    signature.write_text("-----BEGIN SSH SIGNATURE-----")
    saved = read_pipeline(folder)
    assert signature.exists()
    write_pipeline(folder, saved)
    assert not signature.exists()


def test_missing_sums_or_folder_are_refused(folder):
    (folder / SUMS).unlink()
    with pytest.raises(DataError, match="not a whole pipeline"):
        Pipeline.load(folder)
    with pytest.raises(DataError, match="no pipeline"):
        Pipeline.load(folder.parent / "other.eitmodel")


@pytest.mark.parametrize(
    "name",
    [
        "bend_angle.coefficients",
        "classifier.layers.11.weight",
        "postprocessor.layers.9.weight",
        "reconstruction.matrix",
    ],
)
def test_pipeline_that_computes_something_else_is_refused(folder, name):
    """Also where all checksums are right: golden inputs must give golden outputs."""
    weights = load_file(folder / "weights.safetensors")
    weights[name] = weights[name] * 1.5
    save_file(weights, folder / "weights.safetensors")
    reseal(folder)
    with pytest.raises(DataError, match="does not compute"):
        Pipeline.load(folder)


def test_saving_replaces_a_pipeline_and_nothing_else(pipeline, folder):
    (folder / "leftover").write_text("from an older version")
    pipeline.save(folder)
    assert sorted(path.name for path in folder.iterdir()) == FILES
    assert [path.name for path in folder.parent.iterdir()] == ["some.eitmodel"]
    precious = folder.parent / "precious.eitmodel"
    precious.mkdir()
    (precious / "thesis.tex").write_text("...")
    with pytest.raises(ConfigurationError, match="is no pipeline"):
        pipeline.save(precious)
    with pytest.raises(ConfigurationError, match=r"NAME\.eitmodel"):
        pipeline.save(folder.parent / "some.zip")


def test_failed_save_leaves_the_old_pipeline(pipeline, folder, monkeypatch):
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    written = []

    write = Path.write_bytes

    def fill_the_disk(path, data):
        if len(written) == 2:
            raise OSError(28, "No space left")
        write(path, data)
        written.append(path)

    monkeypatch.setattr(Path, "write_bytes", fill_the_disk)
    with pytest.raises(PartialError, match="No space left"):
        pipeline.save(folder)
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before
    assert [path.name for path in folder.parent.iterdir()] == ["some.eitmodel"]


def test_the_pipeline_that_comes_along_is_read_wherever_one_is():
    assert read_pipeline("reference.eitmodel").document["kind"] == "perception"


@pytest.mark.slow
def test_commands_train_and_evaluate(dataset, tmp_path, capsys):
    data, out = tmp_path / "data", tmp_path / "some.eitmodel"
    save_dataset(dataset, data)
    train.command(data, out=out, epochs=1, preset="quick", seed=4, as_json=True, quiet=True)
    trained = json.loads(capsys.readouterr().out)
    assert trained["frames"] == 36
    assert Pipeline.load(out).settings == TrainingSettings.preset("quick", 4).with_epochs(1)
    train.evaluate(out, data, as_json=True)
    said = capsys.readouterr()
    report = json.loads(said.out)
    assert report["frames"] == 12
    assert "12 frames" in said.err
    kept = trained["metrics"]
    assert (report["states"], report["bend"]) == (kept["states"], kept["bend"])
    train.evaluate(out, data)
    table = capsys.readouterr().out
    assert all(figure in table for figure in ("4.8 +- 2.8 mm", "0.94", "> 97 %", "606.6 ms"))


def test_a_place_that_cannot_be_is_refused_before_training(tmp_path):
    with pytest.raises(ConfigurationError, match=r"NAME\.eitmodel"):
        train.command(tmp_path / "absent", out=tmp_path / "model.zip")


@pytest.mark.slow
def test_recorded_touches_are_saved_in_the_same_format(tmp_path):
    rng = np.random.default_rng(0)
    places = rng.uniform(-0.05, 0.05, size=(40, 2))
    x, y = np.full((2, 40, 4), np.nan)
    x[:, 0], y[:, 0] = places.T
    own = rng.uniform(-0.05, 0.05, size=(6, 2))
    change = np.exp(-(((places[:, None] - own) ** 2).sum(axis=2)) / 2e-3)
    values = 100.0 * (1 + 0.02 * change)
    recording = Dataset.from_arrays(
        values, np.full(6, 100.0), specimen=np.zeros(40), state=np.ones(40), touch_x=x, touch_y=y
    )
    learned = Pipeline.fit(recording, TrainingSettings("touch position"))
    learned.metrics.update(PositionScore.of(learned, recording).as_dict())
    folder = learned.save(tmp_path / "skin.eitmodel")
    assert sorted(path.name for path in folder.iterdir()) == FILES
    loaded = Pipeline.load(folder)
    assert PositionScore.of(loaded, recording) == PositionScore.of(learned, recording)
    assert loaded.metrics["frames"] == 8
    assert loaded.settings.method == loaded.method.KIND == "touch position"
    weights = load_file(folder / "weights.safetensors")
    weights["grid.low"] += 0.01
    save_file(weights, folder / "weights.safetensors")
    reseal(folder)
    with pytest.raises(DataError, match="does not compute"):
        Pipeline.load(folder)


def test_a_place_that_may_not_be_written_to_is_refused_before_the_work(tmp_path, monkeypatch):
    require_writable(tmp_path / "new" / "deep.eitmodel")
    (tmp_path / "file").write_text("no folder")
    with pytest.raises(ConfigurationError, match="may not be written"):
        require_writable(tmp_path / "file" / "a.eitmodel")
    monkeypatch.setattr(os, "access", lambda *_: False)
    with pytest.raises(ConfigurationError, match="may not be written"):
        require_writable(tmp_path / "a.eitmodel")


def test_a_pipeline_is_replaced_where_that_is_wanted(tmp_path):
    made = tmp_path / "a.eitmodel"
    require_writable(made, replace=False)
    made.mkdir()
    (made / "SHA256SUMS").touch()
    require_writable(made)
    with pytest.raises(ConfigurationError, match=r"a\.eitmodel exists.*--replace"):
        require_writable(made, replace=False)


def fitted(outputs):
    """Whether outputs of a fit of four frames count as golden ones, the last of which is zero."""
    golden = np.array([[3.0, 4.0], [5.0, 0.0], [0.0, 5.0], [0.0, 0.0]])
    saved = SavedPipeline({}, {}, {"output.map": golden})
    try:
        saved.require_golden({"map": golden + outputs}, fitted=True)
    except DataError:
        return False
    return True


def test_ends_of_fits_may_differ_a_little_and_in_few_frames_by_more():
    changed = np.zeros((4, 2))
    for row, change, same in (
        (0, 0.2, True),
        (0, 4.0, True),  # another explanation of one frame
        (1, 4.0, False),  # and of another: most frames differ
    ):
        changed[row] = change
        assert fitted(changed) == same
    assert not fitted(np.array([[0.0, 0.0]] * 3 + [[0.3, 0.3]]))  # where there was no touch
    assert not fitted(np.full((4, 2), np.nan))
    with pytest.raises(DataError, match="does not compute"):
        SavedPipeline({}, {}, {"output.map": np.ones(3)}).require_golden(
            {"map": np.array([1.0, 1.0, 1.01])}
        )
