"""Files of `bench world`: results, table, and the plot of error against time."""

import dataclasses
import statistics
from collections.abc import Iterator
from functools import partial
from pathlib import Path

from eitskin.benchmarks.results import Results, write_results
from eitskin.benchmarks.world.models import KINEMATIC, SOLVED, TABULATED
from eitskin.benchmarks.world.plot import plot
from eitskin.benchmarks.world.reference import KINDS
from eitskin.benchmarks.world.run import World

NAME = "world"


def write(found: World, out: Path) -> list[Path]:
    """Write results, table.csv and world.png into `out/world`, each whole."""
    results = Results(
        name=NAME,
        command=f"eitskin bench world --seed {found.provenance.seed}" + " --quick" * found.quick,
        provenance=found.provenance,
        seconds=found.seconds,
        quick=found.quick,
        figures=dict(figures(found)),
    )
    rows = [dataclasses.asdict(row) for row in found.errors]
    return write_results(results, out, rows, {"world.png": partial(plot, found)})


def figures(found: World) -> Iterator[tuple[str, float]]:
    """All figures by name: errors and depths by case and model, costs, sizes and counts."""
    for row in found.errors:
        yield f"{row.case} / {row.model} [%]", 100 * row.error
        if row.depth is not None:
            yield f"{row.case} / {row.model}, depth [mm]", 1e3 * row.depth
        yield f"{row.case} / {row.model} [s]", row.seconds
        yield f"{row.case} / reference [%]", 100 * row.reference_error
        if row.reference_depth is not None:
            yield f"{row.case} / reference, depth [mm]", 1e3 * row.reference_depth
    for kind in KINDS:
        for model in (KINEMATIC, TABULATED, SOLVED):
            rows = found.of(model, kind)
            if rows:
                yield (
                    f"{kind} / {model}, median [%]",
                    100 * statistics.median(r.error for r in rows),
                )
                yield f"{kind} / {model}, worst [%]", 100 * max(r.error for r in rows)
                yield f"{kind} / {model}, median [s]", statistics.median(r.seconds for r in rows)
        if found.default(kind):
            yield f"{kind} / default, cases", len(found.default(kind))
            yield f"{kind} / default, median [%]", 100 * found.median(kind)
            yield f"{kind} / default, worst [%]", 100 * found.worst(kind).error
    for cost in found.costs:
        yield f"{cost.resolution} / points", cost.points
        for name, milliseconds in cost.milliseconds.items():
            yield f"{cost.resolution} / {name} [ms]", milliseconds
    for kind, size in found.stored.items():
        yield f"stored / {kind} [kB]", 1e-3 * size
    for name, count in found.counts.items():
        yield f"looked up / {name}", count
