"""`eitskin bench`: measurements of the package itself, with what they were made on."""

import dataclasses
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich import box
from rich.markup import escape
from rich.table import Table

from eitskin.cli.commands import bench_layouts, bench_paper, bench_speed, bench_suite
from eitskin.cli.options import Json, Output, Quiet, Seed, Verbose, watched
from eitskin.extras import require_all

if TYPE_CHECKING:
    from eitskin.benchmarks.accuracy.run import Accuracy
    from eitskin.benchmarks.stability.run import Stability

app = typer.Typer(help="Measure errors and times.", no_args_is_help=True)
app.command("paper")(bench_paper.command)
app.command("layouts")(bench_layouts.command)
app.command("speed")(bench_speed.command)
app.command("all")(bench_suite.run_all)
app.command("quoted")(bench_suite.quoted)


Out = Annotated[Path, typer.Option(help="Folder of all results; each benchmark has one in it.")]
Quick = Annotated[bool, typer.Option("--quick", help="Fewer and smaller, in half a minute.")]
_OUT = Path("build/bench")


@app.command("accuracy")
def accuracy(
    out: Out = _OUT,
    *,
    quick: Quick = False,
    seed: Seed = 0,
    json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Error against run time of the forward model, beside pyEIT: table, CSV and plot."""
    from eitskin.benchmarks.accuracy.report import misses, write
    from eitskin.benchmarks.accuracy.run import run
    from eitskin.datasets.store.folder import make_folder

    output = Output(json, quiet, verbose)
    require_all(bench="threadpoolctl matplotlib")
    make_folder(out)
    found = run(seed, quick, watched(output))
    paths = write(found, out)
    output.result(_as_data(found, paths), _as_table(found))
    output.show(_deformed_table(found))
    for line in (*_sentences(found), *misses(found)):
        output.show(line)
    output.note("written: " + ", ".join(str(path) for path in paths))


@app.command("stability")
def stability(
    out: Out = _OUT,
    *,
    quick: Quick = False,
    seed: Seed = 0,
    json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Stiff and extreme cases: what comes of each, and how far it can be trusted.

    Exit code 1 where one of them gives a wrong result.
    """
    from eitskin.benchmarks.stability.run import run, write
    from eitskin.datasets.store.folder import make_folder

    output = Output(json, quiet, verbose)
    make_folder(out)
    found = run(seed, quick, watched(output))
    paths = [str(path) for path in write(found, out)]
    data = dataclasses.asdict(found) | {"wrong": len(found.wrong), "files": paths}
    output.result(data, _stability_table(found))
    for line in _remarks(found, verbose):
        output.show(line)
    output.note("written: " + ", ".join(paths))
    if found.wrong:
        raise typer.Exit(1)


def _as_data(found: "Accuracy", paths: list[Path]) -> dict[str, Any]:
    return dataclasses.asdict(found) | {
        "ratios": [duel.ratio for duel in found.duels],
        "files": [str(path) for path in paths],
    }


def _as_table(found: "Accuracy") -> Table:
    table = Table(
        "mesh and element",
        "unknowns",
        "ms/frame",
        "error of R",
        "of signal",
        "z = 1e-4",
        box=box.SIMPLE,
        caption=str(found.provenance),
        caption_justify="left",
    )
    for column in table.columns[1:]:
        column.justify, column.no_wrap = "right", True
    last = None
    for point in found.points:
        if point.family != last:
            table.add_row(f"[bold]{point.family}[/bold]")
        table.add_row(
            f"  {point.name} ({point.solver.split()[0]})",
            str(point.unknowns),
            f"{1e3 * point.frame_seconds:.1f}",
            f"{point.resistance_error:.1e}",
            f"{point.signal_error:.1e}",
            "" if point.published_error is None else f"{point.published_error:.1e}",
        )
        last = point.family
    return table


def _deformed_table(found: "Accuracy") -> Table:
    table = Table("signal errors", *(row.name for row in found.deformed), box=box.SIMPLE)
    for column in table.columns[1:]:
        column.justify = "right"
    for scene in found.deformed[0].signal_errors:
        table.add_row(scene, *(f"{row.signal_errors[scene]:.1e}" for row in found.deformed))
    table.add_section()
    table.add_row("ms/frame", *(f"{1e3 * row.frame_seconds:.1f}" for row in found.deformed))
    return table


def _sentences(found: "Accuracy") -> Iterable[str]:
    yield (
        f"two references differ by {found.resistance_error:.1e} in R and "
        f"{found.signal_error:.1e} in the signal"
    )
    for duel in found.duels:
        yield (
            f"{duel.other.family}, {duel.other.nodes} nodes: pyEIT "
            f"{1e3 * duel.other.frame_seconds:.0f} ms per frame with the seven drives it needs, "
            f"ours on the same nodes {1e3 * duel.own.frame_seconds:.1f} ms, "
            f"{duel.ratio:.0f} times faster; new geometry {duel.other.setup_seconds:.1f} s against "
            f"{duel.own.setup_seconds:.2f} s"
        )
    if not found.duels:
        yield "pyEIT is not installed and was left out: pip install 'eitskin[bench]'"


_COLOURS = {"ok": "green", "refused": "yellow", "left out": "dim", "wrong": "bold red"}


def _stability_table(found: "Stability") -> Table:
    from eitskin.benchmarks.stability.run import tallied

    table = Table(box=box.SIMPLE, pad_edge=False, padding=(0, 1, 0, 0))
    table.add_column("case", no_wrap=True, max_width=33)
    table.add_column("outcome", no_wrap=True, min_width=8)
    for name, width in (("resid.", 5), ("inv.", 5), ("error", 5), ("it.", 4), ("s", 4)):
        table.add_column(name, justify="right", no_wrap=True, min_width=width)
    family = None
    for row in tallied(found.rows):
        if row.family != family:
            table.add_row(f"[bold]{row.family}[/bold]")
        family = row.family
        numbers = (row.residual, row.invariant, row.error)
        table.add_row(
            f" {escape(row.case)}",
            f"[{_COLOURS[row.outcome]}]{row.outcome}[/]",
            *("" if number is None else f"{number:.0e}" for number in numbers),
            "" if row.iterations is None else str(row.iterations),
            f"{row.seconds:.1f}",
        )
    return table


def _remarks(found: "Stability", everything: bool) -> Iterable[str]:
    """How far cases went and what is wrong; with everything, also why others were refused."""
    for row in found.rows:
        naive = "" if row.naive is None else f"the plain method is off by {row.naive:.2g}"
        said = row.reason if everything or row.reached or row.outcome == "wrong" else ""
        remark = "; ".join(filter(None, (row.reached, naive, said)))
        if remark:
            colour = _COLOURS[row.outcome]
            yield f"[{colour}]{row.outcome}[/] {row.family}, {row.case}: {escape(remark)}"
    counts = Counter(row.outcome for row in found.rows)
    counted = ", ".join(f"{count} {outcome}" for outcome, count in counts.most_common())
    yield f"{counted}; {found.seconds:.0f} s"
    yield str(found.provenance)
