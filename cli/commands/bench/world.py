"""`eitskin bench world`: presses and bends against reference solutions in 3D."""

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING

from rich import box
from rich.table import Table

from eitskin.cli.commands.bench.accuracy import Out, Quick
from eitskin.cli.options import Json, Output, Quiet, Seed, Verbose, watched
from eitskin.extras import require_all

if TYPE_CHECKING:
    from eitskin.benchmarks.world.run import World


def command(
    out: Out = Path("build/bench"),
    *,
    quick: Quick = False,
    seed: Seed = 0,
    json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Compare every model of presses and bends with reference solutions in 3D."""
    from eitskin.benchmarks.world.report import write
    from eitskin.benchmarks.world.run import run, sentences
    from eitskin.datasets.store.folder import make_folder

    output = Output(json, quiet, verbose)
    require_all(bench="matplotlib")
    make_folder(out)
    found = run(seed, quick, watched(output))
    paths = [str(path) for path in write(found, out)]
    data = dataclasses.asdict(found) | {
        "median": {kind: found.median(kind) for kind in found.kinds},
        "worst": {kind: dataclasses.asdict(found.worst(kind)) for kind in found.kinds},
        "files": paths,
    }
    output.result(data, _errors(found))
    output.show(_costs(found))
    for line in sentences(found):
        output.show(line)
    output.note("written: " + ", ".join(paths))


def _errors(found: "World") -> Table:
    table = Table("case", "model", "error [%]", "reference [%]", "s", box=box.SIMPLE)
    for column in table.columns[2:]:
        column.justify = "right"
    last = None
    for row in found.errors:
        table.add_row(
            "" if row.case == last else row.case,
            row.model,
            f"{100 * row.error:.2f}",
            f"{100 * row.reference_error:.1f}",
            f"{row.seconds:.3f}",
        )
        last = row.case
    return table


def _costs(found: "World") -> Table:
    table = Table("deformation alone [ms]", *(c.resolution for c in found.costs), box=box.SIMPLE)
    for column in table.columns[1:]:
        column.justify = "right"
    table.add_row("points", *(str(cost.points) for cost in found.costs))
    for name in found.costs[0].milliseconds:
        table.add_row(name, *(f"{cost.milliseconds[name]:.1f}" for cost in found.costs))
    return table
