"""Shards made by dask workers and by single calls: the same bytes, however they come about."""

import threading
from dataclasses import replace
from unittest.mock import Mock

import pytest

from eitskin.datasets import Recipe, generate
from eitskin.datasets.generation import generate as generation
from eitskin.datasets.recipe.recipe import with_seed
from eitskin.datasets.recipe.scene_group import SceneGroup
from eitskin.datasets.recipe.specimen import Specimens
from eitskin.datasets.store import worker_processes
from eitskin.datasets.store.shard import shard_name
from eitskin.errors import ConfigurationError, PartialError

from killed_writers import killed_once, was_killed
from on_demand import OnDemand
from shards_here import contents, in_this_process, made_here

distributed, dask = OnDemand("distributed"), OnDemand("dask")

RECIPE = Recipe(
    "cheap",
    seed=3,
    frames_per_shard=8,
    scenes=(
        SceneGroup("idle", count=12),
        SceneGroup("bend", count=12, angle_deg=(10.0, 10.0)),
    ),
)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The set made in this process, file by file."""
    return contents(made_here(RECIPE, tmp_path_factory.mktemp("cluster") / "whole"))


@pytest.fixture(scope="module")
def local_cluster():
    """A scheduler and two worker processes, whose BLAS would use two threads."""
    threads = {"OPENBLAS_NUM_THREADS": "2", "OMP_NUM_THREADS": "2"}
    with (
        dask.config.set({"distributed.nanny.pre-spawn-environ": threads}),
        distributed.LocalCluster(
            n_workers=2, threads_per_worker=2, processes=True, dashboard_address=None
        ) as made,
    ):
        yield made


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_workers_of_a_cluster_of_which_one_is_killed_while_writing_make_the_same_bytes(
    whole, local_cluster, tmp_path, monkeypatch
):
    monkeypatch.setattr(generation, "make_shard", killed_once)
    folder = tmp_path / "set"
    generate(RECIPE, folder, scheduler=local_cluster.scheduler_address)
    assert was_killed(folder)
    assert contents(folder) == whole


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_what_workers_raise_reaches_the_caller(local_cluster, tmp_path, monkeypatch):
    def move(done, _total):
        if not done:
            (tmp_path / "set").rename(tmp_path / "elsewhere")

    address = local_cluster.scheduler_address
    with pytest.raises(PartialError, match=r"cannot write .*shard-00000\d\.h5"):
        generate(RECIPE, tmp_path / "set", progress=move, scheduler=address)
    monkeypatch.setattr(worker_processes, "package_versions", lambda _: {"numpy": "0.1"})
    with pytest.raises(ConfigurationError, match=r"other packages.*'numpy': '0\.1'"):
        generate(RECIPE, tmp_path / "other", scheduler=address)


@pytest.mark.filterwarnings("ignore")
def test_a_cluster_without_workers_says_how_to_start_one(tmp_path, monkeypatch):
    monkeypatch.setattr(worker_processes, "WORKERS_SECONDS", 0.2)
    with (
        distributed.LocalCluster(n_workers=0, dashboard_address=None) as empty,
        pytest.raises(ConfigurationError, match="dask worker tcp:"),
    ):
        generate(RECIPE, tmp_path / "set", scheduler=empty.scheduler_address)


# One shard at a time, as in arrays of jobs. In the process of the test: what is tried is who begins
# and who completes a folder; tests of the command make a shard with a worker.


def test_single_shards_made_at_the_same_time_complete_the_set(whole, tmp_path, monkeypatch):
    in_this_process(monkeypatch)
    # Each begins the folder, and sees the half-written files of the others.
    folder, failed = tmp_path / "set", []
    folder.mkdir()
    half = folder / ".writing-other"
    half.write_bytes(b"half")

    def make(shard):
        try:
            generate(RECIPE, folder, shard=shard)
        except BaseException as error:
            failed.append(error)
            raise

    threads = [threading.Thread(target=make, args=(shard,)) for shard in range(RECIPE.shards)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert failed == []
    half.unlink()
    assert contents(folder) == whole
    (folder / shard_name(0)).write_bytes(b"damaged meanwhile")
    half.write_bytes(b"half")
    reports = []
    assert generate(RECIPE, folder, shard=1, progress=lambda *at: reports.append(at)) is None
    assert reports == [(8, 8)]  # finished already
    with pytest.raises(ConfigurationError, match="recipe or seed"):
        generate(with_seed(RECIPE, 4), folder, shard=1)
    generate(RECIPE, folder, resume=True)
    assert contents(folder) == whole


def test_a_shard_needs_the_tables_of_its_own_specimens_alone(tmp_path, monkeypatch):
    prepared = Mock(side_effect=KeyboardInterrupt)
    monkeypatch.setattr(generation, "prepare", prepared)
    with pytest.raises(KeyboardInterrupt):
        generate(replace(RECIPE, specimens=Specimens(24)), tmp_path / "set", shard=1)
    assert len(prepared.call_args.kwargs["specimens"]) <= RECIPE.frames_per_shard
