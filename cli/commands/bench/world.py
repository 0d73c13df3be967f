"""`eitskin bench world`: presses and bends against reference solutions in 3D."""

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING

from eitskin.cli.commands.bench.accuracy import Out, Quick
from eitskin.cli.options import Json, Output, Quiet, Seed, Verbose, watched
from eitskin.cli.terminal import FigureTable
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


def _errors(found: "World") -> FigureTable:
    rows, last = [], None
    for row in found.errors:
        case = "" if row.case == last else row.case
        error, reference = f"{100 * row.error:.2f}", f"{100 * row.reference_error:.1f}"
        rows.append((case, row.model, error, reference, f"{row.seconds:.3f}"))
        last = row.case
    return FigureTable(("case", "model", "error [%]", "reference [%]", "s"), rows, names=2)


def _costs(found: "World") -> FigureTable:
    headings = ("deformation alone [ms]", *(cost.resolution for cost in found.costs))
    rows = [("points", *(str(cost.points) for cost in found.costs))]
    for name in found.costs[0].milliseconds:
        rows.append((name, *(f"{cost.milliseconds[name]:.1f}" for cost in found.costs)))
    return FigureTable(headings, rows)
