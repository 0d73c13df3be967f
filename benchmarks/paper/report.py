"""Table and picture of `bench paper`: published figures, the paper's pipeline, ours, and others."""

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np

from eitskin.benchmarks.paper.run import OURS, OWN, PaperComparison
from eitskin.benchmarks.paper.scores import Figures
from eitskin.benchmarks.results import Report, ReportTable, measured
from eitskin.extras import require
from eitskin.training.evaluation.scores import GATE, SSIM_DEFINITION

BOUND = "Cramer-Rao bound"
NAME = "paper"
_DIGITS = {"mm": 2, "deg": 2, "%": 2, "ms": 2, "": 3}
_COLOURS = ("#9aa7b3", "#b8860b", "#1f5fa8", "#5b8c5a", "#8a5a8c", "#c46a4a", "#4a9aa0", "#777777")
_TOUCHES = {
    "indentation.error_mm": ("one, flat\n27 places", 4.8),
    "touch.1.error_mm": ("one,\n-10 to 50 deg", None),
    "touch.2.error_mm": ("two,\n0 to 30 deg", 5.5),
    "touch.3.error_mm": ("three,\n0 to 30 deg", 4.3),
    "touch.4.error_mm": ("four,\n0 to 30 deg", 5.0),
}


@dataclass(frozen=True, slots=True)
class TableLine:
    """Line of the table.

    Attributes:
        figure: its name in `paper_scores`.
        text: what it is.
        unit: "mm", "deg", "ms", "%" of a share, or none.
        paper: as published; empty where the paper gives none.
        target: to be reached; empty where there is none.
    """

    figure: str
    text: str
    unit: str = ""
    paper: str = ""
    target: str = ""


def _touches(name: str, text: str, paper: tuple[str, str], target: str) -> tuple[TableLine, ...]:
    several = target if target.endswith("2.5") else ""
    return (
        TableLine(f"{name}.error_mm", text, "mm", paper[0], target),
        TableLine(f"{name}.deviation_mm", "  standard deviation", "mm", paper[1]),
        TableLine(f"{name}.found", "  found", "%", "", ">= 98" if several else ""),
        TableLine(f"{name}.false", "  false, per touch", "%", "", "<= 2" if several else ""),
    )


def _pictures(
    group: str, text: str, paper: tuple[str, str, str], target: str
) -> tuple[TableLine, ...]:
    return (
        TableLine(f"{group}.ssim.static", f"{text}: SSIM, static reference", "", paper[0]),
        TableLine(f"{group}.ssim.dynamic", "  dynamic reference", "", paper[1]),
        TableLine(f"{group}.ssim.touch_map", "  touch map", "", paper[2], target),
        TableLine(f"{group}.ssim.empty", "  empty picture", ""),
    )


def _step(angle_deg: int, count: int) -> tuple[TableLine, ...]:
    name = f"demo.{angle_deg}deg.{count}"
    return (
        TableLine(f"{name}.state", f"  {count} touches at {angle_deg} deg: state right", "%"),
        TableLine(f"{name}.found", "    found", "%"),
        TableLine(f"{name}.error_mm", "    error", "mm"),
    )


LINES: tuple[TableLine, ...] = (
    *_touches("indentation", "one touch at 27 places, flat: error", ("4.8", "2.8"), "<= 1.5"),
    *_touches("touch.1", "one touch at -10 to 50 deg: error", ("", ""), "<= 1.5"),
    *_touches("touch.2", "two touches at 0 to 30 deg: error", ("5.5", ""), "<= 2.5"),
    *_touches("touch.3", "three touches at 0 to 30 deg: error", ("4.3", ""), "<= 2.5"),
    *_touches("touch.4", "four touches at 0 to 30 deg: error", ("5.0", ""), "<= 2.5"),
    *_pictures("touch.1", "one touch", ("0.29", "0.71", "0.94"), ">= 0.97"),
    *_pictures("touch.several", "several touches", ("0.11", "0.47", "0.80"), ">= 0.90"),
    TableLine("state.idle", "idle recognised", "%", "> 97", ">= 99.5"),
    TableLine("state.touch", "touch recognised", "%", "99", ">= 99.5"),
    TableLine("state.bend", "bend recognised", "%", "", ">= 99.5"),
    TableLine("touch.state", "touch on a bent sensor recognised", "%", "", ">= 99.5"),
    TableLine("bend.r2", "bend angle: R2", "", "0.997"),
    TableLine("bend.angle_deg", "  RMSE", "deg", "0.90"),
    TableLine("touch.angle_deg", "  RMSE while touched", "deg"),
    TableLine("sequence.angle_deg", "  RMSE in a continuous sequence", "deg"),
    TableLine("calibrated.r2", "bend angle, calibrated: R2"),
    TableLine("calibrated.angle_deg", "  RMSE", "deg", "", "<= 0.3"),
    TableLine("calibrated.touched_deg", "  RMSE while touched", "deg", "", "<= 0.6"),
    TableLine("demo.state", "demonstration: state right", "%"),
    TableLine("demo.angle_deg", "  angle, RMSE", "deg"),
    *(line for step in ((-10, 2), (20, 3), (40, 4), (0, 4)) for line in _step(*step)),
    TableLine("time.p50_ms", "processing of a touched frame, median", "ms", "303.6"),
    TableLine("time.p99_ms", "  99th percentile", "ms", "", "<= 5"),
)
"""The paper's time is the mean of 606.6 ms less 303 ms of acquisition; its angle is of the sensor
that was trained with, its sequence has no figure."""


def columns(found: PaperComparison) -> list[str]:
    """Columns that have figures."""
    return [name for name, seeds in found.figures.items() if seeds]


def headings(found: PaperComparison) -> tuple[str, ...]:
    """Heads of the table's columns."""
    return ("experiment", "paper", *columns(found), "to reach", "bound", "ours / bound")


def table(found: PaperComparison) -> Iterator[tuple[str, ...]]:
    """Rows of cells under `headings`: mean and standard deviation over the seeds.

    Indented lines that no column has a figure for are left out; others head what follows them.
    """
    for line in LINES:
        cells_of = [_values(found.figures[name], line) for name in columns(found)]
        bound = _values(found.bounds, line)
        if line.text.startswith(" ") and not any(cells_of):
            continue
        ours = _values(found.figures[OURS], line)
        multiple = f"{np.mean(ours) / np.mean(bound):.1f}" if ours and bound else ""
        cells = (_cell(values, line.unit) for values in cells_of)
        text = f"{line.text} [{line.unit}]" if line.unit else line.text
        yield text, line.paper, *cells, line.target, _cell(bound, line.unit), multiple


def _values(figures: Sequence[Figures], line: TableLine) -> list[float]:
    """Values of the seeds that have one."""
    factor = 100.0 if line.unit == "%" else 1.0
    return [factor * each[line.figure] for each in figures if line.figure in each]


def _cell(values: Sequence[float], unit: str) -> str:
    if not values:
        return ""
    digits = _DIGITS[unit]
    mean = f"{np.mean(values):.{digits}f}"
    return mean if len(values) == 1 else f"{mean} +- {np.std(values, ddof=1):.{digits}f}"


def sentences(found: PaperComparison) -> Iterator[str]:
    """Sentences below the table."""
    yield f"seeds {', '.join(map(str, found.seeds))}; +- standard deviation over them"
    yield f"ours: {found.pipeline}, on unseen sensors; the paper's is trained on one sensor"
    yield SSIM_DEFINITION
    yield f"touches are matched by the Hungarian method within {1e3 * GATE:g} mm"
    yield "bounds: white noise alone, of the nominal sensor, some of the frames, each by itself"
    for seed, ratio in zip(found.seeds, found.signal_to_noise, strict=True):
        yield (
            f"seed {seed}: signal to noise of a touch, rms, per channel: {ratio.least:.1f} least, "
            f"{ratio.median:.1f} median, {ratio.most:.1f} most"
        )
    yield f"instrument: {_terms(found.recipe.instrument)}"
    yield f"specimens: {_terms(found.recipe.specimens)}"


def _terms(said: Any) -> str:
    return ", ".join(f"{name} {value}" for name, value in asdict(said).items() if value)


def report(found: PaperComparison) -> Report:
    """Report of a comparison."""
    shown = ReportTable(headings(found), list(table(found)))
    options = f"--seeds {len(found.seeds)} --paper-seeds {len(found.figures[OWN])}"
    options += "".join(f" {each.option}" for each in found.contenders)
    named = dict(_figures(found)) | dict(shown.figures())
    return Report(
        results=measured(
            NAME, named.items(), began=found.began, quick=found.quick, options=options
        ),
        rows=[
            {"column": column, "seed": seed, "figure": figure, "value": value}
            for column, seeds in {**found.figures, BOUND: found.bounds}.items()
            for seed, figures in zip(found.seeds, seeds, strict=False)
            for figure, value in figures.items()
        ],
        tables=[shown],
        sentences=list(sentences(found)),
        plots={"paper-touches.png": partial(plot_touches, found)},
    )


def _figures(found: PaperComparison) -> Iterator[tuple[str, float]]:
    """Means over the seeds as `COLUMN: FIGURE`, deviations with ` +-`, shares in percent."""
    for column, seeds in {**found.figures, BOUND: found.bounds}.items():
        for line in LINES:
            values = _values(seeds, line)
            if values:
                yield f"{column}: {line.figure}", float(np.mean(values))
            if len(values) > 1:
                yield f"{column}: {line.figure} +-", float(np.std(values, ddof=1))


def plot_touches(found: PaperComparison, path: Path) -> None:
    """Plot localisation errors by experiment, beside the paper's and the bounds."""
    figure = require("matplotlib.figure", "bench").Figure(figsize=(9.0, 4.4), layout="constrained")
    axes = figure.subplots()
    columns = [name for name, seeds in found.figures.items() if seeds]
    width = 0.8 / len(columns)
    places = np.arange(len(_TOUCHES))
    for number, (column, colour) in enumerate(zip(columns, cycle(_COLOURS))):
        means, spreads = zip(
            *(_over_seeds(found.figures[column], n) for n in _TOUCHES), strict=True
        )
        at = places + (number - (len(columns) - 1) / 2) * width
        axes.bar(at, means, 0.9 * width, yerr=spreads, color=colour, label=column, capsize=2)
    for place, (name, (_, paper)) in zip(places, _TOUCHES.items(), strict=True):
        ends = (place - 0.42, place + 0.42)
        bound, _ = _over_seeds(found.bounds, name)
        axes.plot(ends, (bound, bound), color="black", label=None if place else "bound")
        if paper:
            drawn = None if place else "published"
            axes.plot(ends, (paper, paper), "--", color="#a33", label=drawn)
    axes.set_xticks(places, [text for text, _ in _TOUCHES.values()])
    axes.set_ylabel("mean error of a found touch [mm]")
    axes.spines[["top", "right"]].set_visible(False)
    figure.legend(frameon=False, loc="outside upper center", ncols=5)
    figure.savefig(path, dpi=120, facecolor="white")


def _over_seeds(figures: Sequence[Figures], name: str) -> tuple[float, float]:
    """Mean and standard deviation over seeds; NaN where no seed has a value."""
    values = [each[name] for each in figures if name in each]
    if not values:
        return float("nan"), float("nan")
    return float(np.mean(values)), float(np.std(values, ddof=1)) if len(values) > 1 else 0.0
