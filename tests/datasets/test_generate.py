"""Generating: the same bytes whatever happens, by workers, clusters and single calls."""

import dataclasses
import errno
import itertools
import os
import shutil
import subprocess
import sys
import threading
from collections import namedtuple
from dataclasses import replace
from types import SimpleNamespace
from unittest.mock import Mock

import h5py
import numpy as np
import pytest

from eitskin.datasets import Recipe, generate, open_dataset
from eitskin.datasets.generation import generate as generation
from eitskin.datasets.generation import preparation, shard_simulation
from eitskin.datasets.generation.preparation import estimate_cost, free_bytes, solved_frames
from eitskin.datasets.generation.shard_simulation import simulate_frames, simulate_shard
from eitskin.datasets.recipe.episode import RandomEpisodes
from eitskin.datasets.recipe.frame_sampling import sample, specimen
from eitskin.datasets.recipe.recipe import with_seed
from eitskin.datasets.recipe.scene_group import SceneGroup
from eitskin.datasets.recipe.specimen import Specimens
from eitskin.datasets.store import shard_reader, worker_processes
from eitskin.datasets.store.shard import append_checksum, shard_name, verify_checksum
from eitskin.errors import ConfigurationError, PartialError
from eitskin.geometry import Free, Hinge, Plates
from eitskin.simulator import Instrument, Scene, Simulator
from eitskin.threads import one_thread
from eitskin.training import Observations

from killed_writers import killed_once, was_killed
from on_demand import OnDemand
from shards_here import contents, in_this_process, made_here

pytestmark = pytest.mark.slow

RECIPE = Recipe(
    "small",
    seed=11,
    frames_per_shard=4,
    resolution="coarse",
    fixture=Hinge(),  # whose bends need no tables
    specimens=Specimens(count=2, conductivity=0.05, contact_impedance=0.1, hinge_offset=2e-4),
    scenes=(
        SceneGroup("idle", count=5),
        SceneGroup("bend", count=4, angle_deg=(-20.0, 50.0)),
        SceneGroup("touch", count=5, angle_deg=(0.0, 30.0), touches=(1, 2)),
    ),
)


@pytest.fixture(autouse=True, scope="module")
def one_blas_thread():
    """As in the workers; two threads on busy cores take twenty times as long for small blocks."""
    with one_thread():
        yield


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The recipe made in this process without interruption."""
    return made_here(RECIPE, tmp_path_factory.mktemp("datasets") / "whole")


def test_touched_frames_and_references_are_means_of_as_many_frames_as_the_recipe_says():
    """Their noise falls with the root; frames without touches keep theirs."""
    scenes = (
        SceneGroup("bend", count=30, angle_deg=(10.0, 10.0)),
        SceneGroup("touch", positions=((0.05, 0.03),), repeats=30),
    )
    recipe = replace(RECIPE, scenes=scenes, specimens=Specimens(), instrument=Instrument(60.0))
    clean = replace(recipe, instrument=Instrument(snr_db=0.0))
    averaged = replace(recipe, reference_frames=4, touch_frames=16)
    sets = [simulate_frames(each, range(60)) for each in (clean, recipe, averaged)]
    touched = sets[0].touch_count > 0

    def noise(data, name):
        off = np.abs(getattr(data, name) - getattr(sets[0], name))
        return np.array([np.sqrt(np.mean(off[rows] ** 2)) for rows in (~touched, touched)])

    ratios = [
        noise(sets[2], name) / noise(sets[1], name) for name in ("impedance", "touch_reference")
    ]
    np.testing.assert_allclose(ratios, [[1.0, 0.25], [0.5, 0.5]], rtol=0.06)
    frames = Observations.from_dataset(sets[2]).frames
    assert frames.tolist() == np.where(touched, 16.0, 1.0).tolist()
    with pytest.raises(ConfigurationError, match="touch_frames averages frames of scenes"):
        replace(averaged, episodes=(RandomEpisodes(count=1, frames=4),))


def test_frames_are_what_the_recipe_says_and_the_simulator_measures(whole):
    """With white noise of the instrument's size in frames and references, each by itself."""
    data = open_dataset(whole)
    samples = [sample(RECIPE, index) for index in range(RECIPE.frames)]
    assert len(data) == 14
    assert sorted(path.name for path in whole.iterdir()) == [
        "manifest.json",
        "recipe.toml",
        *(shard_name(number) for number in range(4)),
    ]
    assert (data.source, data.recipe, data.seed) == ("simulated", RECIPE.to_toml(), 11)
    assert data.design == RECIPE.sensor
    assert data.state.tolist() == [each.state for each in samples]
    assert data.specimen.tolist() == [0] * 7 + [1] * 7
    assert data.episode.tolist() == list(range(14))
    angles = np.float32([each.scene.bend.angle_deg for each in samples])
    assert np.array_equal(data.bend_angle_deg, angles)
    for index, each in enumerate(samples):
        touches = each.scene.touches
        assert data.touch_count[index] == len(touches)
        assert np.allclose(data.touch_x[index, : len(touches)], [t.x for t in touches])
        assert np.allclose(data.touch_force[index, : len(touches)], [t.force for t in touches])
    simulators, noise, reference_noise = [], [], []
    for number in range(2):
        made = specimen(RECIPE, number)
        simulators.append(Simulator(made.design, "coarse", made.fixture))
        flat = simulators[number].measure(Scene()).impedance
        assert np.allclose(data.reference[number], flat, rtol=1e-6)
    for index, each in enumerate(samples):
        simulator, scene = simulators[each.specimen], each.scene
        deviation = Instrument(75.0).deviation(simulator.full_scale)
        clean = simulator.measure(scene).impedance
        untouched = simulator.measure(Scene(bend=scene.bend)).impedance
        noise.append((data.impedance[index] - clean) / deviation)
        reference_noise.append((data.touch_reference[index] - untouched) / deviation)
    for values in (np.array(noise), np.array(reference_noise)):
        # 392 values: four standard errors of a standard deviation are 4 / sqrt(784) = 0.14.
        assert values.real.std() == pytest.approx(1.0, abs=0.15)
        assert values.imag.std() == pytest.approx(1.0, abs=0.15)
    together = np.corrcoef(np.array(noise).real.ravel(), np.array(reference_noise).real.ravel())
    assert abs(together[0, 1]) < 0.2


def test_damaged_lost_and_other_shards_are_made_again(whole, tmp_path, monkeypatch):
    """Also those of other attributes whose seal is whole."""
    in_this_process(monkeypatch)
    folder, first, seen, tried = tmp_path / "set", tmp_path / "set" / shard_name(0), [], []
    monkeypatch.setattr(shard_reader, "read_in_subprocess", lambda *task: tried.append(task) or ())
    shutil.copytree(whole, folder)
    (folder / shard_name(1)).write_bytes(b"rubbish")
    sound = (folder / shard_name(2)).read_bytes()
    (folder / shard_name(2)).write_bytes(sound[:4096] + bytes(4096) + sound[8192:])
    (folder / shard_name(3)).unlink()
    wrong = {"seed": -5, "frequency": 1e3, "quantity": "magnitude", "engine": np.inf}
    for name, value in wrong.items():
        (folder / "manifest.json").unlink()  # which has their sums
        first.write_bytes(verify_checksum(first.read_bytes())[0])
        with h5py.File(first, "r+") as file:
            file.attrs[name] = value
        first.write_bytes(append_checksum(first.read_bytes()))
        generate(RECIPE, folder, resume=True, examined=lambda *counts: seen.append(counts))
        assert contents(folder) == contents(whole)
    assert seen == [(number + 1, RECIPE.shards) for number in range(RECIPE.shards)] * len(wrong)
    assert len(tried) == 2 + 3 * RECIPE.shards  # all that may be whole, in a child first


def test_a_dataset_begun_by_another_simulation_is_opened_but_not_continued(
    whole, tmp_path, monkeypatch
):
    folder = tmp_path / "begun"
    shutil.copytree(whole, folder)
    monkeypatch.setattr(generation, "ENGINE", 1 + generation.ENGINE)
    generate(RECIPE, folder, resume=True)
    assert contents(folder) == contents(whole)
    (folder / shard_name(0)).unlink()
    with pytest.raises(ConfigurationError, match="is of simulation"):
        generate(RECIPE, folder, resume=True)


def test_occupied_folders_are_refused(whole, tmp_path, monkeypatch):
    monkeypatch.setattr(generation, "prepare", None)  # before hours of work
    with pytest.raises(ConfigurationError, match="--resume"):
        generate(RECIPE, whole)
    monkeypatch.undo()
    with pytest.raises(ConfigurationError, match="recipe or seed"):
        generate(with_seed(RECIPE, 12), whole, resume=True)
    (tmp_path / "letter.txt").write_text("mine")
    with pytest.raises(ConfigurationError, match=r"no recipe\.toml"):
        generate(RECIPE, tmp_path, resume=True)
    with pytest.raises(ConfigurationError, match=r"workers.*at least 1"):
        generate(RECIPE, tmp_path / "new", workers=0)


def test_presses_on_a_membrane_are_solved_beside_tabulated_ones(monkeypatch):
    asked = set()

    def measured(some):
        asked.update(
            (scene.support, own.touch_model) for own, scenes, _ in some for scene in scenes
        )
        return [np.ones((len(scenes), 2, 28)) for _, scenes, _ in some]

    monkeypatch.setattr(shard_simulation, "measure_together", measured)
    monkeypatch.setattr(shard_simulation, "flat_impedance", lambda *_: np.ones((2, 28)))
    group = SceneGroup("touch", count=1)
    others = [dataclasses.replace(group, support=each) for each in (Plates(), Free())]
    recipe = Recipe("supports", scenes=(group, *others))
    simulate_shard(recipe, 0)
    assert solved_frames(recipe) == 1
    assert asked == {(None, "tabulated"), (Plates(), "tabulated"), (Free(), "solved")}


# A script that generates without a main guard, which several workers would run again
UNGUARDED = """
import sys
from eitskin.datasets import Recipe, generate
generate(Recipe.from_toml(sys.argv[1]), sys.argv[2], workers=2)
"""


def test_a_script_without_a_main_guard_is_told_to_have_one_worker(tmp_path):
    recipe, script = tmp_path / "recipe.toml", tmp_path / "script.py"
    recipe.write_text(RECIPE.to_toml())
    script.write_text(UNGUARDED)
    command = [sys.executable, script, recipe, tmp_path / "set"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr.count("Traceback")) == (1, 1)
    assert "__main__" in done.stderr.splitlines()[-1]
    assert "workers=1" in done.stderr.splitlines()[-1]


# What a dataset will cost, and refusing a disk that has no room for it


CHEAP = Recipe(
    "cheap",
    seed=2,
    frames_per_shard=50,
    scenes=(SceneGroup("bend", count=120, angle_deg=(10.0, 10.0)),),
)
LEAST_BYTES = 120 * 28 * 4
Usage = namedtuple("Usage", "total used free")


def test_size_is_that_of_the_files(tmp_path):
    found = estimate_cost(CHEAP, tmp_path / "set", workers=1)
    assert (found.frames, found.shards) == (120, 3)
    assert 16 <= found.measured_frames <= 50
    assert found.seconds > 0
    assert found.megabytes_free == pytest.approx(
        free_bytes(tmp_path) / 1e6, rel=0.1
    )  # others write, too
    assert list(tmp_path.iterdir()) == []
    generate(CHEAP, tmp_path / "set", workers=1)
    size = sum(path.stat().st_size for path in (tmp_path / "set").glob("shard-*"))
    assert found.megabytes == pytest.approx(size / 1e6, rel=0.02)
    assert size > LEAST_BYTES


def clocked(monkeypatch, seconds_per_frame):
    """Each run of frames lasts so long, 3 s more the first time; lists the frames of each run."""
    now, runs = [0.0], []

    def simulated(_recipe, numbers):
        now[0] += seconds_per_frame * len(numbers) + (0.0 if runs else 3.0)
        runs.append(list(numbers))
        return numbers

    def solved(*_):
        now[0] += 0.25

    clock = SimpleNamespace(perf_counter=lambda: now[0])
    size = SimpleNamespace(shard_bytes=lambda frames: bytes(1000 + 10 * len(frames)))
    parts = {"time": clock, "simulate_frames": simulated, "flat_impedance": solved} | vars(size)
    for name, part in (parts | {"prepare": Mock()}).items():
        monkeypatch.setattr(preparation, name, part)
    return runs


def test_cost_counts_frames_specimens_of_each_shard_and_what_a_process_does_once(
    tmp_path, monkeypatch
):
    runs = clocked(monkeypatch, 0.01)
    recipe = replace(CHEAP, specimens=Specimens(count=2, conductivity=0.05))
    found = estimate_cost(recipe, tmp_path, workers=1)
    assert found.seconds == pytest.approx(3.0 + 120 * 0.01 + (1 + 2 + 1) * 0.25)
    assert found.megabytes == pytest.approx((3 * 1000 + 120 * 10) / 1e6)
    assert found.measured_frames == len(set(runs[-1])) == 50
    assert {number // 50 for number in runs[-1]} == {0, 1, 2}


def test_cost_of_frames_that_take_long_is_that_of_the_first_two(tmp_path, monkeypatch):
    runs = clocked(monkeypatch, 6.0)
    pressed = SceneGroup("touch", support=Free(), count=10)
    found = estimate_cost(replace(CHEAP, scenes=(pressed,)), tmp_path, workers=1)
    assert (len(runs), found.measured_frames) == (1, 2)
    assert found.seconds == pytest.approx(10 * 7.5)
    assert found.megabytes == pytest.approx(10 * 510 / 1e6)


def test_a_disk_without_room_is_refused_before_anything_is_made(tmp_path, monkeypatch):
    monkeypatch.setattr(shutil, "disk_usage", lambda _folder: Usage(10**9, 10**9, LEAST_BYTES - 1))
    with pytest.raises(ConfigurationError, match=r"at least 0\.013 MB, got 0\.013 MB"):
        generate(CHEAP, tmp_path / "set")
    assert list(tmp_path.iterdir()) == []
    monkeypatch.setattr(shutil, "disk_usage", lambda _folder: Usage(10**9, 10**9, LEAST_BYTES))
    monkeypatch.setattr(generation, "make_shards", None)
    with pytest.raises(TypeError):  # it would have begun
        generate(CHEAP, tmp_path / "set")


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EIO], ids=["full", "broken"])
@pytest.mark.parametrize("first_refused", [2, 5])
def test_a_disk_that_fails_is_a_clean_error(whole, tmp_path, monkeypatch, code, first_refused):
    """Any of the writes but those of the first files is refused, and all after it."""
    in_this_process(monkeypatch)
    out, writes = tmp_path / "set", itertools.count()

    def fsync(handle, sync=os.fsync):
        if next(writes) >= first_refused:
            raise OSError(code, os.strerror(code))
        sync(handle)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", fsync)
        with pytest.raises(PartialError) as caught:
            generate(RECIPE, out)
    assert caught.value.exit_code == 5
    kept, sound = contents(out), contents(whole)
    assert len(kept) < len(sound)
    assert all(sound[name] == content for name, content in kept.items())
    generate(RECIPE, out, resume=True)
    assert contents(out) == sound


# Shards made by worker processes, dask workers and single calls


distributed, dask = OnDemand("distributed"), OnDemand("dask")

FLAT_RECIPE = Recipe(
    "cheap",
    seed=3,
    frames_per_shard=8,
    scenes=(
        SceneGroup("idle", count=12),
        SceneGroup("bend", count=12, angle_deg=(10.0, 10.0)),
    ),
)


@pytest.fixture(scope="module")
def flat_files(tmp_path_factory):
    """The set made in this process, file by file."""
    return contents(made_here(FLAT_RECIPE, tmp_path_factory.mktemp("cluster") / "whole"))


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


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("cluster", [False, True], ids=["processes", "cluster"])
def test_two_workers_of_which_one_is_killed_while_writing_make_the_same_bytes(
    flat_files, tmp_path, monkeypatch, request, cluster
):
    monkeypatch.setattr(generation, "make_shard", killed_once)
    scheduler = request.getfixturevalue("local_cluster").scheduler_address if cluster else None
    reports, folder = [], tmp_path / "set"
    generate(FLAT_RECIPE, folder, 2, lambda *report: reports.append(report), scheduler=scheduler)
    assert was_killed(folder)
    assert (reports[0], reports[-1]) == ((0, 24), (24, 24))
    assert sorted(reports) == reports
    assert contents(folder) == flat_files


@pytest.mark.filterwarnings("ignore")
def test_what_workers_raise_reaches_the_caller(local_cluster, tmp_path, monkeypatch):
    def move(done, _total):
        if not done:
            (tmp_path / "set").rename(tmp_path / "elsewhere")

    address = local_cluster.scheduler_address
    with pytest.raises(PartialError, match=r"cannot write .*shard-00000\d\.h5"):
        generate(FLAT_RECIPE, tmp_path / "set", progress=move, scheduler=address)
    monkeypatch.setattr(worker_processes, "package_versions", lambda _: {"numpy": "0.1"})
    with pytest.raises(ConfigurationError, match=r"other packages.*'numpy': '0\.1'"):
        generate(FLAT_RECIPE, tmp_path / "other", scheduler=address)


@pytest.mark.filterwarnings("ignore")
def test_a_cluster_without_workers_says_how_to_start_one(tmp_path, monkeypatch):
    monkeypatch.setattr(worker_processes, "WORKERS_SECONDS", 0.2)
    with (
        distributed.LocalCluster(n_workers=0, dashboard_address=None) as empty,
        pytest.raises(ConfigurationError, match="dask worker tcp:"),
    ):
        generate(FLAT_RECIPE, tmp_path / "set", scheduler=empty.scheduler_address)


# One shard at a time, as in arrays of jobs. In the process of the test: what is tried is who begins
# and who completes a folder; tests of the command make a shard with a worker.


def test_single_shards_made_at_the_same_time_complete_the_set(flat_files, tmp_path, monkeypatch):
    in_this_process(monkeypatch)
    # Each begins the folder, and sees the half-written files of the others.
    folder, failed = tmp_path / "set", []
    folder.mkdir()
    half = folder / ".writing-other"
    half.write_bytes(b"half")

    def make(shard):
        try:
            generate(FLAT_RECIPE, folder, shard=shard)
        except BaseException as error:
            failed.append(error)
            raise

    threads = [threading.Thread(target=make, args=(shard,)) for shard in range(FLAT_RECIPE.shards)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert failed == []
    half.unlink()
    assert contents(folder) == flat_files
    (folder / shard_name(0)).write_bytes(b"damaged meanwhile")
    half.write_bytes(b"half")
    reports = []
    assert generate(FLAT_RECIPE, folder, shard=1, progress=lambda *at: reports.append(at)) is None
    assert reports == [(8, 8)]  # finished already
    with pytest.raises(ConfigurationError, match="recipe or seed"):
        generate(with_seed(FLAT_RECIPE, 4), folder, shard=1)
    generate(FLAT_RECIPE, folder, resume=True)
    assert contents(folder) == flat_files


def test_a_shard_needs_the_tables_of_its_own_specimens_alone(tmp_path, monkeypatch):
    prepared = Mock(side_effect=KeyboardInterrupt)
    monkeypatch.setattr(generation, "prepare", prepared)
    with pytest.raises(KeyboardInterrupt):
        generate(replace(FLAT_RECIPE, specimens=Specimens(24)), tmp_path / "set", shard=1)
    assert len(prepared.call_args.kwargs["specimens"]) <= FLAT_RECIPE.frames_per_shard
