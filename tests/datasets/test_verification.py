"""Looking through datasets for damage."""

import hashlib
import json

import numpy as np
import pytest

from eitskin.datasets import Dataset, save_dataset, verify, write_shard
from eitskin.datasets.store.shard import shard_bytes

from small_dataset import make


@pytest.fixture
def folder(tmp_path):
    save_dataset(make(50), tmp_path / "set", frames_per_shard=10)
    return tmp_path / "set"


def problems(folder):
    return {each.file: each.problem for each in verify(folder).damage}


def test_a_sound_set_is_said_to_be_sound(folder, tmp_path):
    seen = []
    verdict = verify(folder, lambda *counts: seen.append(counts))
    assert (verdict.shards, verdict.frames, verdict.damage) == (5, 50, ())
    assert seen == [(number, 5) for number in range(6)]
    save_dataset(Dataset.from_arrays(np.ones((3, 5))), tmp_path / "measured")
    assert verify(tmp_path / "measured").damage == ()


def test_all_damage_is_listed(folder):
    flipped = folder / "shard-000001.h5"
    content = bytearray(flipped.read_bytes())
    content[5000] ^= 1
    flipped.write_bytes(content)
    (folder / "shard-000002.h5").unlink()
    cut = folder / "shard-000003.h5"
    cut.write_bytes(cut.read_bytes()[:3000])
    (folder / "shard-000007.h5").write_bytes(shard_bytes(make(3)))
    (folder / "recipe.toml").write_text("another")
    (folder / "notes.txt").write_text("mine")
    verdict = verify(folder)
    assert (verdict.shards, verdict.frames) == (2, 20)
    found = problems(folder)
    assert set(found) == {
        "recipe.toml",
        *(f"shard-00000{number}.h5" for number in (1, 2, 3, 7)),
    }
    assert "expected SHA-256" in found["shard-000001.h5"]
    assert "No such file" in found["shard-000002.h5"]
    assert "expected SHA-256" in found["shard-000003.h5"]
    assert "manifest.json" in found["shard-000007.h5"]
    assert "expected SHA-256" in found["recipe.toml"]
    (folder / "manifest.json").unlink()
    verdict = verify(folder)  # the shards all the same
    assert (verdict.shards, verdict.frames) == (2, 20)
    assert set(problems(folder)) == set(found) - {"shard-000002.h5", "recipe.toml"} | {
        "manifest.json"
    }
    assert "eitskin generate" in problems(folder / "absent")["manifest.json"]


def rewritten(folder, number, **changes):
    """A shard of other content, to which the manifest has been made to agree."""
    path = folder / f"shard-00000{number}.h5"
    write_shard(path, make(**({"n": 10} | changes)), 10 * number)
    manifest = json.loads((folder / "manifest.json").read_text())
    manifest["shards"][number]["sha256"] = hashlib.sha256(path.read_bytes()).hexdigest()
    (folder / "manifest.json").write_text(json.dumps(manifest))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"n": 9}, "must hold 10 frames, got 9"),
        ({"seed": 8}, "recipe or seed"),
        ({"recipe": "other"}, "recipe or seed"),
        ({"frequency": 1e3}, "not made together"),
    ],
)
def test_shards_of_another_set_do_not_belong(folder, changes, message):
    rewritten(folder, 2, **changes)
    assert message in problems(folder)["shard-000002.h5"]
