"""`eitskin board`: a virtual board on a pseudo-terminal, for any program that speaks to boards."""

from pathlib import Path
from typing import Annotated

import typer

from eitskin.cli.options import Json, Output, Quiet, Seed, Verbose

SceneFile = Annotated[
    Path | None, typer.Option(help="Scene or script (TOML); flat and untouched when omitted.")
]
BoardResolution = Annotated[str, typer.Option(help="Of the simulator: fast, standard or fine.")]
Speed = Annotated[str, typer.Option(help="real: as the AD5940; max: as fast as it is read.")]


def command(
    *,
    scene: SceneFile = None,
    resolution: BoardResolution = "fast",
    speed: Speed = "real",
    seed: Seed = 0,
    as_json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Serve a virtual board on a pseudo-terminal until Ctrl-C; hosts can come and go."""
    from eitskin.hardware import virtual_terminal

    output = Output(as_json, quiet, verbose)
    output.detail(f"meshing at resolution {resolution}, computing the scenes")
    terminal = virtual_terminal(speed=speed, resolution=resolution, scene=scene, seed=seed)
    uri = f"serial:{terminal.path}"
    output.result({"uri": uri}, uri)
    output.note("serving until Ctrl-C; open it with eitskin live MODEL --board " + uri)
    try:
        terminal.serve()
    finally:
        terminal.close()
