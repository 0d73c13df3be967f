"""`eitskin bench accuracy`: error of the forward model against its run time."""

import dataclasses
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich import box
from rich.table import Table

from eitskin.cli.options import Json, Output, Quiet, Seed, Verbose, watched
from eitskin.extras import require_all

if TYPE_CHECKING:
    from eitskin.benchmarks.accuracy.run import Accuracy

Out = Annotated[Path, typer.Option(help="Folder of all results; each benchmark has one in it.")]
Quick = Annotated[bool, typer.Option("--quick", help="Fewer and smaller cases, in half a minute.")]


def command(
    out: Out = Path("build/bench"),
    *,
    quick: Quick = False,
    seed: Seed = 0,
    json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Measure error and run time of the forward model, beside pyEIT: table, CSV and plot."""
    from eitskin.benchmarks.accuracy.report import misses, write
    from eitskin.benchmarks.accuracy.run import run
    from eitskin.datasets.store.folder import make_folder

    output = Output(json, quiet, verbose)
    require_all(bench="matplotlib")
    make_folder(out)
    found = run(seed, quick, watched(output))
    paths = write(found, out)
    output.result(_as_data(found, paths), _as_table(found))
    output.show(_deformed_table(found))
    for line in (*_sentences(found), *misses(found)):
        output.show(line)
    output.note("written: " + ", ".join(str(path) for path in paths))


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
