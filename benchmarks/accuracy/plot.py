"""Plot of `bench accuracy`: error against time per frame."""

from pathlib import Path
from typing import Any

from eitskin.benchmarks.accuracy.cases import TARGETS, Target
from eitskin.benchmarks.accuracy.run import Accuracy, ModelResult
from eitskin.extras import require

_COLOURS = {
    "hexahedra": "#1f5fa8",
    "prisms": "#2e8b57",
    "tetrahedra": "#b8860b",
    "squares": "#6a9bd1",
    "pyEIT": "#c0392b",
}
_MARKERS = {
    "linear": "o",
    "quadratic": "s",
    "cubic": "^",
    "quartic": "D",
    "named": "*",
    "triangles": "+",
}


def plot(found: Accuracy, path: Path) -> None:
    """Plot both errors over the time per frame: one line per family, targets as corners."""
    matplotlib = require("matplotlib", "bench")
    figure_class = require("matplotlib.figure", "bench").Figure
    with matplotlib.rc_context(
        {"font.size": 10, "axes.spines.top": False, "axes.spines.right": False}
    ):
        figure = figure_class(figsize=(14.0, 7.6), layout="constrained")
        panels = figure.subplots(1, 2, sharex=True)
        for axes, quantity in zip(panels, ("resistance_error", "signal_error"), strict=True):
            _panel(axes, found, quantity)
        panels[0].set_title("28 flat resistances: largest relative error")
        panels[1].set_title("change under a 30 % drop of conductivity: relative error")
        handles, labels = panels[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside right center", frameon=False)
        figure.suptitle("Forward model of the reference sensor, one core", fontsize=13)
        figure.supxlabel(str(found.provenance), fontsize=8, color="#555555")
        figure.savefig(path, dpi=120, facecolor="white")


def _panel(axes: Any, found: Accuracy, quantity: str) -> None:
    families: dict[str, list[ModelResult]] = {}
    for point in found.points:
        families.setdefault(point.family, []).append(point)
    for family, points in families.items():
        ordered = sorted(points, key=lambda point: point.unknowns)
        milliseconds = [1e3 * point.frame_seconds for point in ordered]
        errors = [getattr(point, quantity) for point in ordered]
        axes.loglog(milliseconds, errors, label=family, **_style(family))
        if "named" in family:
            below = {"by": (-4, -15), "ha": "right"} if "prisms" in family else {"by": (5, 6)}
            for point, x, y in zip(ordered, milliseconds, errors, strict=True):
                _text(axes, point.name, (x, y), colour=_colour(family), **below)
    for target in TARGETS:
        _corner(axes, target, getattr(target, quantity))
    own = getattr(found, quantity)
    axes.axhline(own, color="#999999", linewidth=0.8, linestyle=(0, (1, 2)))
    right = {"xycoords": ("axes fraction", "data"), "ha": "right", "va": "bottom"}
    _text(axes, "error of the reference", (1.0, own), (0, 1), "#777777", **right)
    axes.set_xlabel("time per frame of 28 [ms]")
    axes.grid(visible=True, which="major", color="#e4e4e4", linewidth=0.7)
    axes.set_axisbelow(True)


def _text(
    axes: Any, text: str, at: tuple[float, float], by: tuple[int, int], colour: str, **options: Any
) -> None:
    """Write text near a point, haloed so that it reads on top of lines."""
    halo = require("matplotlib.patheffects", "bench").withStroke(linewidth=2.5, foreground="white")
    options = {"fontsize": 8.5, "color": colour, "zorder": 6, "path_effects": [halo]} | options
    axes.annotate(text, at, xytext=by, textcoords="offset points", **options)


def _style(family: str) -> dict[str, Any]:
    """Line style: colour by cells, marker by order, dashes for a solver that was asked for."""
    parts = family.split(", ")
    marker = next((_MARKERS[part] for part in parts if part in _MARKERS), "x")
    colour = _colour(family)
    named = "named" in parts
    uniform = "uniform" in parts
    return {
        "color": colour,
        "marker": marker,
        "markersize": 13 if named else 5.5,
        "markeredgecolor": "white" if named else colour,
        "markerfacecolor": "white" if uniform else colour,
        "linestyle": "none" if named else "--" if "sparse LU" in parts else ":" if uniform else "-",
        "linewidth": 1.3,
        "zorder": 5 if named else 3,
    }


def _corner(axes: Any, target: Target, error: float | None) -> None:
    """Mark the target of a resolution as a corner: results must lie below and to the left."""
    if error is None:
        return
    time = 1e3 * target.seconds
    axes.plot([time / 3.0, time, time], [error, error, error / 6.0], color="#444444", linewidth=1.1)
    _text(axes, f"target {target.name}", (time, error), (-3, 3), "#444444", ha="right")


def _colour(family: str) -> str:
    return _COLOURS[family.partition(", ")[0]]
