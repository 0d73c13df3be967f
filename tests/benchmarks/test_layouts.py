"""`eitskin bench layouts`: what is compared, the searches, and what the command writes."""

import csv
import json
from dataclasses import replace

import numpy as np
import pytest
from layouts_fakes import FEW, FEWEST, flat_bound
from typer.testing import CliRunner

from eitskin.benchmarks.layouts import report as layouts_report
from eitskin.benchmarks.layouts import run as layouts_run
from eitskin.benchmarks.layouts import store as layouts_store
from eitskin.benchmarks.layouts.bound import Sampling, SheetBound, own_mirrors
from eitskin.benchmarks.layouts.candidates import Layout, sweeps, with_electrodes
from eitskin.benchmarks.layouts.free import FreePlan, exchanged, free_search, images
from eitskin.benchmarks.layouts.ring import Ring, ring_layout, solved_ring
from eitskin.benchmarks.layouts.run import JudgedLayout, LayoutFigures
from eitskin.benchmarks.layouts.search import SearchPlan, at_arcs, score, search
from eitskin.cli.main import app
from eitskin.errors import ConfigurationError
from eitskin.geometry import Electrode, Rectangle


def likely_ring(places=28, seed=0):
    """Random signals between electrodes that are evenly spaced."""
    rng = np.random.default_rng(seed)
    pairs = places * (places - 1) // 2
    arcs = 0.420 / places * (np.arange(places) + 0.5)
    return Ring(arcs, rng.uniform(500, 800, pairs), rng.standard_normal((20, 4, pairs)), 75.0)


# Layouts


def test_overlapping_electrodes_are_refused():
    with pytest.raises(ConfigurationError, match=r"layout 'tight': electrodes 0 and 1 overlap by"):
        with_electrodes("tight", [Electrode(x, 0.0) for x in (0.050, 0.053, 0.100)])
    arcs = (0.050, 0.0595, 0.22, 0.24, 0.26, 0.28, 0.30, 0.32)
    with pytest.raises(ConfigurationError, match=r"less than 5 mm\s+apart"):
        at_arcs("tight", arcs)
    assert len(at_arcs("apart", (0.050, 0.060, *arcs[2:])).design.electrodes) == 8


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
    mirrored, turned = search(judge, SearchPlan())
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
    mirrored, turned = search(judge, SearchPlan())
    assert turned.score < mirrored.score
    mirrors = [mirror for mirror, _ in own_mirrors(turned.layout.design)]
    assert mirrors == [(False, False), (True, True)]


@pytest.mark.slow
def test_a_ring_guesses_what_a_layout_of_its_electrodes_has(tmp_path):
    """All of a ring's electrodes are a layout that conducts no otherwise than the ring."""
    ring = solved_ring(tmp_path, 0.0525, FEWEST)
    assert len(ring.arcs) == 8
    again = solved_ring(tmp_path, 0.0525, FEWEST)
    np.testing.assert_array_equal(again.change, ring.change)
    layout = ring_layout(ring.arcs)
    bound = layouts_store.sheet_bound(layout, FEWEST)
    assert ring.guess(range(8)) == pytest.approx(score(bound), rel=1e-6)


@pytest.mark.slow
def test_exchanges_leave_no_better_exchange():
    ring, plan = likely_ring(), FreePlan(starts=2)
    found = exchanged(ring, plan)
    assert found == exchanged(ring, plan)
    assert found != exchanged(ring, replace(plan, seed=1))
    # One of the mirror images is given, and this ring is no mirror image of itself.
    numbers = [[int(np.argmin(np.abs(ring.arcs - s))) for s in arcs] for arcs in images(found[0])]
    guess, chosen = min((ring.guess(each), each) for each in numbers)
    for i in range(8):
        for place in set(range(28)) - set(chosen):
            assert ring.guess([*chosen[:i], *chosen[i + 1 :], place]) >= guess


def test_free_search_ends_where_no_step_is_better():
    wanted = (0.030, 0.0825, 0.1275)
    judge, seen = likes(*wanted)
    start = (0.0225, 0.075, 0.12, 0.18, 0.2325, 0.285, 0.3375, 0.39)
    found = free_search(judge, likely_ring(), FreePlan(starts=1, judged=1), [start])
    assert found.score == pytest.approx(1e-3, abs=1e-9)
    assert set(wanted) <= set(found.arcs)
    assert all(np.diff(np.sort(arcs), append=min(arcs) + 0.42).min() > 0.00999 for arcs in seen)


def test_images_are_the_mirrors_of_the_sheet():
    outline = Rectangle(0.150, 0.060)
    found = list(images((0.02, 0.17)))
    places = [outline.at(np.array(arcs)) for arcs in found]
    x, y = places[0].T
    for image, (along, across) in zip(
        places, [(False, False), (True, True), (True, False), (False, True)], strict=True
    ):
        mirrored = np.stack([0.150 - x if along else x, 0.060 - y if across else y], axis=1)
        assert {tuple(row) for row in np.round(image, 9)} == {
            tuple(row) for row in np.round(mirrored, 9)
        }


# The whole


def test_figures():
    (sixteen,) = (each for each in sweeps()["count"] if each.name == "16 on the rim")
    bound = replace(flat_bound(1.0), place=np.linspace(0.0, 1e-3, 11)[None])
    found = LayoutFigures.of(JudgedLayout("count", sixteen, FEW, bound))
    assert (found.place_mm, found.place_90_mm, found.place_worst_mm) == pytest.approx((0.5, 0.9, 1))
    assert found.scan_ms == 1272.0
    assert not found.fits_wire
    assert found.place_90_paced_mm == pytest.approx(0.9 * (120 / 28) ** 0.5)


@pytest.mark.slow
def test_command_writes_table_and_maps(tmp_path, monkeypatch):
    monkeypatch.setattr(layouts_run, "QUICK_SAMPLING", FEWEST)
    judged = []

    def quickly(layout: Layout, sampling: Sampling) -> SheetBound:
        judged.append(layout)
        x, y = sampling.grid(layout.design)
        values = 1e-3 + np.hypot(*np.meshgrid(x, y))
        return SheetBound(x, y, *[values] * 5, 0.1, 800.0, np.ones(3))

    monkeypatch.setattr(layouts_store, "sheet_bound", quickly)
    monkeypatch.setattr(layouts_run, "solved_ring", lambda *_: likely_ring())
    arguments = ["bench", "layouts", "--quick", "--workers", "1", "--out", str(tmp_path)]
    result = CliRunner().invoke(app, [*arguments, "--json", "-q"])
    assert result.exit_code == 0, result.output
    data = json.loads(result.stdout)
    with (tmp_path / "layouts.csv").open(encoding="utf-8") as file:
        assert "seed 0" in next(file)
        rows = list(csv.DictReader(file))
    assert {row["sweep"] for row in rows} == set(layouts_run.NAMES)
    assert len(rows) == len(data["layouts"]) == 6 + 5 + 5 + 4 + 32 + 8 + 6
    assert (tmp_path / "layouts.png").read_bytes()[:4] == b"\x89PNG"
    before = len(judged)
    monkeypatch.setattr(layouts_report, "plot_maps", lambda _, path: path.write_bytes(b""))
    shown = CliRunner().invoke(app, [*arguments, "--sweep", "contact"])
    assert shown.exit_code == 0, shown.output
    assert len(judged) == before


def test_unknown_sweeps_are_named(tmp_path):
    with pytest.raises(ConfigurationError, match=r"expected sweeps out of count, .* got colour"):
        layouts_run.run(tmp_path, names=("count", "colour"))
