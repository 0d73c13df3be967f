"""`eitskin simulate SCENE.toml`: the impedances of one scene, and its picture."""

import time
from pathlib import Path
from typing import Annotated, cast, get_args

import numpy as np
import typer
from numpy.typing import NDArray
from rich.table import Table

from eitskin.cli.options import Json, Output, Quiet, Seed, Verbose
from eitskin.geometry import ConfigurationError, SensorDesign
from eitskin.simulator import Frame, Scene, Simulator, WhiteNoise
from eitskin.simulator.forward import Resolution


def command(
    scene: Annotated[
        Path, typer.Argument(help="Scene file: [bend] angle_deg, [[touches]] x y force.")
    ],
    sensor: Annotated[
        Path | None, typer.Option(help="Sensor design file; the reference sensor when omitted.")
    ] = None,
    resolution: Annotated[str, typer.Option(help="fast, standard or fine.")] = "standard",
    noise: Annotated[
        float | None, typer.Option(help="Add white noise this many dB below full scale.")
    ] = None,
    view: Annotated[Path | None, typer.Option(help="Draw the scene into this PNG file.")] = None,
    seed: Seed = 0,
    json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Simulate one scene: 28 impedances and their change from the flat, untouched sensor."""
    output = Output(json, quiet, verbose)
    if resolution not in get_args(Resolution):
        raise ConfigurationError(
            f"--resolution must be one of {', '.join(get_args(Resolution))}, got '{resolution}'"
        )
    what = Scene.from_toml(scene)
    design = SensorDesign.from_toml(sensor) if sensor else SensorDesign.reference()
    sim = Simulator(design, cast(Resolution, resolution))
    flat = sim.measure(Scene())
    start = time.perf_counter()
    instrument = None if noise is None else WhiteNoise(noise)
    frame = sim.measure(what, instrument, np.random.default_rng(seed))
    seconds = time.perf_counter() - start
    output.detail(f"{sim.model.solver.name}, {len(sim.model.mesh.cells)} cells, {seconds:.3f} s")
    change = (frame.impedance / flat.impedance - 1.0).real
    output.result(_as_data(frame, change, seconds), _as_table(frame, change))
    if view is not None:
        from eitskin.simulator.view import draw

        draw(sim, [(scene.stem, what)], view)
        output.note(f"picture: {view}")


def _as_data(frame: Frame, change: NDArray[np.float64], seconds: float) -> dict[str, object]:
    return {
        "measurements": list(frame.protocol.labels),
        "impedance_real_ohm": frame.impedance.real.tolist(),
        "impedance_imag_ohm": frame.impedance.imag.tolist(),
        "relative_change": change.tolist(),
        "seconds": seconds,
    }


def _as_table(frame: Frame, change: NDArray[np.float64]) -> Table:
    table = Table("pair", "R, ohm", "X, ohm", "change, %")
    for column in table.columns[1:]:
        column.justify = "right"
    for label, Z, part in zip(frame.protocol.labels, frame.impedance, change, strict=True):
        table.add_row(label, f"{Z.real:.3f}", f"{Z.imag:.3f}", f"{100 * part:+.3f}")
    return table
