"""`eitskin bench stability`: outcome of stiff and extreme cases."""

import dataclasses
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

import typer
from rich import box
from rich.markup import escape
from rich.table import Table

from eitskin.cli.commands.bench.accuracy import Out, Quick
from eitskin.cli.options import Json, Output, Quiet, Seed, Verbose, watched

if TYPE_CHECKING:
    from eitskin.benchmarks.stability.run import Stability

_COLOURS = {"ok": "green", "refused": "yellow", "left out": "dim", "wrong": "bold red"}


def command(
    out: Out = Path("build/bench"),
    *,
    quick: Quick = False,
    seed: Seed = 0,
    json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Run stiff and extreme cases: outcome, residual, invariants and error of each.

    Exit code 1 where a case gives a wrong result.
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
    """Remarks on limits reached and wrong cases; with `everything`, also on refused cases."""
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
