"""Plot of the errors of quick models of presses over distances."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from eitskin.extras import require

_MARKS = {
    "position": "o",
    "long side": "s",
    "short side": "^",
    "two": "o",
    "three": "s",
    "four": "D",
}
_COLOURS = {"tabulated": "#1f5fa8", "without_images": "#2e8b57", "closed_form": "#b8860b"}
_TOGETHER = ("two", "three", "four")


def plot(found: Sequence[Any], path: Path) -> None:
    """Plot errors over the distance from the side of the gel and between touches."""
    figure = require("matplotlib.figure", "bench").Figure(figsize=(10.0, 4.4), layout="constrained")
    panels = figure.subplots(1, 2, sharey=True)
    _panel(panels[0], [one for one in found if one.family not in _TOGETHER])
    _panel(panels[1], [one for one in found if one.family in _TOGETHER])
    panels[0].set_xlabel("distance from the nearest side of the gel [mm]")
    panels[1].set_xlabel("distance between neighbouring touches [mm]")
    panels[0].set_ylabel("error of the signal [%]")
    figure.savefig(path, dpi=120, facecolor="white")


def _panel(axes: Any, found: Sequence[Any]) -> None:
    for family in dict.fromkeys(one.family for one in found):
        ordered = sorted(
            (one for one in found if one.family == family), key=lambda one: one.distance_mm
        )
        for model, colour in _COLOURS.items():
            axes.semilogy(
                [one.distance_mm for one in ordered],
                [100.0 * getattr(one, model) for one in ordered],
                _MARKS[family] + ("-" if family != "position" else ""),
                color=colour,
                label=f"{family}, {model.replace('_', ' ')}",
            )
    axes.axhline(5.0, color="#999999", linewidth=1.0, linestyle="--")
    axes.spines[["top", "right"]].set_visible(False)
    if found:
        axes.legend(frameon=False, fontsize=8)
