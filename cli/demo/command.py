"""`eitskin demo`: everything once, from the bare sensor to a pipeline on a live board."""

import shlex
from pathlib import Path
from typing import Annotated

import typer

from eitskin.cli.options import TRAINING, Json, Output, Quiet, Seed, Verbose, ended_by_signals
from eitskin.errors import PartialError
from eitskin.extras import require_all

FOLDER, WORKERS = Path("build/demo"), 2


def command(
    *,
    out: Annotated[
        Path, typer.Option(help="Folder for all that the demo makes; what is finished stays.")
    ] = FOLDER,
    data: Annotated[
        Path | None, typer.Option(help="Folder with real recordings; left out when absent.")
    ] = None,
    workers: Annotated[int, typer.Option(min=1, help="Processes that simulate.")] = WORKERS,
    seed: Seed = 0,
    as_json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Draw the sensor, make training sets, train, compare with the paper, run live, report.

    Every finished stage is kept in --out, so a demo that was interrupted goes on from there. The
    report is one file, report.html, that needs nothing else.
    """
    output = Output(as_json, quiet, verbose)
    try:
        with ended_by_signals():
            _run(out, data, workers, seed, output)
    except (KeyboardInterrupt, PartialError):
        again = ["eitskin", "demo", "--out", str(out)]
        again += [] if data is None else ["--data", str(data)]
        again += [] if workers == WORKERS else ["--workers", str(workers)]
        again += [] if seed == 0 else ["--seed", str(seed)]
        # Not through a console, which would break the line.
        typer.echo(f"finished stages are kept; continue with: {shlex.join(again)}", err=True)
        raise


def _run(out: Path, data: Path | None, workers: int, seed: int, output: Output) -> None:
    require_all(training=TRAINING, hardware="serial cobs", view="pyvista matplotlib", demo="jinja2")
    # Imports of the stages take seconds, and Ctrl-C shall be answered meanwhile.
    from eitskin.cli.demo.report import write_demo_report
    from eitskin.cli.demo.stages import run_stages
    from eitskin.cli.demo.workspace import Plan, Workspace

    demo = Workspace(Plan.standard(seed), out, data, workers, output)
    document = write_demo_report(run_stages(demo), demo)
    seconds = sum(document["seconds"].values())
    sentence = f"\nreport, made in {seconds:.0f} s: {(out / 'report.html').resolve().as_uri()}"
    output.result(document, sentence)
