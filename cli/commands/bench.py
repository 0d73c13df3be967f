"""The command group `eitskin bench`: errors and run times, written and shown alike."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich import box
from rich.markup import escape
from rich.table import Table

from eitskin.cli import options
from eitskin.cli.help import Command
from eitskin.errors import ConfigurationError
from eitskin.extras import require_all

if TYPE_CHECKING:
    from eitskin.benchmarks.results import Progress, Report

app = typer.Typer(help="Measure errors and run times.", no_args_is_help=True)

Out = Annotated[Path, typer.Option(help="Folder of all results; each benchmark has one in it.")]
Quick = Annotated[bool, typer.Option("--quick", help="Run fewer and smaller cases.")]
Workers = Annotated[int, typer.Option(min=1, help="Number of worker processes.")]
Presets = Annotated[
    list[str] | None,
    typer.Option("--preset", help="Baseline: ridge, mlp, extra-trees, greit or quick. Repeatable."),
]
Methods = Annotated[
    list[str] | None,
    typer.Option(
        "--method",
        metavar="CODE",
        help="Your own method, whose code is run: FILE.py:CLASS, or the name of an installed "
        "one. Repeatable.",
    ),
]
LeaderboardFile = Annotated[
    Path | None,
    typer.Option(help="Also enter the scores into this leaderboard of skinbench, a JSON file."),
]
_OUT = Path("build/bench")
_COLOURS = {"measured": "green", "failed": "bold red"}


_SEEDED_BENCHMARKS = {
    "accuracy": "Measure error and run time of the forward model and of pyEIT.",
    "stability": "Run stiff and extreme cases; exit code 1 where one gives a wrong result.",
    "world": "Compare every model of presses and bends with reference solutions in 3D.",
    "speed": "Measure scenes, dataset frames and pipeline frames per second.",
}
"""Benchmarks that take a seed alone: `run(seed, quick, watch)` of their module."""


def _seeded_command(name: str) -> Callable[..., None]:
    """Command of one of `_SEEDED_BENCHMARKS`."""

    def command(
        out: Out = _OUT, *, quick: Quick = False, seed: int = 0, output: options.Output
    ) -> None:
        from eitskin.benchmarks import accuracy, speed, world
        from eitskin.benchmarks.stability import run as stability

        modules = {"accuracy": accuracy, "stability": stability, "world": world, "speed": speed}
        require_all(training="torch safetensors" if name == "speed" else "", bench="matplotlib")
        _make(out)
        _present(output, modules[name].run(seed, quick, options.progress_watcher(output)), out)

    return command


for _name, _help in _SEEDED_BENCHMARKS.items():
    app.command(_name, cls=Command, help=_help)(options.with_output(_seeded_command(_name)))


@app.command(cls=Command)
@options.with_output
def recordings(
    data: Annotated[Path, typer.Argument(help="Folder of the real recordings.")],
    out: Out = _OUT,
    *,
    quick: Quick = False,
    leaderboard: LeaderboardFile = None,
    output: options.Output,
) -> None:
    """Measure real recordings: presses of a round skin, a frame of another board, a water tank."""
    from eitskin.benchmarks.recordings import run

    require_all(training=options.TRAINING, bench="matplotlib")
    _require_whole(leaderboard, quick)
    _present(output, run(data, quick, options.progress_watcher(output)), out, leaderboard)


@app.command(cls=Command)
@options.with_output
def tank(
    data: Annotated[Path, typer.Argument(help="Folder of the Kuopio Tomography Challenge 2023.")],
    out: Out = _OUT,
    *,
    quick: Quick = False,
    output: options.Output,
) -> None:
    """Score regions of targets in a water tank, and pyEIT's, and draw them."""
    from eitskin.benchmarks.tank_targets import run

    require_all(bench="matplotlib pyeit")
    _present(output, run(data, quick, options.progress_watcher(output)), out)


@app.command(cls=Command)
@options.with_output
def transfer(
    pipelines: Annotated[
        list[Path] | None,
        typer.Argument(help="Pipelines, NAME.eitmodel; the pretrained one if omitted."),
    ] = None,
    out: Out = _OUT,
    *,
    quick: Quick = False,
    seed: int = 0,
    workers: Workers = 2,
    leaderboard: LeaderboardFile = None,
    output: options.Output,
) -> None:
    """Measure pipelines on sensors with other clamps, layers, contacts and boards.

    Each as it is, and adapted by 1 to 100 labelled frames, angles and presses. Frames are kept.
    """
    from eitskin.benchmarks.transfer import run
    from eitskin.training.pipeline.saved_form import SHIPPED_PATH

    require_all(training=options.TRAINING)
    named = {path.stem: path for path in pipelines or [SHIPPED_PATH]}
    if len(named) < len(pipelines or []):
        raise ConfigurationError("expected pipelines of different names; rename one")
    _require_whole(leaderboard, quick, seed)
    with _folder(output, out, "transfer") as (folder, progress):
        report = run(named, folder, seed, quick, workers, progress)
    _present(output, report, out, leaderboard)


@app.command(cls=Command)
@options.with_output
def life(
    pipeline: Annotated[
        Path | None,
        typer.Argument(help="Pipeline, NAME.eitmodel; the pretrained one if omitted."),
    ] = None,
    out: Out = _OUT,
    *,
    hours: Annotated[
        float | None, typer.Option(min=0.0, max=1000.0, help="Hours of streams; one if omitted.")
    ] = None,
    quick: Quick = False,
    seed: int = 0,
    output: options.Output,
) -> None:
    """Measure a pipeline in streams of touches that move, bends, faults and the unknown.

    By event: errors, delays, and how often it is wrong without a word, or warns without need.
    Streams are kept.
    """
    from eitskin.benchmarks.life import run
    from eitskin.training.pipeline.saved_form import SHIPPED_PATH

    require_all(training=options.TRAINING)
    with _folder(output, out, "life") as (folder, progress):
        report = run(pipeline or SHIPPED_PATH, folder, seed, hours, quick, progress)
    _present(output, report, out)


@app.command(cls=Command)
@options.with_output
def methods(
    out: Out = _OUT,
    *,
    preset: Presets = None,
    method: Methods = None,
    quick: Quick = False,
    seed: int = 0,
    workers: Workers = 2,
    leaderboard: LeaderboardFile = None,
    output: options.Output,
) -> None:
    """Train methods on the same frames, and test them on the same unseen sensors.

    The baselines where none is named. Frames are kept.
    """
    from eitskin.benchmarks.methods import run

    require_all(training=options.TRAINING)
    own = {each.KIND: (each, code) for code in method or () if (each := options.own_method(code))}
    _require_whole(leaderboard, quick, seed)
    classes = [each for each, _ in own.values()]
    with _folder(output, out, "methods") as (folder, progress):
        report = run(folder, preset or (), classes, seed, quick, workers, progress)
    codes = {name: code for name, (_, code) in own.items()}
    _present(output, report, out, leaderboard, codes)


@app.command(cls=Command)
@options.with_output
def paper(
    out: Out = _OUT,
    *,
    pipeline: Annotated[
        Path | None,
        typer.Option(help="Pipeline, NAME.eitmodel; the pretrained one if omitted."),
    ] = None,
    seeds: Annotated[int, typer.Option(min=1, help="Number of seeds; the first is 0.")] = 3,
    workers: Workers = 2,
    paper_seeds: Annotated[
        int | None,
        typer.Option(
            min=0,
            help="Seeds that the paper's pipeline is trained for; all if omitted, 0 for none.",
        ),
    ] = None,
    preset: Presets = None,
    method: Methods = None,
    leaderboard: LeaderboardFile = None,
    quick: Quick = False,
    output: options.Output,
) -> None:
    """Repeat the paper's experiments: published, its pipeline trained here, ours, and others.

    Frames are kept; a run that was stopped goes on from them.
    """
    from eitskin.benchmarks.paper.run import Contender, run
    from eitskin.training.pipeline.saved_form import SHIPPED_PATH

    require_all(training=options.TRAINING, bench="matplotlib")
    contenders = [Contender(each) for each in preset or ()]
    own = [Contender(method=options.own_method(each)) for each in method or ()]
    for each in (*contenders, *own):
        each.settings(0)  # unknown names are reported before the work
    _require_whole(leaderboard, quick)
    with _folder(output, out, "paper") as (folder, progress):
        report = run(
            pipeline or SHIPPED_PATH,
            folder,
            seeds,
            quick,
            workers,
            progress,
            paper_seeds=paper_seeds,
            contenders=[*contenders, *own],
        )
    codes = {each.name: code for each, code in zip(own, method or (), strict=True)}
    _present(output, report, out, leaderboard, codes)


@app.command(cls=Command)
@options.with_output
def layouts(
    out: Out = _OUT,
    *,
    sweep: Annotated[
        list[str] | None,
        typer.Option(
            help="count, placement, width, contact, bend or search; repeatable, all if omitted."
        ),
    ] = None,
    workers: Workers = 2,
    quick: Quick = False,
    output: options.Output,
) -> None:
    """Cramer-Rao bounds of touches for electrode layouts: sweeps, and a search for the best eight.

    Finished layouts are kept in the folder; a run that was stopped goes on from them.
    """
    from eitskin.benchmarks.layouts.run import NAMES, run

    require_all(bench="matplotlib")
    with _folder(output, out, "layouts") as (folder, progress):
        report = run(
            folder / "parts",
            names=sweep or NAMES,
            quick=quick,
            workers=workers,
            progress=progress,
        )
    _present(output, report, out)


@app.command("all", cls=Command)
@options.with_output
def bench_all(
    out: Out = _OUT,
    *,
    only: Annotated[list[str] | None, typer.Option(help="Name of a benchmark. Repeatable.")] = None,
    quick: Quick = False,
    long: Annotated[
        bool,
        typer.Option("--long", help="Also run the benchmarks that take more than ten minutes."),
    ] = False,
    fresh: Annotated[
        bool, typer.Option("--fresh", help="Measure again what is already measured.")
    ] = False,
    data: Annotated[
        Path | None,
        typer.Option(help="Folder with real recordings, which one benchmark needs."),
    ] = None,
    seed: int = 0,
    output: options.Output,
) -> None:
    """Run all benchmarks, one after the other, into one folder with an index.md.

    Goes on after a benchmark that failed; the exit code is 1 then.
    """
    from eitskin.benchmarks.results import INDEX, run_all, select_benchmarks, write_index

    chosen = select_benchmarks(only, long or quick)
    if only is None:
        require_all(training=options.TRAINING, hardware="serial cobs", bench="matplotlib")
    _make(out)
    done = []
    with options.ended_by_signals():  # or the benchmark that runs would go on without this one
        for each in run_all(chosen, out, seed, quick=quick, fresh=fresh, data=data):
            done.append(each)
            why = f": {each.why}" if each.why else f" in {each.seconds:.0f} s"
            output.note(f"{len(done)} of {len(chosen)}: {each.name} {each.outcome}{why}")
    table = Table("benchmark", "outcome", "s", "", box=box.SIMPLE)
    for each in done:
        seconds, colour = f"{each.seconds:.0f}" if each.seconds else "", _COLOURS.get(each.outcome)
        table.add_row(
            each.name, f"[{colour or 'yellow'}]{each.outcome}[/]", seconds, escape(each.why)
        )
    rows = [{"name": d.name, "outcome": d.outcome, "why": d.why} for d in done]
    output.result({"benchmarks": rows, "index": str(out / INDEX)}, table)
    left_out = {each.name: each.why for each in done if each.outcome == "left out"}
    output.note(f"written: {write_index(out, left_out)}")  # last: results of others may be broken
    if any(each.outcome == "failed" for each in done):
        raise typer.Exit(1)


def _present(
    output: options.Output,
    report: "Report",
    out: Path,
    leaderboard: Path | None = None,
    codes: Mapping[str, str] | None = None,
) -> None:
    """Write a report, enter it into a leaderboard where one is named, and show it.

    Exit code 1 where it failed.
    """
    import msgspec

    paths = report.write(out)
    if leaderboard is not None:
        from eitskin.benchmarks.leaderboard import enter

        enter(leaderboard, report.results, out / report.results.name, codes or {})
        paths.append(leaderboard)
    files = [str(path) for path in paths]
    data = msgspec.to_builtins(report.results) | {"rows": report.rows, "files": files}
    output.result(data, report.tables[0])
    for table in report.tables[1:]:
        output.show(table)
    for line in (*report.sentences, str(report.results.provenance)):
        output.show(escape(line))
    output.note("written: " + ", ".join(files))
    if report.failed:
        raise typer.Exit(1)


def _require_whole(leaderboard: Path | None, quick: bool, seed: int = 0) -> None:
    """Raise ConfigurationError, before the work, where a run would be no entry; DataError too."""
    if leaderboard is None:
        return
    from eitskin.benchmarks.leaderboard import SEED, read_leaderboard

    if quick or seed != SEED:
        raise ConfigurationError(
            f"a leaderboard takes full runs with seed {SEED}; leave --quick and --seed out, or "
            "--leaderboard"
        )
    read_leaderboard(leaderboard)


def _make(folder: Path) -> None:
    """Make a folder of results."""
    from eitskin.datasets.store.folder import make_folder

    make_folder(folder)


@contextmanager
def _folder(output: options.Output, out: Path, name: str) -> Iterator[tuple[Path, "Progress"]]:
    """Folder of one benchmark, made, and the progress of its parts on a bar.

    Each part is shown by the name before its colon.
    """
    _make(out / name)
    with output.bars() as show:

        def show_part(part: str, done: int, total: int) -> None:
            name, _, step_name = part.partition(": ")
            show(name, done, total, step_name)

        yield out / name, show_part
