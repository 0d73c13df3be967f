"""`eitskin bench transfer`: pipelines on sensors of worlds that they were not trained in."""

from pathlib import Path
from typing import Annotated, Any

import typer

from eitskin.cli.commands.bench.accuracy import Out, Quick
from eitskin.cli.commands.bench.skinbench import LeaderboardFile, entered, opened
from eitskin.cli.options import TRAINING, Json, Output, Quiet, Seed, Verbose
from eitskin.cli.terminal import FigureTable
from eitskin.errors import ConfigurationError
from eitskin.extras import require_all


def command(
    pipelines: Annotated[
        list[Path] | None,
        typer.Argument(help="Pipelines, NAME.eitmodel; that which comes with eitskin if omitted."),
    ] = None,
    out: Out = Path("build/bench"),
    *,
    quick: Quick = False,
    seed: Seed = 0,
    workers: Annotated[int, typer.Option(min=1, help="Processes that make frames.")] = 2,
    leaderboard: LeaderboardFile = None,
    as_json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Measure pipelines on sensors with other clamps, layers, contacts and boards.

    Each as it is, and adapted by 1 to 100 labelled frames, angles and presses. Frames are kept.
    """
    from eitskin.benchmarks.transfer.report import HEADINGS, NAME, figures, table, write
    from eitskin.benchmarks.transfer.run import run
    from eitskin.datasets.store.folder import make_folder
    from eitskin.training.pipeline.saved_form import SHIPPED

    output = Output(as_json, quiet, verbose)
    require_all(training=TRAINING)
    named = {path.stem: path for path in pipelines or [SHIPPED]}
    if len(named) < len(pipelines or []):
        raise ConfigurationError("expected pipelines of different names; rename one")
    board = opened(leaderboard, quick, seed)
    make_folder(out / NAME)
    with output.progress() as bar:
        tasks: dict[str, Any] = {}

        def show(part: str, done: int, total: int) -> None:
            if part not in tasks:
                tasks[part] = bar.add_task(part, total=total, rate="")
            bar.update(tasks[part], completed=done, total=total)

        found = run(named, out / NAME, seed, quick, workers, show)
    paths = [str(path) for path in (*write(found, out), *entered(board, out / NAME))]
    drawn = FigureTable(HEADINGS, list(table(found)), names=3)
    output.result({"figures": dict(figures(found)), "files": paths}, drawn)
    output.note("written: " + ", ".join(paths))
