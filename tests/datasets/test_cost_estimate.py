"""What a dataset will cost, and refusing a disk that has no room for it."""

import shutil
from collections import namedtuple
from types import SimpleNamespace

import pytest

from eitskin.datasets import Recipe, generate
from eitskin.datasets.generation import preparation
from eitskin.datasets.generation.preparation import estimate_cost, free_bytes, solved_frames
from eitskin.datasets.recipe.scene_group import SceneGroup
from eitskin.errors import ConfigurationError
from eitskin.geometry import Plates

RECIPE = Recipe(
    "cheap",
    seed=2,
    frames_per_shard=50,
    scenes=(SceneGroup("bend", count=120, angle_deg=(10.0, 10.0)),),
)
LEAST_BYTES = 120 * 28 * 4
Usage = namedtuple("Usage", "total used free")


@pytest.mark.slow
def test_size_is_that_of_the_files(tmp_path):
    found = estimate_cost(RECIPE, tmp_path / "set", workers=1)
    assert (found.frames, found.shards) == (120, 3)
    assert 16 <= found.measured_frames <= 50
    assert found.seconds > 0
    assert found.megabytes_free == pytest.approx(free_bytes(tmp_path) / 1e6, rel=0.1)
    assert list(tmp_path.iterdir()) == []
    generate(RECIPE, tmp_path / "set", workers=1)
    size = sum(path.stat().st_size for path in (tmp_path / "set").glob("shard-*"))
    assert found.megabytes == pytest.approx(size / 1e6, rel=0.02)
    assert size > LEAST_BYTES


def test_a_disk_without_room_is_refused_before_anything_is_made(tmp_path, monkeypatch):
    monkeypatch.setattr(shutil, "disk_usage", lambda _folder: Usage(10**9, 10**9, LEAST_BYTES - 1))
    with pytest.raises(ConfigurationError, match=r"at least 0\.013 MB, got 0\.013 MB"):
        generate(RECIPE, tmp_path / "set")
    assert list(tmp_path.iterdir()) == []


def test_frames_whose_touches_are_solved_in_3d_are_measured_two_at_a_time(tmp_path, monkeypatch):
    """Sixteen frames, twice, would take half an hour."""
    touched = SceneGroup("touch", count=30, angle_deg=(10.0, 20.0), support=Plates())
    recipe = Recipe("slow", scenes=(SceneGroup("touch", count=30), touched))
    assert solved_frames(recipe) == 30
    clock, runs = [0.0], []

    def simulated(_recipe, numbers):
        runs.append(len(numbers))
        clock[0] += 50.0 * len(numbers)

    monkeypatch.setattr(preparation, "prepare", lambda *_, **__: None)
    monkeypatch.setattr(preparation, "simulate_frames", simulated)
    monkeypatch.setattr(preparation, "shard_bytes", lambda _: b"data")
    monkeypatch.setattr(preparation, "time", SimpleNamespace(perf_counter=lambda: clock[0]))
    found = estimate_cost(recipe, tmp_path, workers=1)
    assert runs == [2]
    assert (found.measured_frames, found.seconds) == (2, pytest.approx(60 * 50.0))
