"""Command line `eitskin`: its commands, and the exit codes of its errors."""

import sys
from typing import Annotated, Any

import typer

from eitskin import __version__
from eitskin.cli.commands import (
    bench,
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
from eitskin.cli.help import Command, Commands, with_new_spelling
from eitskin.cli.options import ended_by_signals
from eitskin.errors import EitskinError
from eitskin.files import printable

EXIT_USAGE = 2
PANELS: dict[str, dict[str, Any]] = {
    "Start here": {"demo": demo.command, "live": live.command, "simulate": simulate.command},
    "Data": {
        "generate": generate.command,
        "import": import_recording.command,
        "dataset": dataset.app,
        "export": export.app,
    },
    "Learn": {
        "train": train.command,
        "evaluate": train.evaluate,
        "adapt": adapt.command,
        "calibrate": adapt.calibrate,
    },
    "Hardware": {
        "ports": check.ports,
        "check": check.command,
        "tare": tare.command,
        "setup": setup.command,
        "virtual-board": simulate.virtual_board,
    },
    "Images": {"reconstruct": reconstruct.command, "mesh": simulate.mesh},
    "Expert": {"bench": bench.app, "fit": fits.app},
}
"""Commands by the panel that help lists them in."""


class Program(Commands):
    """All commands; Ctrl-C and SIGTERM end them with a message, and old spellings still work."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Words of the command line, in today's spelling."""
        return super().parse_args(ctx, with_new_spelling(args))

    def invoke(self, ctx: Any) -> Any:
        """Run a command; Typer makes exit code 130 of a KeyboardInterrupt."""
        try:
            with ended_by_signals():
                return super().invoke(ctx)
        except KeyboardInterrupt:
            typer.secho("eitskin: interrupted", err=True)
            raise


app = typer.Typer(
    name="eitskin",
    cls=Program,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
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
            "--version",
            "-V",
            callback=_print_version,
            is_eager=True,
            help="Print the version and exit.",
        ),
    ] = False,
) -> None:
    """Soft robot skin that senses touch and bending: simulate it, train on it, run it live."""


for _panel, _commands in PANELS.items():
    for _name, _command in _commands.items():
        if isinstance(_command, typer.Typer):
            app.add_typer(_command, name=_name, cls=Commands, rich_help_panel=_panel)
        else:
            app.command(_name, cls=Command, rich_help_panel=_panel)(_command)


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
