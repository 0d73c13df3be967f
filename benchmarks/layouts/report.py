"""Files of `eitskin bench layouts`: a table for people, CSV, JSON and maps."""

import dataclasses
import itertools
import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from eitskin.benchmarks.layouts.candidates import PAPER
from eitskin.benchmarks.layouts.plot import plot_maps
from eitskin.benchmarks.layouts.run import (
    FREE,
    FREED,
    MIRRORED,
    SEARCH,
    TURNED,
    LayoutComparison,
    LayoutFigures,
)
from eitskin.benchmarks.results import write_table
from eitskin.files import atomic_file

HEADINGS = (
    "layout",
    "n",
    "scan [ms]",
    "50 % [mm]",
    "90 %",
    "worst",
    "paced",
    "force [N]",
    "angle [deg]",
    "weak/strong",
    "condition",
    "patterns",
)
LEGEND = (
    "bound of the place of 10 N: median, 90 % and worst over the sheet, and 90 % paced, for as "
    "many frames as take the time of the paper's; force: 90 %; angle: of the untouched sheet; "
    "* a frame that does not fit into one packet on the wire"
)
SHORT = 9  # columns that fit into a terminal


def table(found: LayoutComparison) -> Iterator[tuple[str, ...]]:
    """Rows below the headings; a row of one cell, the name, begins each sweep."""
    before: tuple[str, str] | None = None
    for each in found.figures:
        part = (each.sweep, each.resolution)
        if part != before:
            finer = f", {each.resolution} mesh, places {each.spacing_mm:g} mm apart"
            yield (f"{each.sweep}{finer if each.sweep in (SEARCH, FREE) else ''}",)
        before = part
        yield _row(each)


def _row(each: LayoutFigures) -> tuple[str, ...]:
    return (
        each.layout,
        f"{each.measurements}{'' if each.fits_wire else '*'}",
        f"{each.scan_ms:.0f}",
        f"{each.place_mm:.2f}",
        f"{each.place_90_mm:.2f}",
        f"{each.place_worst_mm:.2f}",
        f"{each.place_90_paced_mm:.2f}",
        f"{each.force_90_n:.2f}",
        f"{each.angle_untouched_deg:.3f}",
        f"{each.uniformity:.3f}",
        f"{each.condition:.3g}",
        str(each.patterns),
    )


def sentences(found: LayoutComparison) -> Iterator[str]:
    """Sentences on the gain of the search, and the provenance."""
    for sweep, resolution in itertools.product((SEARCH, FREE), ("fast", "standard")):
        searched = found.found(sweep, resolution)
        least = searched[PAPER].place_90_mm if searched else math.nan
        for name, each in searched.items():
            if name != PAPER:
                change = 100 * (each.place_90_mm / least - 1)
                yield (
                    f"{name}, {resolution} mesh: {each.place_90_mm:.2f} mm for 90 % of the "
                    f"places, {change:+.0f} % of the paper's {least:.2f} mm"
                )
    ends = found.found(SEARCH, "standard") | found.found(FREE, "standard")
    for name, each in ends.items():
        if name in (MIRRORED, TURNED, FREED):
            yield f"{name}: middles at (x y) {each.electrodes_mm} mm"
    if found.quick:
        yield "quick: few places and candidates, so these say little"
    yield str(found.provenance)


def as_data(found: LayoutComparison) -> dict[str, Any]:
    """Comparison as plain data."""
    return {
        "provenance": dataclasses.asdict(found.provenance),
        "quick": found.quick,
        "layouts": [dataclasses.asdict(each) for each in found.figures],
    }


def markdown(found: LayoutComparison) -> str:
    """Markdown tables for a page, one per sweep."""
    lines: list[str] = []
    for row in table(found):
        if len(row) == 1:
            lines += ["", f"**{row[0]}**", "", _line(HEADINGS), _line(("---",) * len(HEADINGS))]
        else:
            lines.append(_line(row))
    return "\n".join([*lines[1:], "", *(f"- {each}" for each in (LEGEND, *sentences(found))), ""])


def write(found: LayoutComparison, folder: Path) -> list[Path]:
    """Write layouts.csv, layouts.md, layouts.json and layouts.png into `folder`, each whole."""
    paths = [folder / f"layouts.{ending}" for ending in ("csv", "md", "json", "png")]
    rows = [dataclasses.asdict(each) for each in found.figures]
    write_table(paths[0], rows, str(found.provenance))
    for path, text in ((paths[1], markdown(found)), (paths[2], json.dumps(as_data(found)) + "\n")):
        with atomic_file(path) as temporary:
            temporary.write_text(text, encoding="utf-8")
    with atomic_file(paths[3]) as temporary:
        plot_maps(found, temporary)
    return paths


def _line(cells: tuple[str, ...]) -> str:
    return "| " + " | ".join(cells) + " |"
