"""Results of the study of the live page: figures by name, and tables."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from eitskin.benchmarks.studies.boards.live_windows import Window
from eitskin.benchmarks.studies.boards.trickling import CONNECTIONS, Held
from eitskin.provenance import Provenance

HELD = ("no browser", "one browser", "one browser, trickling connections")
COLUMNS = {
    "frames/s": "frames",
    "page updates/s": "updates",
    "pipeline p50, ms": "latency_p50_ms",
    "pipeline p99, ms": "latency_p99_ms",
    "end to end p50, ms": "drawn_p50_ms",
    "end to end p99, ms": "drawn_p99_ms",
}
HELD_COLUMNS = {"threads": "threads", "open files": "files", "memory, MB": "memory_mb"}


@dataclass(frozen=True, slots=True)
class Found:
    """Results of the study.

    Attributes:
        windows: in the order in which they were measured.
        stimulus: from a bend that is commanded to its drawing, of each trial [ms].
        held: threads, open files and memory of the process: no browser, one, trickling connections.
        trickling: how many of the trickling connections were open in the end.
        page_bytes: all that a browser loads before the first frame.
        refusals: answer to each attempt from a foreign page.
        back_after_s: from waking the stalled browser to its next update [s].
        stale_after_s: from unplugging the board to the page's message [s].
        complaints: errors of the page's console.
        event_bytes: size of the largest event.
        load: load average of the last minute before the study.
        provenance: where, when and with what.
    """

    windows: tuple[Window, ...]
    stimulus: tuple[float, ...]
    held: tuple[Held, ...]
    trickling: int
    page_bytes: int
    refusals: dict[str, str]
    back_after_s: float
    stale_after_s: float
    complaints: tuple[str, ...]
    event_bytes: int
    load: float
    provenance: Provenance


def figures_of(found: Found) -> dict[str, float]:
    """Figures by name: those of a table by row and column."""
    figures = {
        "back_s": found.back_after_s,
        "stale_s": found.stale_after_s,
        "page_bytes": float(found.page_bytes),
        "event_bytes": float(found.event_bytes),
        "console_errors": float(len(found.complaints)),
        "connections": float(CONNECTIONS),
        "still_open": float(found.trickling),
        "load": found.load,
        "bend_p50_ms": float(np.percentile(found.stimulus, 50)),
        "bend_p99_ms": float(np.percentile(found.stimulus, 99)),
        "bends": float(len(found.stimulus)),
    }
    for title, name, value in _cells(found):
        if value is not None and np.isfinite(value):
            figures[f"{title} / {name}"] = float(value)
    return figures


def _cells(found: Found) -> Iterator[tuple[str, str, float | None]]:
    """Row, column and value of each cell."""
    for window in found.windows:
        for name, attribute in COLUMNS.items():
            yield window.name, name, getattr(window, attribute)
    for title, held in zip(HELD, found.held, strict=True):
        for name, attribute in HELD_COLUMNS.items():
            yield title, name, getattr(held, attribute)


def as_markdown(found: Found) -> str:
    """Tables, other figures and refusals."""
    figures = figures_of(found)
    titles = [window.name for window in found.windows]
    lines = [*_table(titles, list(COLUMNS), figures, 1), ""]
    lines += [*_table(HELD, list(HELD_COLUMNS), figures, 0), ""]
    lines += [f"{name}: {value:g}" for name, value in figures.items() if " / " not in name]
    lines += ["", "| from a foreign page | came of it |", "|---|---|"]
    lines += [f"| {name} | {what} |" for name, what in found.refusals.items()]
    return "\n".join([*lines, "", str(found.provenance)]) + "\n"


def _table(
    rows: Sequence[str], columns: Sequence[str], figures: dict[str, float], digits: int
) -> Iterator[str]:
    yield f"| | {' | '.join(columns)} |"
    yield "|---" * (1 + len(columns)) + "|"
    for row in rows:
        values = [figures.get(f"{row} / {column}") for column in columns]
        cells = ["" if value is None else f"{value:.{digits}f}" for value in values]
        yield f"| {' | '.join((row, *cells))} |"
