"""`eitskin virtual-board`: a virtual board on a pseudo-terminal, for other programs."""

import time
from contextlib import closing
from pathlib import Path
from typing import Annotated, Literal

import typer

from eitskin import hardware
from eitskin.cli import options
from eitskin.cli.terminal import make_table

Faults = Annotated[
    str,
    typer.Option(help="Faults to inject, name@frame:index,...; --list-faults lists their names."),
]


@options.with_output
def command(
    *,
    scene: Annotated[
        Path | None, typer.Option(help="Scene or script (TOML); flat and untouched when omitted.")
    ] = None,
    sensor: options.SensorFile = None,
    protocol: options.Pairs = "pairwise",
    fixture: options.FixtureFile = None,
    mechanics: options.MechanicsFile = None,
    resolution: options.Detail = "fast",
    speed: Annotated[
        Literal["real", "max"],
        typer.Option(help="Pace of the AD5940, or a frame whenever one is read."),
    ] = "real",
    instrument: Annotated[
        str | None,
        typer.Option(help="Board: ideal, ad5940, or an instrument file; white noise when omitted."),
    ] = None,
    period: Annotated[
        float | None,
        typer.Option(min=1e-4, help="Time from frame to frame, s; the AD5940's when omitted."),
    ] = None,
    faults: Faults = "",
    link: Annotated[
        Path | None,
        typer.Option(help="A path that leads to the board, also after it was replugged."),
    ] = None,
    list_faults: Annotated[
        bool, typer.Option("--list-faults", help="List all faults and exit.")
    ] = False,
    seed: int = 0,
    output: options.Output,
) -> None:
    """Serve a virtual board on a pseudo-terminal until Ctrl-C; hosts can come and go."""
    if list_faults:
        from eitskin.hardware.virtual.fault_table import FAULTS

        meanings = {name: kind.meaning for name, kind in FAULTS.items()}
        output.result(meanings, make_table(("fault", "what it does"), meanings.items()))
        return
    output.detail(f"meshing at resolution {resolution}, computing the scenes")
    terminal = hardware.virtual_terminal(
        speed=speed,
        resolution=resolution,
        scene=scene,
        sensor=sensor,
        protocol=protocol,
        fixture=fixture,
        mechanics=mechanics,
        seed=seed,
        instrument=instrument,
        period=period,
        faults=faults,
        link=link,
    )
    uri = f"serial:{link or terminal.path}"
    output.result({"uri": uri}, uri)
    output.note(f"serving until Ctrl-C; open it with eitskin live MODEL --board {uri}", whole=True)
    # Started again it must not pass for the same board: hosts keep references for each boot.
    terminal.firmware.set_boot_count(int(time.time()))
    with options.ended_by_signals(), closing(terminal):
        terminal.serve()
