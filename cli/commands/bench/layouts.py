"""`eitskin bench layouts`: comparison of electrode layouts."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich import box
from rich.markup import escape
from rich.table import Table

from eitskin.cli.options import Json, Output, Quiet, Verbose
from eitskin.extras import require_all

if TYPE_CHECKING:
    from eitskin.benchmarks.layouts.run import LayoutComparison


def command(
    out: Annotated[Path, typer.Option(help="Folder for tables, maps and finished layouts.")] = Path(
        "build/bench/layouts"
    ),
    *,
    sweep: Annotated[
        list[str] | None,
        typer.Option(
            help="count, placement, width, contact, bend, search or free; may be given several "
            "times, all if omitted."
        ),
    ] = None,
    workers: Annotated[int, typer.Option(min=1, help="Number of worker processes.")] = 2,
    quick: Annotated[bool, typer.Option("--quick", help="Few positions, short searches.")] = False,
    as_json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Cramer-Rao bounds of touches for electrode layouts: sweeps, and a search for the best eight.

    Finished layouts are kept in the folder; a run that was stopped goes on from them.
    """
    from eitskin.benchmarks.layouts.report import LEGEND, as_data, sentences, write
    from eitskin.benchmarks.layouts.run import NAMES, run
    from eitskin.datasets.store.folder import make_folder

    output = Output(as_json, quiet, verbose)
    require_all(bench="matplotlib")
    make_folder(out)
    with output.progress() as bar:
        task = bar.add_task("layouts", total=None, rate="")

        def show(name: str) -> None:
            bar.update(task, advance=1, rate=name)

        found = run(out / "parts", names=sweep or NAMES, quick=quick, workers=workers, watch=show)
    paths, data, lines = write(found, out), as_data(found), [*sentences(found)]
    output.result(data | {"files": [str(path) for path in paths]}, _as_table(found))
    output.show(LEGEND)
    for line in lines:
        output.show(line)
    output.note("written: " + ", ".join(str(path) for path in paths))


def _as_table(found: "LayoutComparison") -> Table:
    from eitskin.benchmarks.layouts.report import HEADINGS, SHORT, table

    drawn = Table(*map(escape, HEADINGS[:SHORT]), box=box.SIMPLE, pad_edge=False, padding=0)
    drawn.columns[0].width = 23
    for column in drawn.columns[1:]:
        column.justify, column.width = "right", 5
    for row in table(found):
        drawn.add_row(f"[bold]{row[0]}[/bold]" if len(row) == 1 else row[0], *row[1:SHORT])
    return drawn
