"""What is quoted beside what was measured: equal within its spread, off, or not measured."""

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from eitskin.benchmarks.markdown_tables import value_of
from eitskin.benchmarks.quotes import ROOT, Number, Page, Picture, pages, unit_of
from eitskin.benchmarks.results import Results, found_results
from eitskin.errors import ConfigurationError
from eitskin.extras import require

SHADE = 0.1  # difference of a channel, of 0 to 1, below which two points are alike


@dataclass(frozen=True, slots=True)
class Compared:
    """One number or picture.

    Attributes:
        document, line: where it stands; line 0 for a picture.
        written: the number as it stands there, or the picture's file.
        results, key: name of the results, and of the figure or picture in them.
        measured: the figure, or the share of the points that differ; None where there is none.
        spread: by how much it may differ, and why.
        verdict: "equal", "off", "not measured" or "no such figure".
    """

    document: str
    line: int
    written: str
    results: str
    key: str
    measured: float | None
    spread: str
    verdict: str

    def as_data(self) -> dict[str, Any]:
        """As plain data."""
        return dataclasses.asdict(self)


def compare(
    out: Path, quoting: Sequence[Page] | None = None, root: Path = ROOT
) -> Iterator[Compared]:
    """Everything that pages quote beside the results in a folder.

    Args:
        out: folder of the results.
        quoting: the pages; all that are known when omitted.
        root: of the checkout that holds the documents.

    Raises ConfigurationError where there is no checkout, or a quote does not stand in its page.
    """
    if not (root / "docs").is_dir():
        raise ConfigurationError(f"there are no docs in {root}: run this in a checkout of eitskin")
    found = {each.name: each for each in found_results(out)}
    for page in pages() if quoting is None else quoting:
        for number in page.numbers(root):
            yield of_number(number, found)
        for picture in page.pictures():
            yield of_picture(picture, out, found, root)


def of_number(number: Number, found: Mapping[str, Results]) -> Compared:
    """One number beside its figure; those of quick runs are not for quoting."""
    measured, verdict = None, "not measured"
    if _for_quoting(number.results, found):
        measured, verdict = found[number.results].figures.get(number.key), "no such figure"
    if measured is not None:
        unit = unit_of(number.written)
        agree = number.spread.holds(value_of(number.written), measured, unit)
        verdict = "equal" if agree else "off"
    return Compared(
        document=number.document,
        line=number.line,
        written=number.written,
        results=number.results,
        key=number.key,
        measured=measured,
        spread=number.spread.why,
        verdict=verdict,
    )


def of_picture(
    picture: Picture, out: Path, found: Mapping[str, Results], root: Path = ROOT
) -> Compared:
    """One picture beside the one that was drawn; those of quick runs are not for quoting."""
    drawn, differs = out / picture.results / picture.name, None
    if drawn.is_file() and _for_quoting(picture.results, found):
        differs = differing(root / picture.file, drawn)
    verdict = "not measured"
    if differs is not None:
        verdict = "equal" if differs <= picture.points else "off"
    return Compared(
        document=picture.document,
        line=0,
        written=picture.file,
        results=picture.results,
        key=picture.name,
        measured=differs,
        spread=f"{100 * picture.points:g} % of the points",
        verdict=verdict,
    )


def _for_quoting(name: str, found: Mapping[str, Results]) -> bool:
    return name in found and not found[name].quick


def differing(one: Path, other: Path) -> float:
    """Share of the points in which two pictures differ; 1 where their sizes do."""
    read = require("matplotlib.image", "bench").imread
    a, b = read(one)[..., :3], read(other)[..., :3]
    if a.shape != b.shape:
        return 1.0
    return float(np.mean(np.abs(a - b).max(axis=-1) > SHADE))
