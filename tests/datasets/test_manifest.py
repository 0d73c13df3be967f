"""Manifests: what does not fit, rubbish, and every bit that flips."""

import json

import pytest

from eitskin.datasets import open_dataset, save_dataset, write_shard
from eitskin.datasets.store.schema import FORMAT_VERSION
from eitskin.errors import DataError

from small_dataset import make


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"format_version": FORMAT_VERSION + 1, "new": 1}, "newer than .* upgrade"),
        ({"format": "other"}, "expected format"),
        ({"frames": 41}, r"41 frames.*40"),
        ({"shards": []}, r"40 frames.*0"),
        ({"seed": "x"}, "not a manifest"),
        ({"seed": int("9" * 4000)}, "not a manifest"),
        ({"shards": [{"name": "a\0", "first_index": 0, "count": 40, "sha256": ""}]}, "beside"),
        ({"shards": [{"name": "a", "first_index": 0, "count": 1 << 40, "sha256": ""}]}, "frames"),
    ],
)
def test_manifests_that_do_not_fit_are_refused(tmp_path, change, message):
    save_dataset(make(), tmp_path / "set")
    path = tmp_path / "set" / "manifest.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    with pytest.raises(DataError, match=message):
        open_dataset(tmp_path / "set")


def test_manifest_may_not_lead_out_of_its_folder(tmp_path):
    save_dataset(make(), tmp_path / "set")
    write_shard(tmp_path / "elsewhere.h5", make())
    path = tmp_path / "set" / "manifest.json"
    content = json.loads(path.read_text())
    content["shards"][0]["name"] = "../elsewhere.h5"
    path.write_text(json.dumps(content))
    with pytest.raises(DataError, match="manifest"):
        open_dataset(tmp_path / "set")


@pytest.mark.parametrize("content", [b"", b"[]", b"7", b"{", b"\xff", b"[" * 200_000])
def test_rubbish_for_a_manifest_is_refused(tmp_path, content):
    (tmp_path / "manifest.json").write_bytes(content)
    with pytest.raises(DataError, match="manifest"):
        open_dataset(tmp_path)
