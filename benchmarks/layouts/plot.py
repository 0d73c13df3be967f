"""Plot of `eitskin bench layouts`: bounds over the sheet, layouts side by side."""

from pathlib import Path
from typing import Any

import numpy as np

from eitskin.benchmarks.layouts.candidates import PAPER
from eitskin.benchmarks.layouts.run import JudgedLayout, LayoutComparison
from eitskin.extras import require

# The first of these that were judged and are not drawn already are drawn; without any, the first
# layouts.
_DRAWN = (
    ("search", PAPER),
    ("search", "best with both mirrors"),
    ("search", "best with a half turn"),
    ("free", "best of all"),
    ("count", "16 on the rim"),
    ("placement", "on top, beside the rim"),
    ("placement", "inside, 2 x 4"),
    ("search", "even, half a pitch on"),
    ("count", "10 on the rim"),
)
_MOST = 6
_COLUMNS = 2
_TICKS = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0)
_ON_RIM = 1.2  # half of what a drawn electrode on the rim extends across it [mm]


def plot_maps(found: LayoutComparison, path: Path) -> None:
    """Draw the bound of the place [mm] of up to six layouts on one logarithmic scale."""
    shown = drawn(found)
    values = np.concatenate([1e3 * each.bound.place.ravel() for each in shown])
    ends = np.percentile(values, (2, 100))
    scale = require("matplotlib.colors", "bench").LogNorm(float(ends[0]), float(ends[1]))
    rows = -(-len(shown) // _COLUMNS)
    figure = require("matplotlib.figure", "bench").Figure(
        figsize=(9.5, 2.05 * rows + 0.4), layout="constrained"
    )
    grid = figure.subplots(rows, _COLUMNS, squeeze=False, sharex=True, sharey=True)
    for axes, each in zip(grid.ravel(), shown, strict=False):
        filled = _draw(axes, each, scale)
    for axes in grid.ravel()[len(shown) :]:
        axes.set_visible(False)
    bar = figure.colorbar(
        filled, ax=grid, label="bound of the place of 10 N [mm]", shrink=0.8, extend="min"
    )
    ticks = [tick for tick in _TICKS if ends[0] <= tick <= ends[1]]
    bar.set_ticks(ticks, labels=[f"{tick:g}" for tick in ticks])
    bar.ax.minorticks_off()
    figure.savefig(path, dpi=120, facecolor="white")


def drawn(found: LayoutComparison) -> list[JudgedLayout]:
    """Layouts for the picture; the finer judgement of each layout that was judged twice."""
    judged = {(each.sweep, each.layout.name): each for each in found.judged}
    chosen: list[JudgedLayout] = []
    for each in (judged[key] for key in _DRAWN if key in judged):
        if all(each.layout.design != other.layout.design for other in chosen):
            chosen.append(each)
    return (chosen or list(judged.values()))[:_MOST]


def _draw(axes: Any, judged: JudgedLayout, scale: Any) -> Any:
    bound, design = judged.bound, judged.layout.design
    length, width = 1e3 * design.outline.length, 1e3 * design.outline.width
    values = 1e3 * bound.place
    filled = axes.pcolormesh(
        1e3 * bound.x, 1e3 * bound.y, values, norm=scale, cmap="viridis", shading="nearest"
    )
    corners = np.array([(0, 0), (length, 0), (length, width), (0, width), (0, 0)])
    axes.plot(*corners.T, color="#444444", linewidth=1.0)
    for electrode in design.electrodes:
        extent = 1e3 * np.array([electrode.width, electrode.height or electrode.width])
        if electrode.on == "side":
            upright = electrode.x in (0.0, design.outline.length)
            along = 1e3 * electrode.width
            extent = np.array([2 * _ON_RIM, along] if upright else [along, 2 * _ON_RIM])
        low = 1e3 * np.array([electrode.x, electrode.y]) - extent / 2
        patch = require("matplotlib.patches", "bench").Rectangle(
            low,
            *extent,
            facecolor="#d9a41a",
            edgecolor="black",
            linewidth=0.5,
            clip_on=False,
            zorder=3,
        )
        axes.add_patch(patch)
    most = np.percentile(values, 90)
    axes.set_title(f"{judged.layout.name}: 90 % below {most:.2f} mm", fontsize=9)
    axes.set(aspect="equal", xlim=(-3, length + 3), ylim=(-3, width + 3))
    axes.set_xlabel("x [mm]", fontsize=8)
    axes.set_ylabel("y [mm]", fontsize=8)
    axes.label_outer()
    axes.spines[:].set_visible(False)
    axes.tick_params(labelsize=7)
    return filled
