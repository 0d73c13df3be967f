"""Runs of `eitskin generate` that are killed, and disks that are full, read-only or failing.

Small by default; `pytest tests/datasets/test_crashes.py --crashes 200 --timeout 0` is the long run
(Linux; mounting small disks takes root).
"""

import errno
import itertools
import os
import signal
import subprocess
import sys
import time
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from eitskin.datasets import Recipe, generate
from eitskin.datasets.recipe.scene_group import SceneGroup
from eitskin.errors import EitskinError

from shards_here import in_this_process, made_here

pytestmark = pytest.mark.slow

# Cheap shards: a killed run is to have many of them, finished and not.
RECIPE = Recipe(
    "crashes",
    seed=7,
    frames_per_shard=4,
    scenes=(SceneGroup("idle", count=24), SceneGroup("bend", count=24, angle_deg=(-20.0, 50.0))),
)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Files of a set that nothing happened to."""
    return contents(made_here(RECIPE, tmp_path_factory.mktemp("whole") / "set"))


@pytest.fixture
def crashes(request):
    """Number of trials."""
    return request.config.getoption("--crashes")


@pytest.fixture
def here(monkeypatch):
    """Shards are made in this process."""
    in_this_process(monkeypatch)


def start(out, workers):
    """A run of the command in a process of its own, which completes what is there."""
    recipe = out.with_name("recipe.toml")
    recipe.write_text(RECIPE.to_toml())
    command = "from eitskin.cli.main import run; run()"
    options = ("--out", out, "--quiet", "--resume", "--workers", str(workers))
    return subprocess.Popen(
        [sys.executable, "-c", command, "generate", recipe, *options],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )


def contents(folder):
    """Every file by name, without what killed writers left half-written."""
    return {path.name: path.read_bytes() for path in folder.glob("[!.]*")}


def shards(folder):
    return {path.name for path in folder.glob("shard-*.h5")}


def intact(folder, whole):
    """Whether each shard in the folder is, byte for byte, that of the whole set."""
    return all((folder / name).read_bytes() == whole[name] for name in shards(folder))


def assert_clean_error(out, whole):
    """A run in this process ends with one of our errors and leaves nothing but whole shards."""
    with pytest.raises(EitskinError) as caught:
        generate(RECIPE, out, resume=out.exists())
    assert caught.value.exit_code in (2, 5)
    assert "manifest.json" not in contents(out)
    assert intact(out, whole)
    assert not list(out.glob(".writing-*"))


def assert_resumes(out, whole):
    generate(RECIPE, out, resume=True)
    assert contents(out) == whole


# Kills


def workers_of(run):
    """Process numbers of the workers that a run has started, as Linux tells them."""
    try:
        children = Path(f"/proc/{run.pid}/task/{run.pid}/children").read_text().split()
        lines = {int(child): Path(f"/proc/{child}/cmdline").read_bytes() for child in children}
    except (FileNotFoundError, ProcessLookupError):  # one has ended meanwhile
        return []
    return [child for child, line in lines.items() if b"multiprocessing.spawn" in line]


def kill(run, out, rng):
    """Kill a run or one of its workers at a random moment; whether it was still running."""
    wanted = rng.integers(min(len(shards(out)), RECIPE.shards - 1), RECIPE.shards)
    while run.poll() is None and (len(shards(out)) < wanted or not workers_of(run)):
        time.sleep(0.001)
    time.sleep(rng.uniform(0.0, 0.3))  # a few shards' time
    victims = [run.pid] if rng.random() < 0.7 else workers_of(run)
    if run.poll() is not None or not victims:
        return False
    try:
        os.kill(victims[-1], signal.SIGKILL)
    except ProcessLookupError:
        return False
    return True


@pytest.mark.skipif(sys.platform != "linux", reason="finds workers by /proc")
def test_kills_at_random_moments_cost_no_finished_shard(whole, tmp_path, crashes, monkeypatch):
    rng = np.random.default_rng(0)
    killed, sets, out = 0, 0, tmp_path / "set-0"
    while killed < crashes:
        before = shards(out)
        run = start(out, rng.integers(1, 3))
        killed += kill(run, out, rng)
        code = run.wait(timeout=800)
        assert before <= shards(out)
        assert intact(out, whole)
        if code == 0:
            assert contents(out) == whole
            sets += 1
            out = tmp_path / f"set-{sets}"
    in_this_process(monkeypatch)
    assert_resumes(out, whole)


# Disks


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EIO], ids=["full", "broken"])
@pytest.mark.usefixtures("here")
def test_a_disk_that_fails_is_a_clean_error(whole, tmp_path, crashes, code):
    """Any of the writes but those of the first files is refused, and all after it."""
    rng = np.random.default_rng(code)
    for trial in range(crashes):
        out, writes = tmp_path / f"set-{trial}", itertools.count()
        first_refused = rng.integers(2, 10)

        def fsync(handle, sync=os.fsync, writes=writes, first_refused=first_refused):
            if next(writes) >= first_refused:
                raise OSError(code, os.strerror(code))
            sync(handle)

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(os, "fsync", fsync)
            assert_clean_error(out, whole)
        assert_resumes(out, whole)


@contextmanager
def small_disk(place, size):
    """A disk of `size` bytes, and a function that mounts it anew with another option."""

    def mount(*options):
        done = subprocess.run(["mount", *options, place], check=False, capture_output=True)
        return done.returncode == 0

    place.mkdir()
    if not mount("-t", "tmpfs", "-o", f"size={size}", "tmpfs"):
        pytest.skip("mounting is not permitted here")
    try:
        yield lambda option: mount("-o", f"remount,{option}")
    finally:
        subprocess.run(["umount", place], check=True)


@pytest.mark.usefixtures("here")
def test_a_full_disk_is_a_clean_error_and_more_room_is_enough(whole, tmp_path, crashes):
    """From too small for anything up to nearly enough."""
    size = sum(map(len, whole.values()))
    for number, share in enumerate(np.linspace(0.05, 0.95, max(3, min(crashes, 20)) + 1)[1::2]):
        disk = tmp_path / f"disk-{number}"
        with small_disk(disk, round(size * share / 4096) * 4096) as remount:
            assert_clean_error(disk / "set", whole)
            assert remount("size=64m")
            assert_resumes(disk / "set", whole)


@pytest.mark.usefixtures("here")
def test_a_folder_that_turns_read_only_keeps_its_shards(whole, tmp_path):
    out = tmp_path / "disk" / "set"
    with small_disk(tmp_path / "disk", 1 << 26) as remount:
        generate(RECIPE, out, shard=3)
        assert remount("ro")
        before = shards(out)
        assert_clean_error(out, whole)
        assert shards(out) == before != set()
        assert remount("rw")
        assert_resumes(out, whole)
