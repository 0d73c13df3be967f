"""Generating: the same bytes whatever happens, and no work done twice."""

import dataclasses
import os
import shutil
import subprocess
import sys
from collections import namedtuple
from types import SimpleNamespace

import numpy as np
import pytest

from eitskin.config import parse_toml
from eitskin.datasets import Recipe, generate, open_dataset
from eitskin.datasets.generation import generate as generation
from eitskin.datasets.generation import preparation
from eitskin.datasets.generation.preparation import estimate_cost, free_bytes, solved_frames
from eitskin.datasets.generation.shard_simulation import simulate_frames, simulate_shard
from eitskin.datasets.recipe.frame_sampling import sample, specimen
from eitskin.datasets.recipe.recipe import with_seed
from eitskin.datasets.recipe.scene_group import SceneGroup
from eitskin.datasets.recipe.specimen import Specimens
from eitskin.datasets.store import shard_reader
from eitskin.datasets.store.shard import shard_name, verify_checksum
from eitskin.datasets.store.worker_processes import run_tasks
from eitskin.errors import ConfigurationError, PartialError
from eitskin.geometry import Free, Plates
from eitskin.simulator import FourTerminalMeter, Instrument, Protocol, Scene, Simulator
from eitskin.threads import one_thread

from killed_writers import killed_once, was_killed
from shards_here import contents, in_this_process, made_here

RECIPE = Recipe(
    "small",
    seed=11,
    frames_per_shard=4,
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


@pytest.mark.slow
def test_two_workers_of_which_one_is_killed_while_writing_make_the_same_bytes(
    whole, tmp_path, monkeypatch
):
    monkeypatch.setattr(generation, "make_shard", killed_once)
    reports, folder = [], tmp_path / "set"
    generate(RECIPE, folder, 2, lambda *report: reports.append(report))
    assert was_killed(folder)
    assert reports[0] == (0, 14)
    assert sorted(reports) == reports
    assert reports[-1] == (14, 14)
    assert contents(folder) == contents(whole)


@pytest.mark.slow
def test_dataset_holds_what_the_recipe_says(whole):
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


@pytest.mark.slow
def test_values_are_those_of_the_simulator_with_noise_of_the_right_size(whole):
    data = open_dataset(whole)
    noise, reference_noise = [], []
    simulators = []
    for number in range(2):
        made = specimen(RECIPE, number)
        simulators.append(Simulator(made.design, resolution="fast", fixture=made.fixture))
        flat = simulators[number].measure(Scene()).impedance
        assert np.allclose(data.reference[number], flat, rtol=1e-6)
    for index in range(len(data)):
        drawn = sample(RECIPE, index)
        simulator, scene = simulators[drawn.specimen], drawn.scene
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


@pytest.mark.slow
def test_damaged_and_lost_shards_are_made_again(whole, tmp_path, monkeypatch):
    in_this_process(monkeypatch)
    folder = tmp_path / "damaged"
    folder.mkdir()
    for name, content in contents(whole).items():
        (folder / name).write_bytes(content)
    (folder / shard_name(1)).write_bytes(b"rubbish")
    sound = (folder / shard_name(2)).read_bytes()
    (folder / shard_name(2)).write_bytes(sound[:4096] + bytes(4096) + sound[8192:])
    (folder / shard_name(3)).unlink()
    opened = []
    reader = shard_reader._read
    monkeypatch.setattr(shard_reader, "_read", lambda i, n: opened.append(i) or reader(i, n))
    seen, reports = [], []
    generate(
        RECIPE,
        folder,
        progress=lambda *counts: reports.append(counts),
        resume=True,
        examined=lambda *counts: seen.append(counts),
    )
    assert contents(folder) == contents(whole)
    assert seen == [(number + 1, RECIPE.shards) for number in range(RECIPE.shards)]
    assert len(reports) == 4
    assert opened == [
        verify_checksum(contents(whole)[shard_name(0)])[0]
    ]  # HDF5 sees sound files alone


def test_finished_dataset_is_not_made_again(whole, monkeypatch):
    def refuse(*_arguments, **_named):
        raise AssertionError("there was nothing to make")

    monkeypatch.setattr(generation, "make_shards", refuse)
    before = contents(whole)
    generate(RECIPE, whole, resume=True)
    assert contents(whole) == before


def test_a_dataset_begun_by_another_simulation_is_opened_but_not_continued(
    whole, tmp_path, monkeypatch
):
    folder = tmp_path / "begun"
    shutil.copytree(whole, folder)
    monkeypatch.setattr(generation, "ENGINE", 1 + generation.ENGINE)
    generate(RECIPE, folder, resume=True)
    (folder / shard_name(0)).unlink()
    with pytest.raises(ConfigurationError, match="is of simulation"):
        generate(RECIPE, folder, resume=True)


def test_finished_shards_are_read_in_a_child_whatever_seal_they_have(whole, monkeypatch):
    tried = []
    monkeypatch.setattr(shard_reader, "read_in_subprocess", lambda *task: tried.append(task) or ())
    generate(RECIPE, whole, resume=True)
    assert len(tried) == RECIPE.shards


def test_occupied_folders_are_refused(whole, tmp_path):
    with pytest.raises(ConfigurationError, match="--resume"):
        generate(RECIPE, whole)
    with pytest.raises(ConfigurationError, match="recipe or seed"):
        generate(with_seed(RECIPE, 12), whole, resume=True)
    (tmp_path / "letter.txt").write_text("mine")
    with pytest.raises(ConfigurationError, match=r"no recipe\.toml"):
        generate(RECIPE, tmp_path, resume=True)
    with pytest.raises(ConfigurationError, match=r"workers.*at least 1"):
        generate(RECIPE, tmp_path / "new", workers=0)


def test_presses_on_a_membrane_are_solved_beside_tabulated_ones(monkeypatch):
    asked = set()

    def measured(self, scenes, **_):
        asked.update((scene.support, self.touch_model) for scene in scenes)
        return np.ones((len(scenes), 28))

    monkeypatch.setattr(Simulator, "measure_all", measured)
    group = SceneGroup("touch", count=1)
    others = [dataclasses.replace(group, support=each) for each in (Plates(), Free())]
    simulate_shard(Recipe("supports", scenes=(group, *others)), 0)
    assert asked == {(None, "tabulated"), (Plates(), "tabulated"), (Free(), "solved")}


# Worker processes that read shards: order, errors, Ctrl-C


@pytest.mark.slow
def test_results_come_in_order_and_an_error_of_a_task_is_raised():
    assert list(run_tasks(abs, [-3, 2, -1], 0)) == [(-3, 3), (2, 2), (-1, 1)]
    results = run_tasks(len, ["three", "to", 5, "four"], 2)
    assert [next(results), next(results)] == [("three", 5), ("to", 2)]
    with pytest.raises(TypeError):
        next(results)
    with pytest.raises(PartialError, match="fewer workers"):
        list(run_tasks(os._exit, [1, 1, 1], 2))


# A script that generates without a main guard, which several workers would run again
UNGUARDED = """
import sys
from eitskin.datasets import Recipe, generate
print("once")
generate(Recipe.from_toml(sys.argv[1]), sys.argv[2], workers=int(sys.argv[3]))
"""


@pytest.mark.slow
def test_a_script_without_a_main_guard_has_one_worker(whole, tmp_path):
    recipe, script = tmp_path / "recipe.toml", tmp_path / "script.py"
    recipe.write_text(RECIPE.to_toml())
    script.write_text(UNGUARDED)
    one, two = (
        subprocess.run(
            [sys.executable, script, recipe, tmp_path / f"set{workers}", str(workers)],
            capture_output=True,
            text=True,
            check=False,
        )
        for workers in (1, 2)
    )
    assert (one.stdout, one.returncode) == ("once\n", 0), one.stderr
    assert contents(tmp_path / "set1") == contents(whole)
    assert two.returncode == 1
    assert two.stderr.count("Traceback") == 1
    assert "__main__" in two.stderr.splitlines()[-1]
    assert "workers=1" in two.stderr.splitlines()[-1]


# What a dataset will cost, and refusing a disk that has no room for it


CHEAP = Recipe(
    "cheap",
    seed=2,
    frames_per_shard=50,
    scenes=(SceneGroup("bend", count=120, angle_deg=(10.0, 10.0)),),
)
LEAST_BYTES = 120 * 28 * 4
Usage = namedtuple("Usage", "total used free")


@pytest.mark.slow
def test_size_is_that_of_the_files(tmp_path):
    found = estimate_cost(CHEAP, tmp_path / "set", workers=1)
    assert (found.frames, found.shards) == (120, 3)
    assert 16 <= found.measured_frames <= 50
    assert found.seconds > 0
    assert found.megabytes_free == pytest.approx(free_bytes(tmp_path) / 1e6, rel=0.1)
    assert list(tmp_path.iterdir()) == []
    generate(CHEAP, tmp_path / "set", workers=1)
    size = sum(path.stat().st_size for path in (tmp_path / "set").glob("shard-*"))
    assert found.megabytes == pytest.approx(size / 1e6, rel=0.02)
    assert size > LEAST_BYTES


def test_a_disk_without_room_is_refused_before_anything_is_made(tmp_path, monkeypatch):
    monkeypatch.setattr(shutil, "disk_usage", lambda _folder: Usage(10**9, 10**9, LEAST_BYTES - 1))
    with pytest.raises(ConfigurationError, match=r"at least 0\.013 MB, got 0\.013 MB"):
        generate(CHEAP, tmp_path / "set")
    assert list(tmp_path.iterdir()) == []
    monkeypatch.setattr(shutil, "disk_usage", lambda _folder: Usage(10**9, 10**9, LEAST_BYTES))
    monkeypatch.setattr(generation, "make_shards", None)
    with pytest.raises(TypeError):  # it would have begun
        generate(CHEAP, tmp_path / "set")


def test_frames_whose_touches_are_solved_in_3d_are_measured_two_at_a_time(tmp_path, monkeypatch):
    """Sixteen frames, twice, would take half an hour."""
    touched = SceneGroup("touch", count=30, support=Free())
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


# Generating by any protocol and board: what the recipe names is what is measured


def test_frames_of_a_board_that_is_no_ideal_meter_are_its_readings():
    meter = FourTerminalMeter(sink=2e-3, idle=1e-3, scale=-4.0, step=0.25, reads="magnitude")
    recipe = Recipe(
        "loaded",
        resolution="coarse",
        protocol=Protocol.opposite(8),
        instrument=Instrument(snr_db=0.0, meter=meter),
        scenes=(SceneGroup("idle", count=1),),
    )
    data = simulate_frames(recipe, [0])
    made = specimen(recipe, 0)
    Z = Simulator(made.design, "coarse", made.fixture).model.impedance()
    read, _ = meter.reading(meter.transfer_impedance(Z, recipe.protocol))
    assert data.impedance[0] == pytest.approx(read, abs=0.26)  # a step of rounding
    assert data.reference[0] == pytest.approx(data.impedance[0])
    assert data.quantity == "magnitude"
    assert parse_toml(Recipe, data.recipe).instrument == recipe.instrument
    leaking = Instrument(meter=FourTerminalMeter(leaks=(1e-6,)))
    with pytest.raises(ConfigurationError, match=r"instrument: leaks.*8 electrodes, got 1"):
        dataclasses.replace(recipe, instrument=leaking)


def test_frames_of_the_ad5940_may_be_of_neighbours():
    """Its current is that of the drive pair, which no measurement of the protocol senses."""
    recipe = Recipe(
        "adjacent",
        resolution="coarse",
        protocol=Protocol.adjacent(8),
        instrument=dataclasses.replace(Instrument.ad5940(), snr_db=0.0, floor=0.0, drift=0.0),
        scenes=(SceneGroup("idle", count=1),),
    )
    data = simulate_frames(recipe, [0])
    made = specimen(recipe, 0)
    ideal = recipe.protocol.measure(
        Simulator(made.design, "coarse", made.fixture).model.impedance()
    )
    assert data.impedance[0].real == pytest.approx(ideal, rel=0.02)
    assert (np.abs(data.impedance[0].imag) > 1e-4 * np.abs(ideal)).all()  # of stray capacitance
    assert data.reference[0] == pytest.approx(data.impedance[0])
    assert not data.status.any()


def test_frames_are_measured_by_the_protocol_of_the_recipe():
    plain = Recipe(
        "own",
        scenes=(SceneGroup("idle", count=1),),
        resolution="coarse",
        instrument=Instrument(0.0),
    )
    adjacent = dataclasses.replace(plain, protocol=Protocol.adjacent(8))
    pairs, found = simulate_shard(plain, 0), simulate_shard(adjacent, 0)
    assert found.protocol == Protocol.adjacent(8)
    assert found.reference.shape == found.impedance.shape == (1, 40)
    z = dict(zip(((a, b) for a, b, *_ in pairs.protocol.table), pairs.impedance[0], strict=True))
    # Impedance of pairs, z_ab = Z_aa + Z_bb - 2 Z_ab; four terminals by superposition.
    expected = [
        (
            z[min(a, d), max(a, d)]
            + z[min(b, c), max(b, c)]
            - z[min(a, c), max(a, c)]
            - z[min(b, d), max(b, d)]
        )
        / 2.0
        for a, b, c, d in found.protocol.table
    ]
    assert found.impedance[0] == pytest.approx(expected, abs=1e-3)  # single precision
