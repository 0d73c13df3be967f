"""Pipelines on disk: the same after loading, refused when anything is wrong with them."""

import hashlib
import json
import os
import shutil
from contextlib import nullcontext

import numpy as np
import pytest
from safetensors.numpy import load_file, save_file

from eitskin.cli.commands import train
from eitskin.errors import ConfigurationError, DataError, EitskinError
from eitskin.training import NetworkSettings, Pipeline, TrainingSettings
from eitskin.training.method import input_spec
from eitskin.training.pipeline.saved_form import (
    SHIPPED_PATH,
    SUMS,
    SavedPipeline,
    require_writable,
)

from made_up_sensor import frames

FILES = ["README.md", "SHA256SUMS", "golden.safetensors", "pipeline.json", "weights.safetensors"]


@pytest.fixture
def folder(tmp_path):
    """A copy of the pipeline that ships."""
    return shutil.copytree(SHIPPED_PATH, tmp_path / "some.eitmodel")


def edit(folder, document=None, weights=None, raw=None):
    """Change contents of a pipeline, and the sums of these, as who wants to deceive does."""
    path = folder / "pipeline.json"
    if document:
        content = json.loads(path.read_text())
        document(content)
        path.write_text(json.dumps(content))
    if raw is not None:
        path.write_bytes(raw)
    if weights:
        arrays = load_file(folder / "weights.safetensors")
        weights(arrays)
        save_file(arrays, folder / "weights.safetensors")
    names = [line[66:] for line in (folder / SUMS).read_text().splitlines()]
    sums = [f"{hashlib.sha256((folder / n).read_bytes()).hexdigest()}  {n}\n" for n in names]
    (folder / SUMS).write_text("".join(sums))


def array(name, change):
    def edited(arrays):
        arrays[name] = np.asarray(change(arrays[name]), dtype=arrays[name].dtype)

    return {"weights": edited}


@pytest.mark.slow
def test_a_loaded_pipeline_is_the_one_that_was_saved(tmp_path, monkeypatch):
    """Of sixty frames and few pixels: what is learned from them does not matter here."""
    monkeypatch.setattr(input_spec, "PIXELS", 640)
    dataset, brief = frames(60, most=1, specimens=1), NetworkSettings(1e-3, epochs=1, batch=32)
    settings = TrainingSettings(classifier=brief, postprocessor=brief, seed=3)
    pipeline = Pipeline.fit(dataset, settings)
    pipeline.metrics["bend"] = {"r2": 0.5}
    folder = pipeline.save(tmp_path / "some.eitmodel")
    loaded = Pipeline.load(folder)
    np.testing.assert_array_equal(loaded.held_out(dataset), pipeline.held_out(dataset))
    ours, theirs = pipeline.perceive(dataset), loaded.perceive(dataset)
    for name in ("probabilities", "touch_map", "bend_angle_deg"):
        np.testing.assert_array_equal(getattr(ours, name), getattr(theirs, name))
    for name in ("settings", "metrics", "noise"):
        assert getattr(loaded, name) == getattr(pipeline, name)
    assert loaded.layout.document() == pipeline.layout.document()
    for number, layer in enumerate(("classifier.layers.11", "postprocessor.layers.9")):
        changed = shutil.copytree(folder, tmp_path / f"{number}.eitmodel")
        edit(changed, **array(f"{layer}.weight", lambda values: 1.5 * values))
        with pytest.raises(DataError, match="does not compute"):
            Pipeline.load(changed)


@pytest.mark.parametrize("name", FILES)
def test_changed_or_missing_files_are_refused(folder, name):
    data = (folder / name).read_bytes()
    (folder / name).write_bytes(data[:-3] + bytes([data[-3] ^ 1]) + data[-2:])
    with pytest.raises(DataError, match="not the file"):
        Pipeline.load(folder)
    (folder / name).unlink()
    with pytest.raises(DataError, match="not a whole pipeline"):
        Pipeline.load(folder)
    with pytest.raises(DataError, match="no pipeline"):
        Pipeline.load(folder.parent / "other.eitmodel")


@pytest.mark.parametrize("name", ["response.weight1", "angles.weight3", "response.output", "noise"])
def test_a_pipeline_that_computes_something_else_is_refused(folder, name):
    """Also where all checksums are right: golden inputs must give golden outputs."""
    edit(folder, **array(name, lambda values: 4.0 * values))
    with pytest.raises(DataError, match="does not compute"):
        Pipeline.load(folder)


def test_saving_replaces_a_pipeline_with_its_signature_and_nothing_else(folder):
    signature = folder / f"{SUMS}.sig"
    signature.write_text("-----BEGIN SSH SIGNATURE-----")
    pipeline = Pipeline.load(folder)
    assert signature.exists()
    pipeline.save(folder)
    assert sorted(path.name for path in folder.iterdir()) == FILES
    assert [path.name for path in folder.parent.iterdir()] == ["some.eitmodel"]
    precious = folder.parent / "precious.eitmodel"
    precious.mkdir()
    (precious / "thesis.tex").write_text("...")
    with pytest.raises(ConfigurationError, match="is no pipeline"):
        pipeline.save(precious)


def test_a_path_that_cannot_be_a_pipeline_is_refused_before_the_work(tmp_path, monkeypatch):
    with pytest.raises(ConfigurationError, match=r"NAME\.eitmodel"):
        train.command(tmp_path / "absent", out=tmp_path / "model.zip")
    made = tmp_path / "new" / "deep.eitmodel"
    require_writable(made, replace=False)
    made.mkdir(parents=True)
    (made / SUMS).touch()
    require_writable(made)
    with pytest.raises(ConfigurationError, match=r"deep\.eitmodel exists.*--replace"):
        require_writable(made, replace=False)
    (tmp_path / "file").write_text("no folder")
    with pytest.raises(ConfigurationError, match="may not be written"):
        require_writable(tmp_path / "file" / "a.eitmodel")
    monkeypatch.setattr(os, "access", lambda *_: False)
    with pytest.raises(ConfigurationError, match="may not be written"):
        require_writable(tmp_path / "a.eitmodel")


@pytest.mark.parametrize(
    ("changes", "same"),
    [
        ({0: 0.2}, True),
        ({0: 4.0}, True),  # another explanation of one frame
        ({0: 4.0, 1: 4.0}, False),  # and of another: most frames differ
        ({3: 0.3}, False),  # where there was no touch
        ({0: np.nan}, False),
    ],
)
def test_ends_of_fits_may_differ_a_little_and_in_few_frames_by_more(changes, same):
    golden = np.array([[3.0, 4.0], [5.0, 0.0], [0.0, 5.0], [0.0, 0.0]])
    saved, found = SavedPipeline({}, {}, {"output.map": golden}), golden.copy()
    for row, change in changes.items():
        found[row] += change
    with nullcontext() if same else pytest.raises(DataError):
        saved.require_golden({"map": found}, fitted=True)


def key(name, value, part=None):
    def edited(content):
        (content[part] if part else content)[name] = value

    return {"document": edited}


HOSTILE = {
    **{f"noise {value}": (key("noise", value), None) for value in (float("nan"), "0.1", -1, 1e308)},
    "format": (key("format", "x" * 10**6), None),
    "other format": (key("format", "else"), "got 'else'"),
    "newer version": (key("format_version", 2), r"version 2.*up to 1"),
    **{
        f"no {name}": ({"document": lambda content, name=name: content.pop(name)}, name)
        for name in ("layout", "settings", "noise", "kind", "format_version")
    },
    "frequency": (key("frequency", -1.0, "layout"), "frequency"),
    "spread": (key("spread", 1e9, "layout"), "spread"),
    "negative references": (array("layout.reference", lambda _: -np.ones(28)), "magnitudes"),
    "short references": (array("layout.reference", lambda _: np.ones(27)), "magnitudes"),
    "no references": ({"weights": lambda arrays: arrays.pop("layout.reference")}, "reference"),
    "angles": (array("curves.angle_deg", lambda _: [-1e6, 1e6]), "angles up to"),
    "nan weights": (array("features.middle", lambda _: np.full(28, np.nan)), "finite"),
    "no weights": ({"weights": lambda arrays: arrays.pop("features.middle")}, "middle"),
    "huge weights": (array("response.scale", lambda _: [1e300, 1.0]), "finite"),
    "noise of channels": (array("noise", lambda _: np.zeros(28)), "noise"),
    "shape": (array("proposals.weight0", lambda _: np.zeros((512, 3))), None),
    "scalars": (array("scalars", lambda _: [0.0] * 5), None),
    "no text": ({"raw": b"\xff{"}, "no pipeline"),
}


@pytest.mark.slow
def test_nonsense_with_right_sums_is_refused_in_one_short_sentence(tmp_path):
    for number, (name, (change, words)) in enumerate(HOSTILE.items()):
        folder = tmp_path / f"{number}.eitmodel"
        shutil.copytree(SHIPPED_PATH, folder)
        edit(folder, **change)
        with pytest.raises(EitskinError, match=words) as refused:
            Pipeline.load(folder)
        assert len(str(refused.value)) < 600, name
