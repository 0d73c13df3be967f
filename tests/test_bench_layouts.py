"""`eitskin bench layouts`: bounds over the sheet, what is kept of them, the search, its files."""

import csv
import json
import multiprocessing
from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

from eitskin.benchmarks import layouts_bound, layouts_report, layouts_run, layouts_store
from eitskin.benchmarks.layouts import PAPER, Layout, paper, sweeps, with_electrodes
from eitskin.benchmarks.layouts_bound import (
    Sampling,
    SheetBound,
    own_mirrors,
    sheet_bound,
    touch_derivatives,
)
from eitskin.benchmarks.layouts_report import markdown, table
from eitskin.benchmarks.layouts_run import Comparison, Figures, Judged
from eitskin.benchmarks.layouts_search import Plan, at_arcs, score, search
from eitskin.benchmarks.layouts_store import judging
from eitskin.benchmarks.provenance import Provenance
from eitskin.cli.main import app
from eitskin.geometry import ConfigurationError, Electrode, PartialError, Rectangle, SensorDesign
from eitskin.geometry.layouts import uniform
from eitskin.simulator import Instrument, Protocol, Scene, Simulator, Touch
from eitskin.training.cramer_rao import scene_derivatives

FEW = Sampling(0.0450)  # 4 x 2 places
FEWEST = Sampling(0.0675)  # 3 x 2 places
PLACES = np.array([[0.045, 0.020], [0.110, 0.035]])


@pytest.fixture(scope="module")
def sim():
    return Simulator(SensorDesign.reference(), "fast")


@pytest.fixture(scope="module")
def untouched(sim):
    return scene_derivatives(sim, Scene())


@pytest.fixture(scope="module")
def derivatives(sim, untouched):
    return touch_derivatives(sim, untouched, 0.0, PLACES)


@pytest.fixture(scope="module")
def few():
    return sheet_bound(paper(), FEW)


def moved(first=0.02):
    """The paper's layout with its first electrode elsewhere, which no mirror leaves alone."""
    electrodes = SensorDesign.reference().electrodes
    return with_electrodes("moved", [replace(electrodes[0], x=first), *electrodes[1:]])


def flat_bound(value, signal=(1.0,), spectrum=(4.0, 2.0, 0.5)):
    place = np.full((1, 1), value)
    return SheetBound(
        np.zeros(1), np.zeros(1), place, place, place, place, np.array([signal]), 0.1, 800.0,
        np.array(spectrum),
    )  # fmt: skip


# Bounds


def test_derivatives_agree_with_a_difference_of_fourth_order_of_whole_solutions(sim, derivatives):
    steps = {"x": 1.5e-3, "y": 1.5e-3, "force": 0.3}
    for place, found in zip(PLACES.tolist(), derivatives, strict=True):
        touch = Touch(*place, 10.0)
        for row, (name, h) in enumerate(steps.items()):
            logs = [
                np.log(sim.measure(Scene(touches=(replace(touch, **{name: v}),))).impedance.real)
                for v in getattr(touch, name) + h * np.array([-2, -1, 1, 2])
            ]
            slope = (logs[0] - 8 * logs[1] + 8 * logs[2] - logs[3]) / (12 * h)
            error = np.abs(found.by_touch[0, row] - slope).max() / np.abs(slope).max()
            assert error < 0.03, name


def test_angle_is_nearly_that_of_the_untouched_sheet(sim, untouched):
    pressed = scene_derivatives(sim, Scene(touches=(Touch(*PLACES[0], 10.0),)))
    change = np.abs(pressed.by_angle - untouched.by_angle).max()
    assert change < 0.03 * np.abs(untouched.by_angle).max()


def test_a_layout_is_judged_as_each_scene_is(few, sim):
    scene = Scene(touches=(Touch(few.x[1], few.y[1], 10.0),))
    found = scene_derivatives(sim, scene)
    least = found.bound(found.noise(Instrument(), sim.full_scale))
    assert few.place[1, 1] == pytest.approx(least.place[0], rel=0.02)
    assert few.force[1, 1] == pytest.approx(least.force[0], rel=0.02)
    assert few.angle_deg[1, 1] == pytest.approx(least.angle_deg, rel=0.02)


def test_bounds_fall_with_the_root_of_signal_to_noise():
    """20 dB are a hundredth of the noise's power."""
    worse, better = (sheet_bound(paper(), replace(FEWEST, snr_db=snr)) for snr in (65.0, 85.0))
    for name in ("place", "place_known", "force", "angle_deg", "untouched_deg"):
        np.testing.assert_allclose(getattr(worse, name), 10.0 * getattr(better, name), rtol=1e-6)
    np.testing.assert_allclose(better.spectrum, 10.0 * worse.spectrum, rtol=1e-9)


def test_more_measurements_never_raise_a_bound(derivatives):
    order = np.random.default_rng(3).permutation(28)
    for found in derivatives:
        bounds = []
        for count in (6, 9, 14, 20, 28):
            part = order[:count]
            kept = replace(
                found,
                resistance=found.resistance[part],
                by_touch=found.by_touch[..., part],
                by_angle=found.by_angle[part],
            )
            least = kept.bound(kept.noise(Instrument(), 800.0))
            bounds.append((least.place[0], least.force[0], least.angle_deg))
        assert np.all(np.diff(bounds, axis=0) <= 0.0)
        assert bounds[-1][0] < 0.9 * bounds[0][0]


def test_an_unknown_angle_never_lowers_the_bound(few):
    assert np.all(few.place >= few.place_known * (1 - 1e-9))
    assert few.place.max() > few.place_known.max()


def test_the_sheet_mirrors_itself_where_the_layout_does(few, monkeypatch):
    """Without being told so: every place is solved by itself."""
    monkeypatch.setattr(layouts_bound, "_MIRRORS", ((False, False),))
    whole = sheet_bound(paper(), FEW)
    for values in (whole.place, whole.force, whole.signal):
        np.testing.assert_allclose(values, values[::-1], rtol=2e-3)
        np.testing.assert_allclose(values, values[:, ::-1], rtol=2e-3)
    assert whole.place.max() > 1.1 * whole.place.min()
    np.testing.assert_allclose(few.place, whole.place, rtol=2e-3)
    np.testing.assert_allclose(few.spectrum, whole.spectrum, rtol=1e-3)


def test_a_layout_with_one_mirror_is_solved_in_half_of_the_sheet(monkeypatch):
    electrodes = [
        replace(each, y=0.020) if each.y == 0.030 else each
        for each in SensorDesign.reference().electrodes
    ]
    layout = with_electrodes("lower at both ends", electrodes)
    half = sheet_bound(layout, FEWEST)
    monkeypatch.setattr(layouts_bound, "_MIRRORS", ((False, False),))
    whole = sheet_bound(layout, FEWEST)
    np.testing.assert_allclose(half.place, whole.place, rtol=2e-3)
    np.testing.assert_allclose(half.spectrum, whole.spectrum, rtol=1e-3)
    assert half.place[0, 0] != pytest.approx(half.place[1, 0], rel=0.1)


def test_mirrors_of_layouts():
    outline = Rectangle(0.150, 0.060)
    turned = with_electrodes("half a pitch on", uniform(outline, 8))
    mirrors = [[mirror for mirror, _ in own_mirrors(each.design)] for each in (turned, moved())]
    assert mirrors == [[(False, False), (True, True)], [(False, False)]]
    assert [len(list(own_mirrors(layout.design))) for layout in sweeps()["count"]] == [4] * 5


def test_measurements_are_renumbered_in_the_mirror(sim):
    for (along, across), order in own_mirrors(sim.design):
        x, y = 0.040, 0.022
        image = (0.150 - x if along else x, 0.060 - y if across else y)
        here, there = (
            sim.measure(Scene(touches=(Touch(*place, 10.0),))).impedance.real
            for place in ((x, y), image)
        )
        np.testing.assert_allclose(there[order], here, rtol=1e-6)


def test_what_is_said_of_signals():
    bound = flat_bound(1.0, signal=np.linspace(10.0, 20.0, 11))
    assert bound.uniformity == pytest.approx(11.0 / 19.0)
    assert bound.condition == pytest.approx(8.0)
    many = flat_bound(1.0, spectrum=1.0 / np.arange(1.0, 29.0))
    assert many.condition == pytest.approx(15.0)
    assert bound.patterns == 2


def test_pads_keep_their_digits():
    """A pad's own resistance is much of what is measured; 2 % of force changes little."""
    design = sweeps()["placement"][2].design
    sim = Simulator(design, layouts_bound._discretisation(design, "fast"))
    scenes = [Scene(touches=(Touch(0.0975, 0.0225, force),)) for force in (9.8, 10.0)]
    flat, less, more = np.log(sim.measure_all([Scene(), *scenes]).real)
    signal = np.abs(more - flat).max()
    assert signal > 0.01
    assert np.abs(more - less).max() < 0.03 * signal


# Layouts


def test_sweeps_hold_what_they_say():
    found = sweeps()
    assert [len(layout.protocol) for layout in found["count"]] == [15, 28, 45, 66, 120]
    assert found["count"][1].design == SensorDesign.reference()
    assert [layout.angle_deg for layout in found["bend"]] == list(range(-20, 51, 10))
    kinds = [{e.on for e in layout.design.electrodes} for layout in found["placement"]]
    assert kinds == [{"side"}, {"top"}, {"top"}, {"inside"}, {"inside"}]
    widths = [layout.design.electrodes[0].width for layout in found["width"]]
    contacts = [layout.design.electrodes[0].contact_impedance for layout in found["contact"]]
    assert widths == sorted(widths)
    assert contacts == [1e-5, 1e-4, 1e-3, 1e-2]


def test_overlapping_electrodes_are_refused():
    with pytest.raises(ConfigurationError, match=r"layout 'tight': electrodes 0 and 1 overlap by"):
        with_electrodes("tight", [Electrode(x, 0.0) for x in (0.050, 0.053, 0.100)])
    arcs = (0.050, 0.0595, 0.22, 0.24, 0.26, 0.28, 0.30, 0.32)
    with pytest.raises(ConfigurationError, match=r"less than their\s+width apart"):
        at_arcs("tight", arcs)
    assert len(at_arcs("apart", (0.050, 0.060, *arcs[2:])).design.electrodes) == 8


# What is kept


def asked(*layouts):
    return [(layout, FEWEST) for layout in layouts]


def contents(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.fixture(scope="module")
def fresh(tmp_path_factory):
    """A folder and bounds of a run that was not stopped."""
    folder = tmp_path_factory.mktemp("fresh")
    with judging(folder) as judge:
        return folder, judge(asked(paper(), paper(20.0)))


@pytest.mark.parametrize("workers", [1, 2])
def test_a_stopped_run_goes_on_to_the_same_bytes(fresh, tmp_path, workers):
    def stop(name):  # noqa: ARG001
        raise KeyboardInterrupt

    questions = asked(paper(), paper(20.0))
    many = questions + asked(*(paper(angle) for angle in (-20.0, -10.0, 10.0, 30.0)))
    with pytest.raises(KeyboardInterrupt), judging(tmp_path, workers, stop) as judge:
        judge(many)
    assert not multiprocessing.active_children()
    finished = {path: path.stat().st_mtime_ns for path in tmp_path.glob("*.json")}
    assert 1 <= len(finished) < len(many)
    with judging(tmp_path) as judge:
        resumed = judge(questions)
    folder, whole = fresh
    assert contents(tmp_path).items() >= contents(folder).items()
    assert all(path.stat().st_mtime_ns == time for path, time in finished.items())
    for one, other in zip(whole, resumed, strict=True):
        np.testing.assert_array_equal(one.place, other.place)
        np.testing.assert_array_equal(one.spectrum, other.spectrum)


@pytest.fixture
def counted(monkeypatch):
    """Names of layouts that are judged; the bound is their first electrode's place."""
    names = []

    def judged(layout, sampling):  # noqa: ARG001
        names.append(layout.name)
        return flat_bound(layout.design.electrodes[0].x)

    monkeypatch.setattr(layouts_store, "sheet_bound", judged)
    return names


def test_only_what_is_the_same_is_taken_from_a_file(tmp_path, counted):
    with judging(tmp_path) as judge:
        judge(asked(moved(0.020), moved(0.020)))
        assert counted == ["moved"]
        (again,) = judge(asked(replace(moved(0.020), name="under another name")))
        assert again.place[0, 0] == 0.020
        assert counted == ["moved"]
        (other,) = judge(asked(moved(0.021)))
        assert other.place[0, 0] == 0.021
        assert counted == ["moved"] * 2
        judge([(moved(0.020), replace(FEWEST, snr_db=70.0))])
        judge(asked(replace(moved(0.020), angle_deg=10.0)))
        assert len(counted) == 4


def test_damaged_and_foreign_files_are_judged_anew(tmp_path, counted):
    with judging(tmp_path) as judge:
        judge(asked(moved(0.020)))
        (path,) = tmp_path.glob("*.json")
        whole = path.read_bytes()
        path.write_bytes(whole[:40])
        judge(asked(moved(0.020)))
        assert path.read_bytes() == whole
        judge(asked(moved(0.021)))
        (other,) = set(tmp_path.glob("*.json")) - {path}
        path.write_bytes(other.read_bytes())
        (found,) = judge(asked(moved(0.020)))
    assert found.place[0, 0] == 0.020
    assert len(counted) == 4


def test_what_cannot_be_written_is_said(tmp_path, counted, monkeypatch):
    def full(path, content):  # noqa: ARG001
        raise PartialError("no room")

    monkeypatch.setattr(layouts_store, "write_file", full)
    with pytest.raises(PartialError), judging(tmp_path) as judge:
        judge(asked(paper()))
    assert counted == [PAPER]


# The search


def likes(*wanted):
    """A judge whose bound grows with the distance of electrodes from wanted arc lengths."""
    seen = []
    outline = Rectangle(0.150, 0.060)

    def judge(questions):
        bounds = []
        for layout, _ in questions:
            arcs = [
                float(outline.nearest(np.array([e.x, e.y]))[0]) for e in layout.design.electrodes
            ]
            seen.append(tuple(arcs))
            away = [min(abs(s - w) for s in arcs) for w in wanted]
            bounds.append(flat_bound(1e-3 + sum(away)))
        return bounds

    return judge, seen


def test_search_finds_the_best_with_both_mirrors():
    judge, seen = likes(0.075 + 0.03375, 0.075 + 0.0675)
    mirrored, turned = search(judge, Plan())
    assert mirrored.score == pytest.approx(1e-3, abs=1e-12)
    assert {0.10875, 0.1425} <= set(mirrored.arcs)
    assert turned == mirrored
    assert len(list(own_mirrors(mirrored.layout.design))) == 4
    assert mirrored.score == min(score(b) for b in judge([(mirrored.layout, FEW)]))
    for arcs in seen:
        gaps = np.diff(np.sort(arcs), append=min(arcs) + 0.420)
        assert len(arcs) == 8
        assert gaps.min() > 0.00999


def test_search_leaves_the_mirrors_where_a_half_turn_is_better():
    """Both on one side of the lower middle and with their mirror images too near to them."""
    judge, _ = likes(0.0330, 0.1250)
    mirrored, turned = search(judge, Plan())
    assert turned.score < mirrored.score
    mirrors = [mirror for mirror, _ in own_mirrors(turned.layout.design)]
    assert mirrors == [(False, False), (True, True)]


# The whole


def test_figures():
    sixteen = sweeps()["count"][-1]
    bound = replace(flat_bound(1.0), place=np.linspace(0.0, 1e-3, 11)[None])
    found = Figures.of(Judged("count", sixteen, FEW, bound))
    assert (found.place_mm, found.place_90_mm, found.place_worst_mm) == pytest.approx((0.5, 0.9, 1))
    assert found.scan_ms == 1272.0
    assert not found.fits_wire
    assert found.place_90_paced_mm == pytest.approx(0.9 * (120 / 28) ** 0.5)
    comparison = Comparison((Judged("count", sixteen, FEW, bound),), Provenance.now(0), quick=False)
    head, row = table(comparison)
    assert head == ("count",)
    assert row[1] == "120*"
    assert markdown(comparison).count("| 120* |") == 1


def test_command_writes_table_and_maps(tmp_path, monkeypatch):
    monkeypatch.setattr(layouts_run, "_QUICK", FEWEST)
    judged = []

    def quickly(layout: Layout, sampling: Sampling) -> SheetBound:
        judged.append(layout)
        x, y = sampling.grid(layout.design)
        values = 1e-3 + np.hypot(*np.meshgrid(x, y))
        return SheetBound(x, y, *[values] * 5, 0.1, 800.0, np.ones(3))

    monkeypatch.setattr(layouts_store, "sheet_bound", quickly)
    arguments = ["bench", "layouts", "--quick", "--out", str(tmp_path), "--workers", "1"]
    result = CliRunner().invoke(app, [*arguments, "--json", "-q"])
    assert result.exit_code == 0, result.output
    data = json.loads(result.stdout)
    with (tmp_path / "layouts.csv").open(encoding="utf-8") as file:
        assert "seed 0" in next(file)
        rows = list(csv.DictReader(file))
    assert {row["sweep"] for row in rows} == set(layouts_run.NAMES)
    assert len(rows) == len(data["layouts"]) == 5 + 5 + 5 + 4 + 8 + 8
    assert (tmp_path / "layouts.png").read_bytes()[:4] == b"\x89PNG"
    before = len(judged)
    monkeypatch.setattr(layouts_report, "plot_maps", lambda _, path: path.write_bytes(b""))
    shown = CliRunner().invoke(app, [*arguments, "--sweep", "contact"])
    assert shown.exit_code == 0, shown.output
    assert "0.01 ohm m2" in shown.output
    assert "half" not in shown.output
    assert len(judged) == before


def test_unknown_sweeps_are_named(tmp_path):
    with pytest.raises(ConfigurationError, match=r"expected sweeps out of count, .* got colour"):
        layouts_run.run(tmp_path, names=("count", "colour"))


def test_all_pairs_are_measured():
    assert paper().protocol == Protocol.pairwise(8)
    assert paper().scan_time == pytest.approx(0.2968)
