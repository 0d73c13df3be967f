"""Report of touch positions learned from a recording: figures, error vectors, errors."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eitskin.datasets.store.dataset import Dataset
from eitskin.datasets.store.summary import specimens_in_words
from eitskin.extras import require
from eitskin.training.adaptation.recorded_touches import RecordedTouches
from eitskin.training.evaluation.report.drawing import (
    BLUE,
    DARK,
    EXTRA,
    GREEN,
    CaptionedFigure,
    draw_sensor,
    new_figure,
)
from eitskin.training.evaluation.report.folder import picture_lines, write_folder
from eitskin.training.method.observations import fingerprint

MOST_VECTORS = 240  # more would hide each other

Array = NDArray[np.float64]


def write_position_report(
    touches: RecordedTouches, dataset: Dataset, folder: str | Path, made_with: Mapping[str, str]
) -> Path:
    """Write figures, report.json and report.md, replacing an earlier report; returns the folder.

    Args:
        touches: learned positions.
        dataset: frames with touches, of which those held out are judged.
        folder: made if missing.
        made_with: provenance that only the caller knows: machine, versions, date.

    Raises DataError where no frame is held out, and errors as `write_report`.
    """
    score = touches.evaluate(dataset).as_dict()
    true, found = (1e3 * places for places in touches.found(dataset))
    judged = dataset.select(touches.held_out(dataset))
    known = touches.trained_on
    provenance = {
        "method": touches.KIND,
        "trained on": f"{known['frames']} {known['source']} frames of the dataset "
        f"{known['sha256']}",
        "measured on": f"{len(judged)} {judged.source} frames of {specimens_in_words(judged)}, "
        f"frames {fingerprint(judged)}",
        **made_with,
    }
    drawings = {
        "error_vectors.png": lambda: error_vectors(touches, true, found),
        "localisation_errors.png": lambda: errors_by_share(true, found),
    }
    return write_folder(
        Path(folder), drawings, {"provenance": provenance, "report": score}, position_markdown
    )


def position_markdown(document: Mapping[str, Any]) -> str:
    """The report as Markdown."""
    lines = ["# Evaluation of touch positions", ""]
    lines += [f"- {name}: {value}" for name, value in document["provenance"].items()]
    lines += ["", "| figure | here |", "|---|---|"]
    for name, value in document["report"].items():
        shown = f"{value:.2f}" if isinstance(value, float) else str(value)
        lines.append(f"| {name.replace('_mm', ' [mm]').replace('_', ' ')} | {shown} |")
    return "\n".join([*lines, "", *picture_lines(document)])


def error_vectors(touches: RecordedTouches, true: Array, found: Array) -> CaptionedFigure:
    """Error vectors from true to found positions (k, 2) [mm]."""
    figure = new_figure(9.6, 4.7)
    axes = figure.subplots()
    if touches.design is not None:
        draw_sensor(axes, touches.design)
    true, found = true[:MOST_VECTORS], found[:MOST_VECTORS]
    segments = require("matplotlib.collections", EXTRA).LineCollection
    lines = np.stack([true, found], axis=1)
    axes.add_collection(segments(lines, color=BLUE, alpha=0.7, linewidths=0.9, zorder=3))
    axes.scatter(*true.T, s=40, marker="+", color=DARK, zorder=5, label="true position")
    axes.scatter(*found.T, s=12, color=BLUE, linewidths=0, zorder=4, label="found there")
    axes.set(xlabel="x [mm]", ylabel="y [mm]", aspect="equal")
    axes.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2)
    return CaptionedFigure(
        figure,
        f"{len(true)} touches, to scale: a line leads from the true to the found position.",
    )


def errors_by_share(true: Array, found: Array) -> CaptionedFigure:
    """Share of the touches (k, 2) [mm] found within a distance."""
    error = np.sort(np.linalg.norm(found - true, axis=1))
    figure = new_figure(7.2, 4.2)
    axes = figure.subplots()
    axes.step(error, 100.0 * np.arange(1, len(error) + 1) / len(error), color=BLUE, where="post")
    median = float(np.median(error))
    axes.axvline(median, color=GREEN, linestyle="--", label=f"median {median:.2f} mm")
    axes.axvline(error.mean(), color=DARK, label=f"mean {error.mean():.2f} mm")
    axes.set(xlabel="distance between true and found position [mm]", ylabel="share of touches [%]")
    axes.set(xlim=(0, None), ylim=(0, 100))
    axes.legend()
    return CaptionedFigure(figure, f"Share of {len(error)} touches found within a distance.")
