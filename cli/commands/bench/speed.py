"""`eitskin bench speed`: scenes, frames and datasets per second."""

import dataclasses
from pathlib import Path
from typing import Annotated

import typer

from eitskin.cli.options import Json, Output, Quiet, Seed, Verbose, watched
from eitskin.cli.terminal import FigureTable
from eitskin.extras import require_all


def command(
    out: Annotated[Path, typer.Option(help="Folder of all results.")] = Path("build/bench"),
    *,
    quick: Annotated[
        bool, typer.Option("--quick", help="Two workloads and few scenes, in a minute.")
    ] = False,
    seed: Seed = 0,
    as_json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Measure scenes per second beside their error, pyEIT, datasets, and frames of the pipeline."""
    from eitskin.benchmarks.speed.report import HEADINGS, sentences, table, write
    from eitskin.benchmarks.speed.run import run
    from eitskin.datasets.store.folder import make_folder

    output = Output(as_json, quiet, verbose)
    require_all(training="torch safetensors", bench="matplotlib")
    make_folder(out)
    found = run(seed, quick, watched(output))
    paths = [str(path) for path in write(found, out)]
    drawn = FigureTable(HEADINGS, list(table(found)))
    ratio = found.peer_ratio if found.peer else None
    output.result(dataclasses.asdict(found) | {"pyeit_ratio": ratio, "files": paths}, drawn)
    for line in sentences(found):
        output.show(line)
    output.note("written: " + ", ".join(paths))
