"""`eitskin generate` and `dataset`: what they print, their exit codes, Ctrl-C."""

import itertools
import json
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from command_line import printed_json, run

from eitskin.config import parse_toml
from eitskin.datasets import Recipe, open_dataset, save_dataset
from eitskin.datasets.generation.shard_simulation import simulate_shard
from eitskin.datasets.store.shard import shard_bytes
from eitskin.errors import DataError

from shards_here import in_this_process
from small_dataset import assert_same, make

pytestmark = pytest.mark.slow

RECIPE = """
name = "cheap"
seed = 4
frames_per_shard = 8
[[scenes]]
state = "bend"
count = {count}
angle_deg = [10, 10]
"""
# A shell's background jobs ignore Ctrl-C, and so would what they start.
COMMAND = """
import signal
signal.signal(signal.SIGINT, signal.default_int_handler)
from eitskin.cli.entry import run
run()
"""


@pytest.fixture
def recipe(tmp_path):
    path = tmp_path / "cheap.toml"
    path.write_text(RECIPE.format(count=24))
    return path


def test_a_recipe_by_its_path_is_made_and_a_dry_run_writes_nothing(recipe, tmp_path, monkeypatch):
    said = run("generate", recipe, "--out", tmp_path / "set", "--dry-run").stdout
    assert "24 frames in 3 shards, about" in said
    assert list(tmp_path.iterdir()) == [recipe]
    in_this_process(monkeypatch)
    backwards = itertools.count(2e9, -3600)  # a clock that is set back by an hour at every look
    monkeypatch.setattr(time, "time", lambda: next(backwards))
    found = printed_json("generate", recipe, "--out", tmp_path / "set", "--workers", 1)
    assert min(found["seconds"], found["frames_per_second"]) > 0
    assert (found["frames"], found["made"], found["complete"]) == (24, 24, True)
    assert len(open_dataset(tmp_path / "set")) == 24
    again = printed_json("generate", recipe, "--out", tmp_path / "set", "--resume")
    assert (again["frames"], again["made"], again["replaced"]) == (24, 0, [])
    (tmp_path / "set" / "shard-000001.h5").write_bytes(b"rubbish")
    ran = run("generate", recipe, "--out", tmp_path / "set", "--resume", "--quiet")
    assert "made again: shard-000001.h5" in ran.stdout
    ran = run("generate", recipe, "--out", tmp_path / "one", "--shard", 2)
    assert "8 frames" in ran.stdout
    assert "missing" in ran.stdout.replace("\n", " ")
    made = simulate_shard(parse_toml(Recipe, recipe.read_text()), 2)
    assert (tmp_path / "one" / "shard-000002.h5").read_bytes() == shard_bytes(made, 16)


def test_interrupted_it_says_how_to_go_on(recipe, tmp_path):
    """As Ctrl-C twice in a terminal: exit code 130, and a line to copy that finishes the set."""
    recipe.write_text(RECIPE.format(count=20000))
    out = tmp_path / "a set"
    given = ["generate", str(recipe), "--out", str(out), "--seed", "9", "--workers", "1", "--quiet"]
    with subprocess.Popen(
        [sys.executable, "-c", COMMAND, *given],
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    ) as process:
        while not list(out.glob("shard-*.h5")) and process.poll() is None:
            time.sleep(0.02)
        os.killpg(process.pid, signal.SIGINT)
        os.killpg(process.pid, signal.SIGINT)
        _, said = process.communicate(timeout=600)
    assert process.returncode == 130
    assert said.splitlines()[0].endswith(
        f"continue with: eitskin generate {recipe} --out '{out}' --seed 9 --resume"
    )
    assert "Traceback" not in said


# eitskin dataset


def test_info_verify_and_compact_tell_of_sets_and_shards(tmp_path):
    save_dataset(make(40), tmp_path / "set", frames_per_shard=20)
    found = printed_json("dataset", "info", tmp_path / "set")
    assert (found["frames"], found["shards"], found["channels"]) == (40, 2, 28)
    assert found["states"] == {"touch": 20, "bend": 20}
    assert found["touches_per_frame"] == {"0": 20, "1": 20}
    assert found["touch_x_mm"] == {"from": 50.0, "to": 50.0}
    assert (found["electrodes"], found["specimens"], found["seed"]) == (8, 2, 7)
    data = make(40)
    assert found["flagged_values"] == np.count_nonzero(data.status)
    said = run("dataset", "info", tmp_path / "set").stdout
    assert "touch: 20, bend: 20" in said
    assert "50 to 50" in said
    assert printed_json("dataset", "info", tmp_path / "set" / "shard-000001.h5")["frames"] == 20
    folder = tmp_path / "verified"
    save_dataset(make(40), folder, frames_per_shard=10)
    sound = run("dataset", "verify", folder)
    assert sound.exit_code == 0
    assert "40 frames in 4 shards, all sound" in sound.stdout
    (folder / "shard-000001.h5").write_bytes(b"rubbish")
    (folder / "shard-000003.h5").unlink()
    ran = run("dataset", "verify", folder, "--json", "--quiet")
    assert ran.exit_code == DataError.exit_code == 3
    found = json.loads(ran.stdout)
    assert (found["sound"], found["shards"], found["frames"]) == (False, 2, 20)
    assert [each["file"] for each in found["damage"]] == ["shard-000001.h5", "shard-000003.h5"]
    assert "shard-000003.h5" in run("dataset", "verify", folder).stdout
    folder = tmp_path / "old"
    save_dataset(make(40), folder, frames_per_shard=10)
    found = printed_json("dataset", "compact", folder, "--out", tmp_path / "new")
    assert (found["frames"], found["shards"], found["format_version"]) == (40, 1, 2)
    assert_same(open_dataset(tmp_path / "new"), make(40))
    said = run("dataset", "compact", folder, "--out", tmp_path / "cut", "--frames-per-shard", 0)
    assert "40 frames in 4 shards" in said.stdout
