"""Plots of the study of recipes."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eitskin.datasets.recipe.frame_sampling import Sample
from eitskin.datasets.recipe.recipe import Recipe
from eitskin.datasets.store.dataset import Dataset
from eitskin.extras import require

_BLUE, _RED, _GREY = "#1f5fa8", "#b3372f", "#777777"


@dataclass(frozen=True, slots=True)
class Strength:
    """Signals and noise of each measurement, root mean square, relative to the flat sensor, (C,).

    NaN where a recipe has no such frames.

    Attributes:
        bend: of untouched bent frames against the flat sensor.
        touch: of touched frames against the untouched sensor at the same bend.
        noise: of one frame, of the flat sensor.
    """

    bend: NDArray[np.float64]
    touch: NDArray[np.float64]
    noise: NDArray[np.float64]


def plot_statistics(rows: Sequence[tuple[Recipe, Sequence[Sample], Strength]], path: Path) -> None:
    """Plot angles, positions, forces and numbers of touches, signals and noise of each recipe."""
    figure = require("matplotlib.figure", "bench").Figure(
        figsize=(15.0, 2.5 * len(rows)), layout="constrained"
    )
    panels = figure.subplots(len(rows), 5, width_ratios=(1.0, 1.6, 0.8, 0.7, 1.7), squeeze=False)
    for row, (recipe, samples, strength) in zip(panels, rows, strict=True):
        touches = [t for each in samples for t in each.scene.touches if not t.released]
        row[0].set_ylabel(f"{recipe.name}\n{recipe.frames} frames", fontweight="bold")
        angles = [each.scene.bend.angle_deg for each in samples if each.scene.bend.angle_deg]
        _bars(row[0], angles, "bend angle where bent [deg]", np.linspace(-22.5, 52.5, 31))
        _places(row[1], recipe, touches)
        _bars(row[2], [t.force for t in touches], "force [N]", np.linspace(3.5, 12.5, 19))
        _numbers(row[3], samples)
        _strengths(row[4], strength)
    figure.savefig(path, dpi=80, facecolor="white")


def plot_episodes(rows: Sequence[tuple[str, Dataset]], path: Path) -> None:
    """Plot angle, times of touches and all measurements of each episode over time."""
    figure = require("matplotlib.figure", "bench").Figure(
        figsize=(5.0 * len(rows), 6.0), layout="constrained"
    )
    panels = figure.subplots(3, len(rows), sharex="col", squeeze=False)
    for column, (name, data) in zip(panels.T, rows, strict=True):
        reference = np.abs(data.reference[data.specimen])
        column[0].set_title(name, fontweight="bold")
        column[0].step(
            data.time, 10 * data.touch_count, color=_RED, where="post", label="touches x 10"
        )
        column[0].plot(data.time, data.bend_angle_deg, color=_BLUE, label="angle [deg]")
        for axes, values, label in (
            (column[1], data.impedance - data.reference[data.specimen], "from flat [%]"),
            (column[2], data.impedance - data.touch_reference, "from untouched [%]"),
        ):
            axes.plot(data.time, 100.0 * values.real / reference, linewidth=0.8)
            axes.set_ylabel(f"change {label}")
        column[2].set_xlabel("time [s]")
        column[0].legend(frameon=False, fontsize=8)
        for axes in column:
            axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(path, dpi=80, facecolor="white")


def _bars(axes: Any, values: Sequence[float], label: str, edges: Any) -> None:
    axes.set_xlabel(label)
    axes.set_xlim(edges[0], edges[-1])
    axes.spines[["top", "right"]].set_visible(False)
    if len(values):
        axes.hist(values, edges, color=_BLUE)
    else:
        _nothing(axes)


def _places(axes: Any, recipe: Recipe, touches: Sequence[Any]) -> None:
    outline = recipe.outline
    rim = 1e3 * outline.at(np.linspace(0.0, outline.perimeter, 401))
    axes.plot(*rim.T, color=_GREY, linewidth=1.0)
    pads = np.array([(e.x, e.y) for e in recipe.sensor.electrodes])
    axes.plot(*(1e3 * pads.T), "s", color=_RED, markersize=4)
    axes.plot([1e3 * t.x for t in touches], [1e3 * t.y for t in touches], ",", color=_BLUE)
    if len(touches) < 300:
        axes.plot([1e3 * t.x for t in touches], [1e3 * t.y for t in touches], ".", color=_BLUE)
    axes.set_aspect("equal")
    axes.spines[:].set_visible(False)
    axes.set_xlabel("touches, electrodes [mm]")


def _numbers(axes: Any, samples: Sequence[Sample]) -> None:
    numbers = [sum(not t.released for t in each.scene.touches) for each in samples]
    axes.bar(range(5), np.bincount(numbers, minlength=5), color=_BLUE)
    axes.set_xticks(range(5))
    axes.set_xlabel("touches at once")
    axes.spines[["top", "right"]].set_visible(False)


def _strengths(axes: Any, strength: Strength) -> None:
    parts = (("bend", _GREY, "o"), ("touch", _BLUE, "o"), ("noise", _RED, "_"))
    for name, colour, mark in parts:
        values = 100.0 * getattr(strength, name)
        if np.isfinite(values).any():
            axes.semilogy(values, mark, color=colour, markersize=4, label=name)
    axes.set_ylim(3e-3, 20.0)
    axes.set_xlabel("measurement")
    axes.set_ylabel("rms [% of flat]")
    axes.legend(frameon=False, fontsize=8, ncols=3, loc="upper center")
    axes.spines[["top", "right"]].set_visible(False)


def _nothing(axes: Any) -> None:
    axes.text(0.5, 0.5, "none", transform=axes.transAxes, ha="center", color=_GREY)
    axes.set_yticks([])
