"""Figures of localisation: error vectors over the sensor, and histogram of the errors."""

import numpy as np
from numpy.typing import NDArray

from eitskin.extras import require
from eitskin.training.evaluation.evaluate import Evaluation
from eitskin.training.evaluation.matching import GATE
from eitskin.training.evaluation.report.drawing import (
    BLUE,
    DARK,
    EXTRA,
    GREEN,
    ORANGE,
    CaptionedFigure,
    NoFigure,
    draw_sensor,
    new_figure,
)

MOST_VECTORS = 240  # more would hide each other

Array = NDArray[np.float64]


def error_vectors(evaluation: Evaluation) -> CaptionedFigure | NoFigure:
    """Error vectors of all single touches, from true to found position."""
    if not evaluation.pipeline.targets.touches:
        return NoFigure("the pipeline does not estimate positions of touches")
    data, matches = evaluation.dataset, evaluation.matches
    single = np.flatnonzero(data.touch_count == 1)[:MOST_VECTORS]
    if not single.size:
        return NoFigure("no frame has exactly one touch of known position")
    mine = np.isin(matches.frame, single)
    true, found = 1e3 * matches.true[mine], 1e3 * matches.found[mine]
    missed = np.setdiff1d(single, matches.frame[mine])
    figure = new_figure(9.6, 4.7)
    axes = figure.subplots()
    draw_sensor(axes, evaluation.pipeline.layout.design)
    true_positions = 1e3 * _positions(evaluation, single)
    distinct = len(np.unique(np.round(true_positions, 1), axis=0))
    plus = {"s": 60, "marker": "+", "color": DARK, "linewidths": 1.0, "zorder": 5}
    axes.scatter(*true_positions.T, label="true position", **plus)
    segments = require("matplotlib.collections", EXTRA).LineCollection
    lines = np.stack([true, found], axis=1)
    axes.add_collection(segments(lines, color=BLUE, alpha=0.7, linewidths=0.9, zorder=3))
    axes.scatter(*found.T, s=12, color=BLUE, linewidths=0, zorder=4, label="found there")
    if missed.size:
        lost = 1e3 * _positions(evaluation, missed)
        ring = {"s": 150, "facecolors": "none", "edgecolors": ORANGE, "linewidths": 1.4}
        axes.scatter(*lost.T, label="missed at least once", zorder=2, **ring)
    axes.set(xlabel="x [mm]", ylabel="y [mm]", aspect="equal")
    axes.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=3)
    return CaptionedFigure(
        figure,
        f"{len(single)} single touches at {distinct} positions, to scale: a line leads from the "
        f"true to the found position; {missed.size} were missed. "
        "Grey: the sensor's outline and its electrodes.",
    )


def _positions(evaluation: Evaluation, frames: NDArray[np.int64]) -> Array:
    """Position (n, 2) [m] of the one touch of each frame."""
    data = evaluation.dataset
    touches = np.stack([data.touch_x, data.touch_y], axis=2)[frames].astype(float)
    positions: Array = np.nanmax(touches, axis=1)
    return positions


def localisation_errors(evaluation: Evaluation) -> CaptionedFigure | NoFigure:
    """Histogram of the localisation errors of all matched touches."""
    error = 1e3 * evaluation.matches.error
    if not len(error):
        return NoFigure("no touch was matched to a true one")
    upper = max(float(np.percentile(error, 99.5)) * 1.05, 1e-3)
    figure = new_figure(7.2, 4.2)
    axes = figure.subplots()
    weights = np.full(len(error), 100.0 / len(error))
    axes.hist(np.minimum(error, upper), np.linspace(0, upper, 40), weights=weights, color=BLUE)
    figures = {
        f"median {np.median(error):.2f} mm": (np.median(error), GREEN, "--"),
        f"mean {error.mean():.2f} mm": (error.mean(), DARK, "-"),
        f"95 % within {np.percentile(error, 95):.2f} mm": (np.percentile(error, 95), ORANGE, ":"),
    }
    for label, (value, colour, line) in figures.items():
        axes.axvline(value, color=colour, linestyle=line, linewidth=1.6, label=label)
    axes.set(xlabel="distance between true and found position [mm]", ylabel="share of touches [%]")
    axes.set_xlim(0, upper)
    axes.legend()
    return CaptionedFigure(
        figure,
        f"Localisation errors of {len(error)} touches that were found, in frames with one to four. "
        f"A touch counts as found within {1e3 * GATE:g} mm; the largest errors are counted in the "
        "last bin.",
    )
