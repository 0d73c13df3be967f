"""Comparison of layouts, sweeps and a search: `eitskin bench layouts`."""

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np

from eitskin.benchmarks.layouts.bound import Judge, Layout, Sampling, SheetBound, judge_layouts
from eitskin.benchmarks.layouts.candidates import (
    COUNT,
    PAPER,
    QUICK,
    SIZE,
    SearchPlan,
    layout_from_arcs,
    paper,
    search,
    sweeps,
    with_electrodes,
)
from eitskin.benchmarks.results import Columns, Progress, Report, ReportTable, make_results
from eitskin.extras import require
from eitskin.geometry import ConfigurationError, Rectangle
from eitskin.geometry.design.regular_layouts import uniform
from eitskin.hardware.protocol.packets import PER_PACKET
from eitskin.training.evaluation.drawing import draw_sensor, new_figure

SEARCH = "search"
MIRRORED, TURNED = "best with both mirrors", "best with a half turn"
NAMES = (*sweeps(), SEARCH)
SAMPLING, QUICK_SAMPLING = Sampling(0.0075), Sampling(0.0225)
_COLUMNS: Columns = {
    "": ("layout", "", 1),
    "n": ("n", "", 1),
    "scan [ms]": ("scan_ms", ".0f", 1),
    "50 % [mm]": ("place_mm", ".2f", 1),
    "90 %": ("place_90_mm", ".2f", 1),
    "worst": ("place_worst_mm", ".2f", 1),
    "paced": ("place_90_paced_mm", ".2f", 1),
    "force [N]": ("force_90_n", ".2f", 1),
    "angle [deg]": ("angle_untouched_deg", ".3f", 1),
    "weak/strong": ("uniformity", ".3f", 1),
    "condition": ("condition", ".3g", 1),
    "patterns": ("patterns", "d", 1),
}
LEGEND = (
    "bound of the place of 10 N: median, 90 % and worst over the sheet, and 90 % paced, for as "
    "many frames as take the time of the paper's; force: 90 %; angle: of the untouched sheet; "
    "* a frame that does not fit into one packet on the wire"
)
# The first of these that were tested and are not drawn already are drawn; without any, the first
# layouts.
_PICTURED_LAYOUTS = (
    (SEARCH, PAPER),
    ("search", "best with both mirrors"),
    ("search", "best with a half turn"),
    ("count", "16 on the rim"),
    ("placement", "on top, beside the rim"),
    ("placement", "inside, 2 x 4"),
    ("search", "even, half a pitch on"),
    ("count", "10 on the rim"),
)
_MOST, _ABREAST = 6, 2  # maps


@dataclass(frozen=True, slots=True)
class JudgedLayout:
    """Layout and its bounds."""

    sweep: str
    layout: Layout
    sampling: Sampling
    bound: SheetBound


def table_row(judged: JudgedLayout) -> dict[str, Any]:
    """Row of table.csv of one layout.

    Percentiles are over the sheet; bounds are of one frame against a reference of one, with the
    angle of the bend unknown where the name does not end in `known_mm`. `paced` is the bound for
    the mean of as many frames as take the time of one of the paper's layout, or their fraction;
    `fits_wire` says whether a frame fits into one packet, `electrodes_mm` "x y" of each middle.
    """
    layout, bound = judged.layout, judged.bound
    place, place_90, place_worst = np.percentile(1e3 * bound.place, (50, 90, 100)).tolist()
    force, force_90, force_worst = np.percentile(bound.force, (50, 90, 100)).tolist()
    return {
        "sweep": judged.sweep,
        "layout": layout.name,
        "resolution": judged.sampling.resolution,
        "spacing_mm": 1e3 * judged.sampling.spacing,
        "angle_deg": layout.angle_deg,
        "measurements": len(layout.protocol),
        "scan_ms": 1e3 * layout.scan_time,
        "fits_wire": len(layout.protocol) <= PER_PACKET,
        "place_mm": place,
        "place_90_mm": place_90,
        "place_worst_mm": place_worst,
        "place_90_known_mm": float(np.percentile(1e3 * bound.place_known, 90)),
        "place_90_paced_mm": place_90 * (layout.scan_time / paper().scan_time) ** 0.5,
        "force_n": force,
        "force_90_n": force_90,
        "force_worst_n": force_worst,
        "angle_90_deg": float(np.percentile(bound.angle_deg, 90)),
        "angle_untouched_deg": bound.untouched_deg,
        "uniformity": bound.uniformity,
        "condition": bound.condition,
        "patterns": bound.patterns,
        "full_scale_ohm": bound.full_scale,
        "electrodes_mm": "; ".join(
            f"{1e3 * e.x:g} {1e3 * e.y:g}" for e in layout.design.electrodes
        ),
    }


def run(
    folder: Path,
    *,
    names: Sequence[str] = NAMES,
    quick: bool = False,
    workers: int = 1,
    progress: Progress = lambda *_: None,
) -> Report:
    """Test the layouts of the sweeps, and search, keeping each finished layout in `folder`.

    A run that was stopped goes on from these files. `names` are those of sweeps, of which "search"
    is one; a quick run has few places, and few layouts in the search.

    Raises ConfigurationError for an unknown sweep, PartialError as `judge_layouts` does.
    """
    if unknown := sorted(set(names) - set(NAMES)):
        raise ConfigurationError(
            f"expected sweeps out of {', '.join(NAMES)}, got {', '.join(unknown)}"
        )
    began = time.perf_counter()
    sampling = QUICK_SAMPLING if quick else SAMPLING
    done = count(1)

    def watch(name: str) -> None:
        number = next(done)
        progress(f"layouts: {name}", number, max(number, len(asked)))

    judge = partial(judge_layouts, folder, workers, watch)
    asked = [(name, each) for name, some in sweeps().items() if name in names for each in some]
    bounds = judge([(layout, sampling) for _, layout in asked])
    judged = [
        JudgedLayout(name, layout, sampling, bound)
        for (name, layout), bound in zip(asked, bounds, strict=True)
    ]
    if SEARCH in names:
        judged += _judge_layouts(judge, quick)
    return _report(judged, began, quick)


def _report(judged: Sequence[JudgedLayout], began: float, quick: bool) -> Report:
    rows = [table_row(each) for each in judged]
    by_title: dict[str, list[dict[str, Any]]] = {}
    sentences = [LEGEND]
    for row in rows:
        title = row["sweep"]
        if title == SEARCH:
            title += f", {row['resolution']} mesh, places {row['spacing_mm']:g} mm apart"
        mark = "" if row["fits_wire"] else "*"
        by_title.setdefault(title, []).append(row | {"n": f"{row['measurements']}{mark}"})
        if row["layout"] in (MIRRORED, TURNED):
            sentences.append(f"{row['layout']}: middles at (x y) {row['electrodes_mm']} mm")
    tables = [
        replace(ReportTable.from_rows(some, _COLUMNS), headings=(title, *list(_COLUMNS)[1:]))
        for title, some in by_title.items()
    ]
    figures = [pair for table in tables for pair in table.figures(table.headings[0])]
    return Report(
        results=make_results("layouts", figures, began=began, quick=quick, options="--workers 2"),
        rows=rows,
        tables=tables,
        sentences=sentences,
        plots={"layouts.png": partial(plot_maps, judged)},
    )


def _judge_layouts(judge: Judge, quick: bool) -> Iterator[JudgedLayout]:
    """Layouts found and usual layouts, tested as in the search and then on a finer mesh."""
    plan = QUICK if quick else SearchPlan()
    mirrored, turned = search(judge, plan)
    layouts = [
        paper(),
        with_electrodes("even, half a pitch on", uniform(Rectangle(*SIZE), COUNT)),
        layout_from_arcs(MIRRORED, mirrored.arcs),
        layout_from_arcs(TURNED, turned.arcs),
    ]
    fine = replace(plan.sampling if quick else SAMPLING, resolution="standard")
    questions = [(layout, each) for each in (plan.sampling, fine) for layout in layouts]
    for (layout, each), bound in zip(questions, judge(questions), strict=True):
        yield JudgedLayout(SEARCH, layout, each, bound)


def plot_maps(judged: Sequence[JudgedLayout], path: Path) -> None:
    """Draw the bound of the place [mm] of up to six layouts on one logarithmic scale."""
    shown = pictured_layouts(judged)
    values = np.concatenate([1e3 * each.bound.place.ravel() for each in shown])
    ends = np.percentile(values, (2, 100))
    scale = require("matplotlib.colors", "bench").LogNorm(*ends.tolist())
    rows = -(-len(shown) // _ABREAST)
    figure = new_figure(9.5, 2.05 * rows + 0.4)
    grid = figure.subplots(rows, _ABREAST, squeeze=False, sharex=True, sharey=True)
    for axes, each in zip(grid.ravel(), shown, strict=False):
        filled = _draw(axes, each, scale)
    for axes in grid.ravel()[len(shown) :]:
        axes.set_visible(False)
    label = "bound of the place of 10 N [mm]"
    figure.colorbar(filled, ax=grid, label=label, shrink=0.8, extend="min", format="%g")
    figure.savefig(path, dpi=120, facecolor="white", format="png")


def pictured_layouts(judged: Sequence[JudgedLayout]) -> list[JudgedLayout]:
    """Layouts for the picture; the finer test of each layout that was tested twice."""
    by_name = {(each.sweep, each.layout.name): each for each in judged}
    chosen: list[JudgedLayout] = []
    for each in (by_name[key] for key in _PICTURED_LAYOUTS if key in by_name):
        if all(each.layout.design != other.layout.design for other in chosen):
            chosen.append(each)
    return (chosen or list(by_name.values()))[:_MOST]


def _draw(axes: Any, judged: JudgedLayout, scale: Any) -> Any:
    bound, values = judged.bound, 1e3 * judged.bound.place
    filled = axes.pcolormesh(1e3 * bound.x, 1e3 * bound.y, values, norm=scale, shading="nearest")
    draw_sensor(axes, judged.layout.design)
    title = f"{judged.layout.name}: 90 % below {np.percentile(values, 90):.2f} mm"
    axes.set_title(title, fontsize=9)
    axes.set(xlabel="x [mm]", ylabel="y [mm]")
    axes.label_outer()
    return filled
