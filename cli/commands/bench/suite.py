"""Command `eitskin bench all`: all benchmarks, one after the other."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich import box
from rich.markup import escape
from rich.table import Table

from eitskin.cli.options import TRAINING, Json, Output, Quiet, Seed, Verbose, ended_by_signals
from eitskin.errors import ConfigurationError
from eitskin.extras import require_all

if TYPE_CHECKING:
    from eitskin.benchmarks.suite import Benchmark

Out = Annotated[Path, typer.Option(help="Folder of all results; each benchmark has one in it.")]
_OUT = Path("build/bench")
_COLOURS = {"measured": "green", "failed": "bold red"}


def run_all(
    out: Out = _OUT,
    *,
    only: Annotated[
        list[str] | None, typer.Option(help="Name of a benchmark; may be given several times.")
    ] = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="Fewer, smaller cases; without some benchmarks.")
    ] = False,
    long: Annotated[
        bool,
        typer.Option("--long", help="Also benchmarks of more than ten minutes, hours in all."),
    ] = False,
    fresh: Annotated[
        bool, typer.Option("--fresh", help="Repeat also what is measured already.")
    ] = False,
    data: Annotated[
        Path | None,
        typer.Option(help="Folder with real recordings, which some benchmarks need."),
    ] = None,
    seed: Seed = 0,
    as_json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Run all benchmarks, one after the other, into one folder with an index.md.

    Goes on after a benchmark that failed; the exit code is 1 then.
    """
    from eitskin.benchmarks import suite
    from eitskin.benchmarks.results import INDEX, write_index
    from eitskin.datasets.store.folder import make_folder

    output = Output(as_json, quiet, verbose)
    chosen = _chosen(only, long or quick)
    if only is None:
        require_all(training=TRAINING, hardware="serial cobs", bench="matplotlib")
    make_folder(out)
    done = []
    with ended_by_signals():  # or the benchmark that runs would go on without this one
        for each in suite.run_all(chosen, out, seed, quick=quick, fresh=fresh, data=data):
            done.append(each)
            why = f": {each.why}" if each.why else f" in {each.seconds:.0f} s"
            output.note(f"{len(done)} of {len(chosen)}: {each.name} {each.outcome}{why}")
    table = Table("benchmark", "outcome", "s", "", box=box.SIMPLE)
    for each in done:
        seconds = f"{each.seconds:.0f}" if each.seconds else ""
        table.add_row(each.name, _coloured(each.outcome), seconds, escape(each.why))
    rows = [{"name": d.name, "outcome": d.outcome, "why": d.why} for d in done]
    output.result({"benchmarks": rows, "index": str(out / INDEX)}, table)
    left_out = {each.name: each.why for each in done if each.outcome == "left out"}
    output.note(f"written: {write_index(out, left_out)}")  # last: results of others may be broken
    if any(each.outcome == "failed" for each in done):
        raise typer.Exit(1)


def _chosen(only: list[str] | None, long: bool) -> "list[Benchmark]":
    """Benchmarks by name, or all except long ones."""
    from eitskin.benchmarks.suite import ALL

    names = [each.name for each in ALL]
    for name in only or ():
        if name not in names:
            raise ConfigurationError(f"no benchmark {name!r}; there are: {', '.join(names)}")
    return [each for each in ALL if (each.name in only if only else long or not each.long)]


def _coloured(word: str) -> str:
    colour = _COLOURS.get(word, "yellow")
    return f"[{colour}]{word}[/]"
