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


def without(name):
    return {"document": lambda content: content.pop(name)}


def array(name, value):
    def change(arrays):
        arrays[name] = np.asarray(value, dtype=arrays[name].dtype)

    return {"weights": change}


def layout(name, value):
    return {"document": lambda content: content["layout"].__setitem__(name, value)}


HOSTILE = {
    "noise of nan": (key("noise", float("nan")), None),
    "noise of text": (key("noise", "0.1"), None),
    "negative noise": (key("noise", -1), None),
    "huge noise": (key("noise", 1e308), None),
    "kind": (key("kind", {"a": 1}), None),
    "format": (key("format", "x" * 10**6), None),
    "other format": (key("format", "else"), "got 'else'"),
    "version": (key("format_version", "1"), None),
    "newer version": (key("format_version", 2), r"version 2.*up to 1"),
    **{
        f"no {name}": (without(name), name)
        for name in ("layout", "settings", "noise", "kind", "format_version")
    },
    "layout of another type": (key("layout", 7), None),
    "frequency": (layout("frequency", -1.0), None),
    "spread": (layout("spread", 1e9), None),
    "negative references": (array("layout.reference", -np.ones(28)), None),
    "short references": (array("layout.reference", np.ones(27)), None),
    "no references": ({"weights": lambda arrays: arrays.pop("layout.reference")}, "reference"),
    "angles": (array("curves.angle_deg", [-1e6, 1e6]), None),
    "nan weights": (array("features.middle", np.full(28, np.nan)), None),
    "no weights": ({"weights": lambda arrays: arrays.pop("features.middle")}, "middle"),
    "huge weights": (array("response.scale", [1e300, 1.0]), None),
    "noise of channels": (array("noise", np.zeros(28)), None),
    "shape": (array("proposals.weight0", np.zeros((512, 3))), None),
    "scalars": (array("scalars", [0.0] * 5), None),
    "brackets": ({"raw": b"[" * 200_000}, None),
    "digits": ({"raw": b'{"format": ' + b"9" * 5000 + b"}"}, None),
    "list": ({"raw": b"[]"}, "no pipeline"),
    "no text": ({"raw": b"\xff{"}, "no pipeline"),
}


def test_each_is_refused_in_one_short_sentence(tmp_path):
    for number, (name, (change, words)) in enumerate(HOSTILE.items()):
        folder = edited(tmp_path / f"{number}.eitmodel", **change)
        with pytest.raises(EitskinError, match=words) as refused:
            Pipeline.load(folder)
        assert len(str(refused.value)) < 600, name
