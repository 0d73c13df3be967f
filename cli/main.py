"""Command line `eitskin`: its commands, and the exit codes of its errors."""

import sys
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from eitskin import __version__
from eitskin.cli.commands import (
    bench,
    board,
    check,
    dataset,
    export,
    fits,
    generate,
    import_recording,
    reconstruct,
    simulate,
    tare,
    train,
)
from eitskin.cli.commands.live import command as live
from eitskin.cli.commands.own_sensor import adapt, setup
from eitskin.cli.demo import command as demo
from eitskin.cli.options import ended_by_signals
from eitskin.errors import EitskinError
from eitskin.files import printable

EXIT_USAGE = 2


class Commands(TyperGroup):
    """Command group with a message for Ctrl-C and SIGTERM, of which Typer makes exit code 130."""

    def invoke(self, ctx: Any) -> Any:
        try:
            with ended_by_signals():
                return super().invoke(ctx)
        except KeyboardInterrupt:
            typer.secho("eitskin: interrupted", err=True)
            raise


app = typer.Typer(
    name="eitskin",
    cls=Commands,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"eitskin {__version__}")
        raise typer.Exit


@app.callback()
def options(
    version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_print_version, is_eager=True, help="Print the version and exit."
        ),
    ] = False,
) -> None:
    """Simulate electrical-impedance robot skin, make training sets, train on them, go live."""


app.command("simulate")(simulate.command)
app.command("mesh")(simulate.mesh)
app.command("reconstruct")(reconstruct.command)
app.command("generate")(generate.command)
app.command("import")(import_recording.command)
app.command("train")(train.command)
app.command("evaluate")(train.evaluate)
app.command("adapt")(adapt.command)
app.command("tare")(tare.command)
app.command("setup")(setup.command)
app.command("calibrate")(adapt.calibrate)
app.command("check")(check.command)
app.command("board")(board.command)
app.command("live")(live.command)
app.command("demo")(demo.command)
app.add_typer(dataset.app, name="dataset")
app.add_typer(bench.app, name="bench")
app.add_typer(export.app, name="export")
app.add_typer(fits.instrument_app, name="instrument")
app.add_typer(fits.twin_app, name="twin")


def run() -> None:
    """Entry point: exit codes 0 ok, 2 usage, 3 data, 4 device, 5 partial, 130 interrupted.

    Other exceptions are for `entry`, which ends with 70.
    """
    try:
        app(standalone_mode=True)
    except EitskinError as error:
        typer.secho(f"eitskin: {printable(error)}", fg=typer.colors.RED, err=True)
        sys.exit(error.exit_code)
    except ImportError as error:
        typer.secho(f"eitskin: {error}", fg=typer.colors.RED, err=True)
        sys.exit(EXIT_USAGE)
