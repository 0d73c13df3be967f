"""`eitskin bench speed`: what its workloads draw, its ratios, its files."""

import numpy as np
import pytest
from command_line import printed_json

from eitskin.benchmarks import speed
from eitskin.benchmarks.results import read_results
from eitskin.benchmarks.speed import WORKLOADS, Rate, Workload

COMMAND = ("bench", "speed", "--quick", "--seed", "2")
MADE = {"dataset.share_percent": 50.0, "memory, large.mb": 201.0}
PEER = {"pyEIT.nodes": 1989, "pyEIT.scene_ms": 90.0}


@pytest.fixture
def ran(tmp_path, monkeypatch):
    """The command with parts that answer at once, its folder and what it printed as JSON."""
    monkeypatch.setattr(speed, "rate", lambda workload, *_: Rate(workload.name, 80, 20, 0.01, 0.02))
    monkeypatch.setattr(speed, "pyeit", lambda _seed: PEER)
    monkeypatch.setattr(speed, "generation", lambda _count, _engine: MADE)
    monkeypatch.setattr(speed, "frame_time", lambda name, *_: {f"pipeline, {name}.p99_ms": 9.0})
    return tmp_path / "speed", printed_json(*COMMAND, "--out", tmp_path)


@pytest.mark.slow
def test_rates_stand_beside_errors_and_ratios_are_of_one_run(ran):
    folder, printed = ran
    results = read_results(folder / "results.json")
    assert results.quick
    assert results.provenance.seed == 2
    first = WORKLOADS[0].name
    assert results.figures[f"{first} / per second"] == 80.0
    assert results.figures[f"{first} / error, median"] == 1.0
    assert results.figures[f"{first} / largest"] == 2.0
    assert results.figures["pyEIT.times_longer"] == 4.5
    assert results.figures["dataset.share_percent"] == 50.0
    assert results.figures["memory, large.mb"] == 201.0
    assert results.figures["pipeline, four touches, bent.p99_ms"] == 9.0
    assert [rate["name"] for rate in printed["rows"]] == [first]
    assert {path.name for path in folder.iterdir()} == {"results.json", "speed.png", "table.csv"}


@pytest.mark.slow
def test_without_the_peer_the_rest_is_measured(monkeypatch):
    monkeypatch.setattr(speed, "has_pyeit", lambda: False)
    assert speed.pyeit(0) == {}


@pytest.mark.slow
def test_the_peers_time_is_of_a_scene():
    pytest.importorskip("pyeit")
    found = speed.pyeit(0, count=1)
    assert found["pyEIT.nodes"] == 1989
    assert found["pyEIT.scene_ms"] > 0.0


def test_a_frames_time_is_that_of_the_pipeline_alone():
    found = speed.frame_time("idle", frames=5, seed=0)
    assert 0.0 < found["pipeline, idle.median_ms"] <= found["pipeline, idle.p99_ms"] < 1e3


def test_scenes_of_a_way_share_bends_as_it_says():
    for workload in WORKLOADS:
        some = speed.scenes(workload, 40, seed=1)
        bends = [scene.bend for scene in some]
        assert len(set(bends)) == (40 if workload.per_bend == 1 else 2)
        counts = {len(scene.touches) for scene in some}
        assert counts == set(range(workload.touches[0], workload.touches[1] + 1))
        assert all(4.0 <= t.force <= 12.0 for scene in some for t in scene.touches)
    assert speed.scenes(WORKLOADS[0], 3, 1) == speed.scenes(WORKLOADS[0], 3, 1)


@pytest.mark.slow
def test_a_way_without_tolerance_is_off_by_its_mesh_alone(monkeypatch):
    """Against itself it has no error; a coarser mesh has."""
    monkeypatch.setattr(speed, "JUDGED", 2)
    standard = Workload("", resolution="standard", tolerance=0.0)
    truth = speed._signals(standard)
    monkeypatch.setattr(speed, "_true_signals", lambda _: truth)
    assert np.abs(speed.signal_errors(standard)).max() < 1e-9
    assert 1e-3 < speed.signal_errors(Workload("", tolerance=0.0)).max() < 0.1


def test_specimens_of_their_own_are_used_for_as_many_scenes_each():
    workload = Workload("", specimens=True)
    simulators = list(workload.simulators(speed.PER_SPECIMEN + 3))
    assert [simulators.count(sim) for sim in dict.fromkeys(simulators)] == [speed.PER_SPECIMEN, 3]
    designs = {sim.design for sim in simulators}
    assert len(designs) == 2
