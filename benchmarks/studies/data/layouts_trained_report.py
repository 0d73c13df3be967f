"""Files of `eitskin bench layouts --trained`: a table for people, CSV, JSON and a plot."""

import dataclasses
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eitskin.benchmarks.results import write_table
from eitskin.benchmarks.studies.data.layouts_trained import Training
from eitskin.extras import require
from eitskin.files import atomic_file

HEADINGS = (
    "layout",
    "n",
    "bound, rms [mm]",
    "bound, 90 %",
    "error, mean [mm]",
    "error, rms",
    "error, 90 %",
    "found [%]",
    "false [%]",
    "angle, bound [deg]",
    "angle, rms",
)


def table(trained: Training) -> Iterator[tuple[str, ...]]:
    """Rows below the headings, in the order of the bounds."""
    for each in sorted(trained.learned, key=lambda each: each.bound_rms_mm):
        yield (
            each.layout,
            str(each.measurements),
            _number(each.bound_rms_mm),
            _number(each.bound_90_mm),
            _number(each.error_mm),
            _number(each.error_rms_mm),
            _number(each.error_90_mm),
            f"{100 * each.found:.1f}",
            f"{100 * each.false:.1f}",
            _number(each.bound_angle_deg),
            _number(each.angle_deg),
        )


def rank_correlation(one: NDArray[np.float64], other: NDArray[np.float64]) -> float:
    """Spearman's rank correlation: 1 for the same order, -1 for the reversed order."""
    first, second = (np.argsort(np.argsort(values)) for values in (one, other))
    return float(np.corrcoef(first, second)[0, 1])


def sentences(trained: Training) -> Iterator[str]:
    """Sentences on the order of errors and bounds, and the provenance."""
    some = [each for each in trained.learned if each.error_rms_mm is not None]
    if len(some) > 2:
        bounds, errors = (
            np.array([getattr(each, name) for each in some], dtype=float)
            for name in ("bound_rms_mm", "error_rms_mm")
        )
        yield (
            f"rank correlation of bounds and errors (rms) of {len(some)} layouts: "
            f"{rank_correlation(bounds, errors):+.2f}"
        )
    if trained.quick:
        yield "quick: few frames and little training, so errors say little"
    seconds = sum(each.seconds for each in trained.learned)
    frames = " and ".join(sorted({str(each.frames) for each in trained.learned}))
    yield f"pipelines trained on {frames} frames each, all in {seconds:.0f} s; {trained.provenance}"


def as_data(trained: Training) -> dict[str, Any]:
    """Scores as plain data."""
    return {
        "provenance": dataclasses.asdict(trained.provenance),
        "quick": trained.quick,
        "layouts": [dataclasses.asdict(each) for each in trained.learned],
    }


def markdown(trained: Training) -> str:
    """Markdown table for a page."""
    rows = (HEADINGS, ("---",) * len(HEADINGS), *table(trained))
    lines = ["| " + " | ".join(row) + " |" for row in rows]
    return "\n".join([*lines, "", *(f"- {each}" for each in sentences(trained)), ""])


def write(trained: Training, folder: Path) -> list[Path]:
    """Write layouts-trained.csv, .md, .json and .png into `folder`, each whole."""
    paths = [folder / f"layouts-trained.{ending}" for ending in ("csv", "md", "json", "png")]
    rows = [dataclasses.asdict(each) for each in trained.learned]
    write_table(paths[0], rows, str(trained.provenance))
    texts = (markdown(trained), json.dumps(as_data(trained)) + "\n")
    for path, text in zip(paths[1:3], texts, strict=True):
        with atomic_file(path) as temporary:
            temporary.write_text(text, encoding="utf-8")
    with atomic_file(paths[3]) as temporary:
        plot(trained, temporary)
    return paths


def plot(trained: Training, path: Path) -> None:
    """Draw errors over bounds, with the line where a pipeline would reach the bound."""
    figure = require("matplotlib.figure", "bench").Figure(figsize=(6.0, 4.5), layout="constrained")
    axes = figure.subplots()
    for i, each in enumerate(sorted(trained.learned, key=lambda each: each.bound_rms_mm)):
        if each.error_rms_mm is not None:
            axes.plot(each.bound_rms_mm, each.error_rms_mm, "o", color="#1f5f8b")
            at = (each.bound_rms_mm, each.error_rms_mm)
            # Above and below in turn: neighbours' names would lie upon each other.
            axes.annotate(
                each.layout, at, (0, (-14, 7)[i % 2]), textcoords="offset points",
                fontsize=8, ha=("left", "right")[i % 2],
            )  # fmt: skip
    ends = np.array([min(each.bound_rms_mm for each in trained.learned) / 2, 20.0])
    axes.plot(ends, ends, color="#888888", linewidth=1.0)
    axes.set(xscale="log", yscale="log")
    axes.set_xlabel("bound of the place of 10 N, rms over the sheet [mm]")
    axes.set_ylabel("error on sensors never seen, rms [mm]")
    figure.savefig(path, dpi=120, facecolor="white")


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"
