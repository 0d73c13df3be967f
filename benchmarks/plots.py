"""Plots of benchmarks: errors against time or rate, points of one label in one colour."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from eitskin.extras import require

Points = Mapping[str, Sequence[tuple[float, float]]]
"""Points (x, y) by label."""


def plot_errors(
    path: Path,
    panels: Mapping[str, Points],
    x: str,
    y: str,
    limits: Mapping[str, float] | None = None,
) -> None:
    """Plot points on logarithmic scales, a panel for each title.

    Args:
        path: of the PNG file.
        panels: points by label, by title.
        x, y: labels of the axes.
        limits: values of y to be marked, by name.
    """
    figure = require("matplotlib.figure", "bench").Figure(
        figsize=(8.0 * len(panels), 5.4), layout="constrained"
    )
    grid = figure.subplots(1, len(panels), squeeze=False, sharex=True)
    for axes, (title, series) in zip(grid.ravel(), panels.items(), strict=True):
        for label, points in series.items():
            ordered = list(zip(*sorted(points), strict=True)) or [(), ()]
            axes.loglog(*ordered, "o-", ms=4, lw=0.8, label=label)
        for name, value in (limits or {}).items():
            axes.axhline(value, color="#999999", linewidth=0.8, linestyle=(0, (4, 3)))
            axes.text(0.01, 1.04 * value, name, transform=axes.get_yaxis_transform())
        axes.set(xlabel=x, ylabel=y, title=title)
        axes.grid(visible=True, which="major", color="#e4e4e4", linewidth=0.7)
        axes.spines[["top", "right"]].set_visible(False)
    handles, labels = grid[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside right upper", frameon=False, fontsize=8)
    figure.savefig(path, dpi=120, facecolor="white", format="png")
