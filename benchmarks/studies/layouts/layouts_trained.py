"""Pipelines trained for layouts of 8, 12, 16 and 32 electrodes, beside their Cramer-Rao bounds.

Run by `python -m eitskin.benchmarks.studies.layouts.layouts_trained --out OUT`. Bounds, frames and
scores of finished layouts are kept in OUT: the same command goes on where it was stopped.
"""

import argparse
import dataclasses
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eitskin.benchmarks.layouts.candidates import SIZE, Layout, paper, sweeps, with_electrodes
from eitskin.benchmarks.layouts.run import MIRRORED, QUICK_SAMPLING, SAMPLING, SEED
from eitskin.benchmarks.layouts.search import at_arcs
from eitskin.benchmarks.layouts.store import judging
from eitskin.benchmarks.results import Results, write_results
from eitskin.benchmarks.studies.layouts.lesson import QUICK, Learned, Lesson, learn_all
from eitskin.extras import require
from eitskin.geometry.design.electrode import Electrode
from eitskin.provenance import Provenance

NAME = "layouts_trained"
_COUNTS = ("12 on the rim", "16 on the rim", "32 on the rim")
_MIRRORED = (0.02625, 0.075, 0.12375, 0.18, 0.23625, 0.285, 0.33375, 0.39)  # by the search [m]
_DRAWN = (
    ("error_mm", 1.0, "place, mean error [mm]"),
    ("found", 100.0, "presses found [%]"),
    ("false", 100.0, "false touches per press [%]"),
    ("angle_deg", 1.0, "angle, rms error [deg]"),
)


def one_sided() -> Layout:
    """Layout of eight electrodes along one long side, insensitive at the other."""
    pitch = SIZE[0] / 8
    row = [Electrode(pitch * (i + 0.5), 0.0) for i in range(8)]
    return with_electrodes("8 along one side", row)


def compared(quick: bool) -> list[Layout]:
    """Layouts that pipelines are trained for; of a quick run the paper's and a poor one."""
    if quick:
        return [paper(), one_sided()]
    counted = {each.name: each for each in sweeps()["count"]}
    return [paper(), at_arcs(MIRRORED, _MIRRORED), *(counted[name] for name in _COUNTS)]


def figures(learned: Sequence[Learned]) -> dict[str, float]:
    """Scores by "layout / score", standard errors by "layout / score, error"."""
    named: dict[str, float] = {}
    for each in learned:
        scores = dataclasses.asdict(each)
        errors = scores.pop("errors")
        scores |= {f"{name}, error": value for name, value in errors.items()}
        for name in ("found", "false"):
            for key in (name, f"{name}, error"):
                scores[key] = 100.0 * scores.get(key, float("nan"))
        named |= {
            f"{each.layout} / {name}": float(value)
            for name, value in scores.items()
            if name != "layout" and value is not None
        }
    return named


def plot(learned: Sequence[Learned], path: Path) -> None:
    """Draw each score by layout, with bars of twice its standard error, and bounds beside them."""
    figure = require("matplotlib.figure", "bench").Figure(figsize=(9.5, 5.0), layout="constrained")
    names = [each.layout.removesuffix(" on the rim").removeprefix("paper: ") for each in learned]
    for axes, (score, scale, title) in zip(figure.subplots(2, 2).ravel(), _DRAWN, strict=True):
        values = _column(learned, score) * scale
        bars = [2.0 * scale * each.errors.get(score, np.nan) for each in learned]
        axes.errorbar(range(len(values)), values, bars, fmt="o", color="#1f5f8b", capsize=3)
        if bound := {"error_mm": "bound_rms_mm", "angle_deg": "bound_angle_deg"}.get(score):
            axes.plot(range(len(values)), _column(learned, bound), "_", color="#888888", ms=14)
        axes.set_xticks(range(len(names)), names, fontsize=8)
        axes.set_title(title, fontsize=10)
        axes.set_ylim(bottom=0.0)
        axes.margins(x=0.1)
        axes.grid(axis="y", color="#dddddd")
    figure.supxlabel("electrodes; bars: twice the standard error over sensors", fontsize=9)
    figure.savefig(path, dpi=120, facecolor="white")


def _column(learned: Sequence[Learned], name: str) -> NDArray[np.float64]:
    values: list[Any] = [getattr(each, name) for each in learned]
    return np.array([np.nan if each is None else each for each in values], dtype=float)


def main() -> None:
    """Train, test, write and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("build/bench"))
    parser.add_argument("--quick", action="store_true", help="few frames, two layouts")
    parser.add_argument("--workers", type=int, default=1)
    options = parser.parse_args()
    began, folder = time.process_time(), options.out / NAME
    layouts = compared(options.quick)
    sampling = QUICK_SAMPLING if options.quick else SAMPLING
    with judging(folder / "parts", options.workers) as judge:
        bounds = judge([(layout, sampling) for layout in layouts])
    learned = learn_all(
        list(zip(layouts, bounds, strict=True)),
        folder / "trained",
        lesson=QUICK if options.quick else Lesson(seed=SEED),
        workers=options.workers,
        watch=lambda name: print(name, flush=True),
    )
    results = Results(
        NAME,
        f"python -m eitskin.benchmarks.studies.layouts.{NAME} --out OUT",
        Provenance.now(SEED),
        time.process_time() - began,
        options.quick,
        figures(learned),
    )
    rows = [dataclasses.asdict(each) | {"errors": str(each.errors)} for each in learned]
    plots = {f"{NAME}.png": lambda path: plot(learned, path)}
    write_results(results, options.out, rows, plots)
    for name, value in results.figures.items():
        print(f"{name}: {value:.3g}")


if __name__ == "__main__":
    main()
