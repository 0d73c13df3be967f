"""Plots of `bench paper`: errors of touches, and error against time."""

from collections.abc import Sequence
from itertools import cycle
from pathlib import Path

import numpy as np

from eitskin.benchmarks.paper.run import PaperComparison
from eitskin.benchmarks.paper.scores import Figures
from eitskin.extras import require

_COLOURS = ("#9aa7b3", "#b8860b", "#1f5fa8", "#5b8c5a", "#8a5a8c", "#c46a4a", "#4a9aa0", "#777777")
_TOUCHES = {
    "indentation.error_mm": ("one, flat\n27 places", 4.8),
    "touch.1.error_mm": ("one,\n-10 to 50 deg", None),
    "touch.2.error_mm": ("two,\n0 to 30 deg", 5.5),
    "touch.3.error_mm": ("three,\n0 to 30 deg", 4.3),
    "touch.4.error_mm": ("four,\n0 to 30 deg", 5.0),
}


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


def plot_time(found: PaperComparison, path: Path) -> None:
    """Plot the mean error of all touches on unseen sensors over the time of a frame, by variant."""
    figure = require("matplotlib.figure", "bench").Figure(figsize=(7.0, 4.4), layout="constrained")
    axes = figure.subplots()
    for each in found.variants:
        error, spread = _over_seeds(each.figures, "touch.error_mm")
        median, _ = _over_seeds(each.figures, "time.p50_ms")
        slowest, _ = _over_seeds(each.figures, "time.p99_ms")
        drawn = axes.errorbar(
            median,
            error,
            yerr=spread,
            xerr=[[0.0], [max(0.0, slowest - median)]],
            fmt="o",
            capsize=3,
        )
        axes.annotate(
            each.name,
            (median, error),
            xytext=(6, 6),
            textcoords="offset points",
            color=drawn[0].get_color(),
        )
    axes.set_xscale("log")
    axes.xaxis.set_major_formatter("{x:g}")
    axes.xaxis.set_minor_formatter("{x:g}")
    axes.set_ylim(bottom=0.0)
    axes.set_xlabel("time of a touched frame, median to 99th percentile [ms]")
    axes.set_ylabel("mean error of a found touch [mm]")
    axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(path, dpi=120, facecolor="white")


def _over_seeds(figures: Sequence[Figures], name: str) -> tuple[float, float]:
    """Mean and standard deviation over seeds; NaN where no seed has a value."""
    values = [each[name] for each in figures if name in each]
    if not values:
        return float("nan"), float("nan")
    return float(np.mean(values)), float(np.std(values, ddof=1)) if len(values) > 1 else 0.0
