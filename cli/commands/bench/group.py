"""The command group `eitskin bench`."""

import typer

from eitskin.cli.commands.bench import (
    accuracy,
    layouts,
    paper,
    speed,
    stability,
    suite,
    transfer,
    world,
)

app = typer.Typer(help="Measure errors and run times.", no_args_is_help=True)
app.command("paper")(paper.command)
app.command("layouts")(layouts.command)
app.command("speed")(speed.command)
app.command("all")(suite.run_all)
app.command("accuracy")(accuracy.command)
app.command("stability")(stability.command)
app.command("world")(world.command)
app.command("transfer")(transfer.command)
