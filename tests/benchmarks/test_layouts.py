"""`eitskin bench layouts`: what is compared, the searches, and what the command writes."""

from dataclasses import replace

import numpy as np
import pytest
from command_line import printed_json, run
from layouts_fakes import FEW, FEWEST, flat_bound

from eitskin.benchmarks.layouts import bound as layouts_bound
from eitskin.benchmarks.layouts import run as layouts_run
from eitskin.benchmarks.layouts.bound import Layout, Sampling, SheetBound, own_mirrors
from eitskin.benchmarks.layouts.candidates import (
    SearchPlan,
    at_arcs,
    search,
    sweeps,
    with_electrodes,
)
from eitskin.benchmarks.layouts.run import JudgedLayout, figures_of
from eitskin.benchmarks.results import read_results
from eitskin.errors import ConfigurationError
from eitskin.geometry import Electrode, Rectangle

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
    layout = at_arcs("best", mirrored.arcs)
    assert len(list(own_mirrors(layout.design))) == 4
    for arcs in seen:
        gaps = np.diff(np.sort(arcs), append=min(arcs) + 0.420)
        assert len(arcs) == 8
        assert gaps.min() > 0.00999


def test_search_leaves_the_mirrors_where_a_half_turn_is_better():
    """Both on one side of the lower middle and with their mirror images too near to them."""
    judge, _ = likes(0.0330, 0.1250)
    mirrored, turned = search(judge, SearchPlan())
    assert turned.score < mirrored.score
    mirrors = [mirror for mirror, _ in own_mirrors(at_arcs("best", turned.arcs).design)]
    assert mirrors == [(False, False), (True, True)]


# The whole


def test_figures():
    (sixteen,) = (each for each in sweeps()["count"] if each.name == "16 on the rim")
    bound = replace(flat_bound(1.0), place=np.linspace(0.0, 1e-3, 11)[None])
    found = figures_of(JudgedLayout("count", sixteen, FEW, bound))
    assert [found[f"place{kind}_mm"] for kind in ("", "_90", "_worst")] == pytest.approx(
        [0.5, 0.9, 1]
    )
    assert found["scan_ms"] == 1272.0
    assert not found["fits_wire"]
    assert found["place_90_paced_mm"] == pytest.approx(0.9 * (120 / 28) ** 0.5)


@pytest.mark.slow
def test_command_writes_table_and_maps(tmp_path, monkeypatch):
    monkeypatch.setattr(layouts_run, "QUICK_SAMPLING", FEWEST)
    judged = []

    def quickly(layout: Layout, sampling: Sampling) -> SheetBound:
        judged.append(layout)
        x, y = sampling.grid(layout.design)
        values = 1e-3 + np.hypot(*np.meshgrid(x, y))
        return SheetBound(x, y, *[values] * 5, 0.1, 800.0, np.ones(3))

    monkeypatch.setattr(layouts_bound, "sheet_bound", quickly)
    options = ("bench", "layouts", "--quick", "--workers", "1", "--out", tmp_path)
    data = printed_json(*options)
    rows = data["rows"]
    assert {row["sweep"] for row in rows} == set(layouts_run.NAMES)
    assert len(rows) == 6 + 5 + 5 + 4 + 32 + 8
    assert (tmp_path / "layouts" / "layouts.png").read_bytes()[:4] == b"\x89PNG"
    figures = read_results(tmp_path / "layouts" / "results.json").figures
    assert figures["count / 8 on the rim / n"] == 28
    assert figures["bend / 8, -20 deg / angle [deg]"] == 0.1
    before = len(judged)
    run(*options, "--sweep", "contact")
    assert len(judged) == before


def test_unknown_sweeps_are_named(tmp_path):
    with pytest.raises(ConfigurationError, match=r"expected sweeps out of count, .* got colour"):
        layouts_run.run(tmp_path, names=("count", "colour"))
