"""Files of `bench paper`: the table as Markdown, CSV and JSON, and plots."""

import dataclasses
import json
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from eitskin.benchmarks import markdown_tables
from eitskin.benchmarks.paper.limits import SignalToNoise
from eitskin.benchmarks.paper.lines import LINES, TableLine
from eitskin.benchmarks.paper.plot import plot_time, plot_touches
from eitskin.benchmarks.paper.run import OURS, OWN, PaperComparison
from eitskin.benchmarks.paper.scores import Figures
from eitskin.benchmarks.results import Results, write_results
from eitskin.training.evaluation.matching import GATE
from eitskin.training.evaluation.scores import SSIM_DEFINITION

BOUND = "Cramer-Rao bound"
NAME = "paper"
_DIGITS = {"mm": 2, "deg": 2, "%": 2, "ms": 2, "": 3}


def columns(found: PaperComparison) -> list[str]:
    """Columns that have figures."""
    return [name for name, seeds in found.figures.items() if seeds]


def headings(found: PaperComparison) -> tuple[str, ...]:
    """Heads of the table's columns."""
    return ("experiment", "paper", *columns(found), "to reach", "bound", "ours / bound")


def table(found: PaperComparison) -> Iterator[tuple[str, ...]]:
    """Rows of cells under `headings`: mean and standard deviation over the seeds.

    Indented lines that no column has a figure for are left out; others head what follows them.
    """
    for line in LINES:
        cells_of = [_values(found.figures[name], line) for name in columns(found)]
        bound = _values(found.bounds, line)
        if line.text.startswith(" ") and not any(cells_of):
            continue
        ours = _values(found.figures[OURS], line)
        multiple = f"{np.mean(ours) / np.mean(bound):.1f}" if ours and bound else ""
        cells = (_cell(values, line.unit) for values in cells_of)
        text = f"{line.text} [{line.unit}]" if line.unit else line.text
        yield text, line.paper, *cells, line.target, _cell(bound, line.unit), multiple


def _values(figures: Sequence[Figures], line: TableLine) -> list[float]:
    """Values of the seeds that have one."""
    factor = 100.0 if line.unit == "%" else 1.0
    return [factor * each[line.figure] for each in figures if line.figure in each]


def _cell(values: Sequence[float], unit: str) -> str:
    if not values:
        return ""
    digits = _DIGITS[unit]
    mean = f"{np.mean(values):.{digits}f}"
    return mean if len(values) == 1 else f"{mean} +- {np.std(values, ddof=1):.{digits}f}"


def sentences(found: PaperComparison) -> Iterator[str]:
    """Sentences below the table."""
    seeds = ", ".join(map(str, found.seeds))
    quick = "; a tenth of the frames, for trying out only" if found.quick else ""
    yield f"{found.provenance}; seeds {seeds}{quick}"
    trained = len(found.figures[OWN])
    if trained < len(found.seeds):
        yield f"The paper's pipeline was trained for {trained} of these seeds."
    yield f"ours: {found.pipeline}"
    yield (
        "Means over the seeds, +- their standard deviation. Each seed has its own sensors, frames, "
        "and a pipeline of the paper that is trained on one sensor, tested on that one and on "
        "sensors never seen; ours is one pipeline, on the same unseen sensors. Training meshes are "
        "coarser than the test frames'."
    )
    if found.contenders:
        names = ", ".join(each.name for each in found.contenders)
        yield (
            f"{names}: trained on the frames of the paper's pipeline, of one sensor, with the same "
            "seeds; ours has learned from other frames, of many sensors. An empty cell is a "
            "quantity that a method does not estimate."
        )
    yield SSIM_DEFINITION
    yield (
        f"Places: touches matched by the Hungarian method within {1e3 * GATE:g} mm; what is not "
        "matched is missed or false and has no error."
    )
    yield (
        "Bounds: white noise alone, of the nominal sensor, some of the frames. The bound of an "
        "angle while touched is that of the frame by itself; a pipeline also knows the frames "
        "before the touch, so it may do better."
    )
    for seed, ratio in zip(found.seeds, found.signal_to_noise, strict=True):
        yield f"seed {seed}: {_ratio(ratio)}"
    yield f"instrument: {_terms(found.recipe.instrument)}"
    yield f"specimens: {_terms(found.recipe.specimens)}"


def _ratio(ratio: SignalToNoise) -> str:
    return (
        f"signal to noise of a touch, rms, per channel: {ratio.least:.1f} least, "
        f"{ratio.median:.1f} median, {ratio.most:.1f} most"
    )


def _terms(said: Any) -> str:
    return ", ".join(f"{name} {value}" for name, value in dataclasses.asdict(said).items() if value)


def figures(found: PaperComparison) -> dict[str, float]:
    """Means over the seeds as `COLUMN: FIGURE`, their deviations with ` +-`, shares in percent.

    Cells of the table have keys of their own, `ROW / COLUMN`.
    """
    named: dict[str, float] = {}
    for column, seeds in {**found.figures, BOUND: found.bounds}.items():
        for line in LINES:
            values = _values(seeds, line)
            if values:
                named[f"{column}: {line.figure}"] = float(np.mean(values))
            if len(values) > 1:
                named[f"{column}: {line.figure} +-"] = float(np.std(values, ddof=1))
    return named | markdown_tables.figures(markdown(found))


def as_data(found: PaperComparison) -> dict[str, Any]:
    """Comparison as plain data."""
    return {
        "provenance": dataclasses.asdict(found.provenance),
        "seeds": list(found.seeds),
        "quick": found.quick,
        "pipeline": found.pipeline,
        "figures": {name: list(each) for name, each in found.figures.items()},
        "bounds": list(found.bounds),
        "signal_to_noise": [dataclasses.asdict(each) for each in found.signal_to_noise],
        "variants": {each.name: list(each.figures) for each in found.variants},
        "instrument": dataclasses.asdict(found.recipe.instrument),
        "specimens": dataclasses.asdict(found.recipe.specimens),
        "definitions": {"ssim": SSIM_DEFINITION},
    }


def write(found: PaperComparison, out: Path) -> list[Path]:
    """Write results, table.csv, paper.md, paper.json and two plots into `out/paper`, each whole."""
    seeds, trained = len(found.seeds), len(found.figures[OWN])
    results = Results(
        name=NAME,
        command=f"eitskin bench paper --seeds {seeds} --paper-seeds {trained}"
        + " --quick" * found.quick
        + "".join(f" {each.option}" for each in found.contenders),
        provenance=dataclasses.replace(found.provenance, seed=found.seeds[0]),
        seconds=found.seconds,
        quick=found.quick,
        figures=figures(found),
    )
    files = {
        "paper.md": partial(_write_text, markdown(found)),
        "paper.json": partial(_write_text, json.dumps(as_data(found)) + "\n"),
        "paper-touches.png": partial(plot_touches, found),
        "paper-time.png": partial(plot_time, found),
    }
    return write_results(results, out, list(_long(found)), files)


def _write_text(text: str, path: Path) -> None:
    path.write_text(text, encoding="utf-8")


def markdown(found: PaperComparison) -> str:
    """Markdown of the table and its sentences."""
    heads = headings(found)
    rows = [heads, ("---",) * len(heads), *table(found)]
    lines = ["| " + " | ".join(cell.replace("  ", "&emsp;") for cell in row) + " |" for row in rows]
    return "\n".join([*lines, "", *(f"- {each}" for each in sentences(found)), ""])


def _long(found: PaperComparison) -> Iterator[dict[str, Any]]:
    """Rows of the long table: one per seed, column and figure."""
    columns = {**found.figures, BOUND: found.bounds}
    columns |= {f"variant: {each.name}": each.figures for each in found.variants}
    for column, seeds in columns.items():
        for seed, figures in zip(found.seeds, seeds, strict=False):
            for figure, value in figures.items():
                yield {"column": column, "seed": seed, "figure": figure, "value": value}
