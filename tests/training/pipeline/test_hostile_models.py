"""Saved pipelines whose hashes are right and whose numbers are nonsense."""

import hashlib
import json
import shutil

import numpy as np
import pytest
from safetensors.numpy import load_file, save_file

from eitskin.errors import EitskinError
from eitskin.training import Pipeline
from eitskin.training.pipeline.saved_form import SHIPPED, SUMS


def edited(folder, document=None, weights=None, raw=None):
    """Copy of the shipped pipeline with other contents, and the sums of these."""
    shutil.copytree(SHIPPED, folder)
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
    return folder


def key(name, value):
    return {"document": lambda content: content.__setitem__(name, value)}


def array(name, value):
    def change(arrays):
        arrays[name] = np.asarray(value, dtype=arrays[name].dtype)

    return {"weights": change}


def layout(name, value):
    return {"document": lambda content: content["layout"].__setitem__(name, value)}


HOSTILE = {
    "noise of nan": key("noise", float("nan")),
    "noise of text": key("noise", "0.1"),
    "negative noise": key("noise", -1),
    "huge noise": key("noise", 1e308),
    "kind": key("kind", {"a": 1}),
    "format": key("format", "x" * 10**6),
    "version": key("format_version", "1"),
    "no layout": key("layout", 7),
    "frequency": layout("frequency", -1.0),
    "spread": layout("spread", 1e9),
    "negative references": array("layout.reference", -np.ones(28)),
    "short references": array("layout.reference", np.ones(27)),
    "angles": array("curves.angle_deg", [-1e6, 1e6]),
    "nan weights": array("features.middle", np.full(28, np.nan)),
    "huge weights": array("response.scale", [1e300, 1.0]),
    "noise of channels": array("noise", np.zeros(28)),
    "shape": array("proposals.weight0", np.zeros((512, 3))),
    "scalars": array("scalars", [0.0] * 5),
    "brackets": {"raw": b"[" * 200_000},
    "digits": {"raw": b'{"format": ' + b"9" * 5000 + b"}"},
    "list": {"raw": b"[]"},
}


def test_each_is_refused_in_one_short_sentence(tmp_path):
    for number, (name, change) in enumerate(HOSTILE.items()):
        folder = edited(tmp_path / f"{number}.eitmodel", **change)
        with pytest.raises(EitskinError) as refused:
            Pipeline.load(folder)
        assert len(str(refused.value)) < 600, name
