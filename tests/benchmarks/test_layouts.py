"""Benchmarks of layouts and of speed."""

import numpy as np
import pytest
from command_line import printed_json

from eitskin.benchmarks import layouts, speed
from eitskin.benchmarks.layouts import Sampling, SheetBound, paper, sheet_bound, sweeps, table_row
from eitskin.benchmarks.results import read_results
from eitskin.benchmarks.speed import WORKLOADS, Rate, Workload
from eitskin.geometry import SensorDesign
from eitskin.simulator import Instrument, Scene, Simulator, Touch
from eitskin.training.evaluation.cramer_rao import scene_derivatives

FEW = Sampling(0.0675)  # 3 x 2 places
FEWEST = Sampling(0.135)  # 2 x 2 places


def test_a_layout_is_judged_as_each_scene_is():
    few, sim = sheet_bound(paper(), FEW), Simulator(SensorDesign.reference(), "fast")
    found = scene_derivatives(sim, Scene(touches=(Touch(few.x[1], few.y[1], 10.0),)))
    least = found.bound(found.noise(Instrument(), sim.full_scale))
    assert few.place[1, 1] == pytest.approx(least.place[0], rel=0.02)
    assert few.force[1, 1] == pytest.approx(least.force[0], rel=0.02)
    assert few.angle_deg[1, 1] == pytest.approx(least.angle_deg, rel=0.03)


def test_figures_of_a_bound():
    (sixteen,) = (each for each in sweeps()["count"] if each.name == "16 on the rim")
    place, line = np.linspace(0.0, 1e-3, 11)[None], np.zeros(1)
    found = table_row("count", sixteen, SheetBound(line, line, place, place, place, 0.1))
    expected = {
        "place_mm": 0.5,
        "place_90_mm": 0.9,
        "place_worst_mm": 1.0,
        "place_90_paced_mm": 0.9 * (120 / 28) ** 0.5,
        "scan_ms": 1272.0,
        "fits_wire": False,
    }
    assert {name: found[name] for name in expected} == pytest.approx(expected)


@pytest.mark.slow
def test_command_writes_table_and_maps(tmp_path, monkeypatch):
    names = []

    def quickly(layout, sampling):
        names.append(layout.name)
        x, y = sampling.grid(layout.design)
        values = 1e-3 + np.hypot(*np.meshgrid(x, y))
        return SheetBound(x, y, values, values, values, 0.1)

    monkeypatch.setattr(layouts, "QUICK_SAMPLING", FEWEST)
    monkeypatch.setattr(layouts, "sheet_bound", quickly)
    rows = printed_json("bench", "layouts", "--quick", "--workers", "1", "--out", tmp_path)["rows"]
    assert {row["sweep"] for row in rows} == set(layouts.NAMES)
    assert len(rows) == 6 + 5 + 5 + 4 + 32
    assert len(names) < len(rows)  # what several sweeps have is solved once
    assert (tmp_path / "layouts" / "layouts.png").read_bytes()[:4] == b"\x89PNG"
    figures = read_results(tmp_path / "layouts" / "results.json").figures
    assert figures["count / 8 on the rim / n"] == 28
    assert figures["bend / 8, -20 deg / angle [deg]"] == 0.1


# Speed


@pytest.mark.slow
def test_rates_stand_beside_errors_and_times_of_frames(tmp_path, monkeypatch):
    monkeypatch.setattr(speed, "rate", lambda workload, *_: Rate(workload.name, 80, 20, 0.01, 0.02))
    monkeypatch.setattr(speed, "frame_time", lambda name, *_: {f"pipeline, {name}.p99_ms": 9.0})
    printed = printed_json("bench", "speed", "--quick", "--out", tmp_path)
    first = WORKLOADS[0].name
    expected = {
        f"{first} / per second": 80.0,
        f"{first} / error, median": 1.0,
        f"{first} / largest": 2.0,
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
