"""The `eitskin` command: assembles the commands and turns errors into exit codes."""

import sys
from typing import Any

import typer
from typer.core import TyperGroup

from eitskin.cli.commands import (
    bench,
    board,
    calibrate,
    check,
    dataset,
    evaluate,
    export,
    generate,
    import_recording,
    live,
    mesh,
    simulate,
    train,
)
from eitskin.cli.demo import command as demo
from eitskin.errors import EitskinError

EXIT_USAGE = 2


class Commands(TyperGroup):
    """All commands: one that Ctrl-C ends says so, before typer turns it into exit code 130."""

    def invoke(self, ctx: Any) -> Any:
        """Run the command that was given."""
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt:
            typer.secho("eitskin: interrupted", err=True)
            raise


app = typer.Typer(
    name="eitskin",
    cls=Commands,
    help="Simulate electrical-impedance robot skin, make training sets, train on them, go live.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
app.command("simulate")(simulate.command)
app.command("mesh")(mesh.command)
app.command("generate")(generate.command)
app.command("import")(import_recording.command)
app.command("train")(train.command)
app.command("evaluate")(evaluate.command)
app.command("calibrate")(calibrate.command)
app.command("check")(check.command)
app.command("board")(board.command)
app.command("live")(live.command)
app.command("demo")(demo.command)
app.add_typer(dataset.app, name="dataset")
app.add_typer(bench.app, name="bench")
app.add_typer(export.app, name="export")


def run() -> None:
    """Entry point: exit codes 0 ok, 2 usage, 3 data, 4 device, 5 partial, 130 interrupted."""
    try:
        app(standalone_mode=True)
    except EitskinError as error:
        typer.secho(f"eitskin: {error}", fg=typer.colors.RED, err=True)
        sys.exit(error.exit_code)
    except ImportError as error:
        typer.secho(f"eitskin: {error}", fg=typer.colors.RED, err=True)
        sys.exit(EXIT_USAGE)
