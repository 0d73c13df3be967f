"""Files of `bench transfer`: results, and a table of all rows."""

from collections.abc import Iterator
from pathlib import Path

from eitskin.benchmarks.results import Results, write_results
from eitskin.benchmarks.transfer.run import Transfer
from eitskin.benchmarks.transfer.scores import Figures

NAME, BOUND = "transfer", "Cramer-Rao bound"
HEADINGS = (
    "pipeline",
    "world",
    "labelled",
    "states [%]",
    "angle [deg]",
    "/ SE",
    "false [%]",
    "found [%]",
    "place [mm]",
    "/ SE",
    "refused [%]",
)
_CELLS = (
    ("untouched states right", 100.0),
    ("angle, rms [deg]", 1.0),
    ("angle, error over standard error", 1.0),
    ("touches in untouched frames", 100.0),
    ("touches found", 100.0),
    ("place, mean [mm]", 1.0),
    ("place, error over standard error", 1.0),
    ("sensors refused", 100.0),
)


def write(found: Transfer, out: Path) -> list[Path]:
    """Write results and table.csv into `out/transfer`, each whole."""
    results = Results(
        name=NAME,
        command=f"eitskin bench transfer --seed {found.provenance.seed}" + " --quick" * found.quick,
        provenance=found.provenance,
        seconds=found.seconds,
        quick=found.quick,
        figures=dict(figures(found)),
    )
    rows = [
        {"pipeline": row.pipeline, "world": row.world, "labelled": str(row.labelled)}
        | {name: row.figures.get(name) for name, _ in _CELLS}
        for row in found.rows
    ]
    return write_results(results, out, rows)


def figures(found: Transfer) -> Iterator[tuple[str, float]]:
    """All figures by name, bounds last."""
    for row in found.rows:
        for name, value in row.figures.items():
            yield f"{row.pipeline} / {row.world}, {row.labelled} / {name}", value
    for world, limits in found.bounds.items():
        for name, value in limits.items():
            yield f"{BOUND} / {world} / {name}", value


def table(found: Transfer) -> Iterator[tuple[str, ...]]:
    """Cells of every row, under `HEADINGS`, and of the bounds."""
    for row in found.rows:
        yield row.pipeline, row.world, str(row.labelled), *_cells(row.figures)
    for world, limits in found.bounds.items():
        yield BOUND, world, "", *_cells(limits)


def _cells(figures: Figures) -> Iterator[str]:
    for name, factor in _CELLS:
        yield f"{factor * figures[name]:.3g}" if name in figures else "-"
