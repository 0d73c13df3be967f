"""Benchmarks of layouts and of speed."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
from command_line import printed_json

from eitskin.benchmarks import speed
from eitskin.benchmarks.layouts import bound as layouts_bound
from eitskin.benchmarks.layouts import run as layouts_run
from eitskin.benchmarks.layouts.bound import (
    Sampling,
    SheetBound,
    judge_layouts,
    sheet_bound,
)
from eitskin.benchmarks.layouts.candidates import (
    SearchPlan,
    layout_from_arcs,
    paper,
    search,
    sweeps,
    with_electrodes,
)
from eitskin.benchmarks.layouts.run import JudgedLayout, table_row
from eitskin.benchmarks.results import read_results
from eitskin.benchmarks.speed import WORKLOADS, Rate, Workload
from eitskin.geometry import Rectangle, SensorDesign
from eitskin.simulator import Instrument, Scene, Simulator, Touch
from eitskin.training.evaluation.cramer_rao import scene_derivatives
from eitskin.training.method.input_spec import mirrors

FEW = Sampling(0.0675)  # 3 x 2 places
FEWEST = Sampling(0.135, resolution="coarse")  # 2 x 2 places


def moved(first=0.02):
    """The paper's layout with its first electrode elsewhere, which no mirror leaves alone."""
    electrodes = SensorDesign.reference().electrodes
    return with_electrodes("moved", [replace(electrodes[0], x=first), *electrodes[1:]])


def flat_bound(value, signal=(1.0,), spectrum=(4.0, 2.0, 0.5)):
    place, zero = np.full((1, 1), value), np.zeros(1)
    maps = (place, place, place, place, np.array([signal]))
    return SheetBound(zero, zero, *maps, 0.1, 800.0, np.array(spectrum))


# Bounds over the sheet


@pytest.fixture(scope="module")
def sim():
    return Simulator(SensorDesign.reference(), "fast")


@pytest.fixture(scope="module")
def few():
    return sheet_bound(paper(), FEW)


@pytest.mark.slow
def test_a_layout_is_judged_as_each_scene_is(few, sim):
    found = scene_derivatives(sim, Scene(touches=(Touch(few.x[1], few.y[1], 10.0),)))
    least = found.bound(found.noise(Instrument(), sim.full_scale))
    assert few.place[1, 1] == pytest.approx(least.place[0], rel=0.02)
    assert few.force[1, 1] == pytest.approx(least.force[0], rel=0.02)
    assert few.angle_deg[1, 1] == pytest.approx(least.angle_deg, rel=0.03)


def test_figures_of_a_bound():
    (sixteen,) = (each for each in sweeps()["count"] if each.name == "16 on the rim")
    signal, spectrum = np.linspace(10.0, 20.0, 11), 1.0 / np.arange(1.0, 29.0)
    bound = replace(flat_bound(1.0, signal, spectrum), place=np.linspace(0.0, 1e-3, 11)[None])
    found = table_row(JudgedLayout("count", sixteen, FEW, bound))
    expected = {
        "place_mm": 0.5,
        "place_90_mm": 0.9,
        "place_worst_mm": 1.0,
        "place_90_paced_mm": 0.9 * (120 / 28) ** 0.5,
        "scan_ms": 1272.0,
        "fits_wire": False,
        "uniformity": 11.0 / 19.0,
        "condition": 15.0,
    }
    assert {name: found[name] for name in expected} == pytest.approx(expected)
    assert flat_bound(1.0).patterns == 2


# The search


@pytest.mark.parametrize(
    ("wanted", "count"),
    [
        ((0.075 + 0.03375, 0.075 + 0.0675), 4),
        # Both on one side of the lower middle and with their mirror images too near to them.
        ((0.0330, 0.1250), 2),
    ],
)
def test_search_finds_the_best_layout_and_leaves_mirrors_where_a_half_turn_is_better(wanted, count):
    outline = Rectangle(0.150, 0.060)

    def judge(questions):
        """The bound grows with the distance of electrodes from the wanted arc lengths."""
        bounds = []
        for layout, _ in questions:
            at = [float(outline.nearest(np.array([e.x, e.y]))[0]) for e in layout.design.electrodes]
            away = [min(abs(s - w) for s in at) for w in wanted]
            bounds.append(flat_bound(1e-3 + sum(away)))
        return bounds

    mirrored, turned = search(judge, SearchPlan())
    found = (layout_from_arcs("", each.arcs) for each in (mirrored, turned))
    assert [len(mirrors(each.design, each.protocol)) for each in found] == [4, count]
    if count == 4:
        assert mirrored.score == pytest.approx(1e-3, abs=1e-12)
        assert turned == mirrored
    else:
        assert turned.score < mirrored.score


# What is kept


@pytest.fixture
def counted(monkeypatch):
    """Names of layouts that are judged; the bound is their first electrode's place."""
    names = []

    def judged(layout, _):
        names.append(layout.name)
        return flat_bound(layout.design.electrodes[0].x)

    monkeypatch.setattr(layouts_bound, "sheet_bound", judged)
    return names


def judged(folder, *questions, watch=lambda _: None, workers=1):
    return judge_layouts(folder, workers, watch, list(questions))


def test_only_what_is_whole_and_the_same_is_taken_from_a_file(tmp_path, counted):
    asked = (moved(), FEWEST)
    judged(tmp_path, asked, asked)
    (again,) = judged(tmp_path, (replace(moved(), name="under another name"), FEWEST))
    assert (again.place[0, 0], counted) == (0.020, ["moved"])
    for other in ((moved(0.021), FEWEST), (moved(), FEW), (replace(moved(), angle_deg=1.0), FEW)):
        judged(tmp_path, other)
    assert len(counted) == 4
    for path in tmp_path.glob("*.json"):
        path.write_bytes(path.read_bytes()[:40])
    (found,) = judged(tmp_path, asked)
    assert (found.place[0, 0], len(counted)) == (0.020, 5)


# The command


@pytest.mark.slow
def test_command_writes_table_and_maps(tmp_path, monkeypatch):
    monkeypatch.setattr(layouts_run, "QUICK_SAMPLING", FEWEST)

    def quickly(layout, sampling):
        x, y = sampling.grid(layout.design)
        values = 1e-3 + np.hypot(*np.meshgrid(x, y))
        return SheetBound(x, y, *[values] * 5, 0.1, 800.0, np.ones(3))

    monkeypatch.setattr(layouts_bound, "sheet_bound", quickly)
    rows = printed_json("bench", "layouts", "--quick", "--workers", "1", "--out", tmp_path)["rows"]
    assert {row["sweep"] for row in rows} == set(layouts_run.NAMES)
    assert len(rows) == 6 + 5 + 5 + 4 + 32 + 8
    assert (tmp_path / "layouts" / "layouts.png").read_bytes()[:4] == b"\x89PNG"
    figures = read_results(tmp_path / "layouts" / "results.json").figures
    assert figures["count / 8 on the rim / n"] == 28
    assert figures["bend / 8, -20 deg / angle [deg]"] == 0.1


# Speed


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
    with ThreadPoolExecutor(1) as pool:
        truth = speed._signals(standard, pool)
        monkeypatch.setattr(speed, "_true_signals", lambda *_: truth)
        assert np.abs(speed.signal_errors(standard, pool)).max() < 1e-9
        assert 1e-3 < speed.signal_errors(Workload("", tolerance=0.0), pool).max() < 0.1
