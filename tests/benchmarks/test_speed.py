"""`eitskin bench speed`: what its workloads draw, its ratios, its files."""

import numpy as np
import pytest
from command_line import printed_json

from eitskin.benchmarks import speed
from eitskin.benchmarks.speed import WORKLOADS, Rate, Workload


@pytest.mark.slow
def test_rates_stand_beside_errors_and_ratios_are_of_one_run(tmp_path, monkeypatch):
    peer = {"pyEIT.nodes": 1989, "pyEIT.matrix_ms": 90.0}
    monkeypatch.setattr(speed, "rate", lambda workload, *_: Rate(workload.name, 80, 20, 0.01, 0.02))
    monkeypatch.setattr(speed, "pyeit", lambda *_: peer)
    monkeypatch.setattr(speed, "generation", lambda *_: {"memory, large.mb": 201.0})
    monkeypatch.setattr(speed, "frame_time", lambda name, *_: {f"pipeline, {name}.p99_ms": 9.0})
    printed = printed_json("bench", "speed", "--quick", "--out", tmp_path)
    first = WORKLOADS[0].name
    expected = {
        f"{first} / per second": 80.0,
        f"{first} / error, median": 1.0,
        f"{first} / largest": 2.0,
        "pyEIT.times_longer": 4.5,
        "memory, large.mb": 201.0,
        "pipeline, four touches, bent.p99_ms": 9.0,
    }
    assert printed["figures"].items() >= expected.items()
    assert [rate["name"] for rate in printed["rows"]] == [first]
    assert (tmp_path / "speed" / "speed.png").stat().st_size > 10_000


@pytest.mark.parametrize("workload", WORKLOADS, ids=lambda workload: workload.name)
def test_scenes_have_touches_and_specimens_as_the_workload_says(workload):
    some = speed.scenes(workload, 40, seed=1)
    assert len({scene.bend for scene in some}) == 40
    low, high = workload.touches
    assert {len(scene.touches) for scene in some} == set(range(low, high + 1))
    assert all(4.0 <= t.force <= 12.0 for scene in some for t in scene.touches)
    assert speed.scenes(workload, 3, 1) == some[:3]
    if workload.specimens and workload.resolution == "fast":
        simulators = list(workload.simulators(speed.PER_SPECIMEN + 3))
        assert [simulators.count(s) for s in dict.fromkeys(simulators)] == [speed.PER_SPECIMEN, 3]
        assert len({sim.design for sim in simulators}) == 2


@pytest.mark.slow
def test_a_workload_without_tolerance_is_off_by_its_mesh_alone(monkeypatch):
    """Against itself it has no error; a coarser mesh has."""
    monkeypatch.setattr(speed, "JUDGED_SCENES", 2)
    standard = Workload("", resolution="standard", tolerance=0.0)
    truth = speed._signals(standard)
    monkeypatch.setattr(speed, "_true_signals", lambda *_: truth)
    assert np.abs(speed.signal_errors(standard)).max() < 1e-9
    assert 1e-3 < speed.signal_errors(Workload("", tolerance=0.0)).max() < 0.1
