"""`eitskin bench paper`: the paper's experiments, repeated."""

from pathlib import Path
from typing import Annotated, Any

import typer

from eitskin.cli.commands.bench.skinbench import LeaderboardFile, entered, opened
from eitskin.cli.options import TRAINING, Json, Output, Quiet, Verbose, own_method
from eitskin.cli.terminal import FigureTable
from eitskin.extras import require_all

MethodCodes = Annotated[
    list[str] | None,
    typer.Option(
        "--method",
        metavar="CODE",
        help="Also a method of your own, whose code is run: FILE.py:CLASS, or the name of an "
        "installed one; may be given several times.",
    ),
]


def command(
    out: Annotated[
        Path, typer.Option(help="Folder of all results; frames are kept in its folder paper.")
    ] = Path("build/bench"),
    *,
    pipeline: Annotated[
        Path | None,
        typer.Option(help="Pipeline, NAME.eitmodel; the one that comes with eitskin if omitted."),
    ] = None,
    seeds: Annotated[int, typer.Option(min=1, help="Number of seeds; the first is 0.")] = 3,
    workers: Annotated[int, typer.Option(min=1, help="Processes that make frames.")] = 2,
    paper_seeds: Annotated[
        int | None,
        typer.Option(
            min=0,
            help="Seeds that the paper's pipeline is trained for; all if omitted, 0 for none.",
        ),
    ] = None,
    preset: Annotated[
        list[str] | None,
        typer.Option(
            help="Also ridge, mlp, extra-trees, greit or quick, trained here; may be given several "
            "times."
        ),
    ] = None,
    method: MethodCodes = None,
    leaderboard: LeaderboardFile = None,
    quick: Annotated[bool, typer.Option("--quick", help="A tenth of the frames.")] = False,
    as_json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Repeat the paper's experiments: published, its pipeline trained here, ours, and others.

    Frames are kept; a run that was stopped goes on from them.
    """
    from eitskin.benchmarks.paper.report import NAME, as_data, headings, sentences, table, write
    from eitskin.benchmarks.paper.run import REFERENCE, Contender, run
    from eitskin.datasets.store.folder import make_folder

    output = Output(as_json, quiet, verbose)
    require_all(training=TRAINING, bench="matplotlib")
    contenders = [Contender(each) for each in preset or ()]
    contenders += [Contender(method=own_method(each)) for each in method or ()]
    for each in contenders:
        each.settings(0)  # unknown names are told before the work
    board = opened(leaderboard, quick)
    make_folder(out / NAME)
    with output.progress() as bar:
        tasks: dict[str, Any] = {}

        def show(part: str, done: int, total: int) -> None:
            name, _, rest = part.partition(": ")
            if name not in tasks:
                tasks[name] = bar.add_task(name, total=total, rate="")
            bar.update(tasks[name], completed=done, total=total, rate=rest)

        found = run(
            pipeline or REFERENCE,
            out / NAME,
            seeds,
            quick,
            workers,
            show,
            paper_seeds=paper_seeds,
            contenders=contenders,
        )
    paths = write(found, out)
    codes = zip(contenders[len(preset or ()) :], method or (), strict=True)
    paths += entered(board, out / NAME, {each.name: code for each, code in codes})
    drawn = FigureTable(headings(found), list(table(found)))
    output.result(as_data(found) | {"files": [str(path) for path in paths]}, drawn)
    for line in sentences(found):
        output.show(line)
    output.note("written: " + ", ".join(str(path) for path in paths))
