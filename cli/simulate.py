"""`eitskin simulate SCENE.toml`: the impedances of one scene, and its picture."""

import time
from pathlib import Path
from typing import Annotated, cast, get_args

import numpy as np
import typer
from rich.table import Table

from eitskin.cli.options import Json, Output, Quiet, Seed, Verbose
from eitskin.geometry import ConfigurationError, SensorDesign
from eitskin.simulator import Frame, Protocol, Scene, Simulator, WhiteNoise
from eitskin.simulator.resolution import Resolution


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
    protocol: Annotated[
        str, typer.Option(help="pairwise, adjacent, opposite, skip:N, or a CSV file.")
    ] = "pairwise",
    view: Annotated[Path | None, typer.Option(help="Draw the scene into this PNG file.")] = None,
    seed: Seed = 0,
    json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Simulate one scene: its impedances and their change from the flat, untouched sensor."""
    output = Output(json, quiet, verbose)
    if resolution not in get_args(Resolution):
        raise ConfigurationError(
            f"--resolution must be one of {', '.join(get_args(Resolution))}, got '{resolution}'"
        )
    what = Scene.from_toml(scene)
    design = SensorDesign.from_toml(sensor) if sensor else SensorDesign.reference()
    sim = Simulator(
        design,
        cast(Resolution, resolution),
        protocol=Protocol.named(protocol, len(design.electrodes)),
    )
    flat = sim.measure(Scene())
    start = time.perf_counter()
    instrument = None if noise is None else WhiteNoise(noise)
    frame = sim.measure(what, instrument, np.random.default_rng(seed))
    seconds = time.perf_counter() - start
    output.detail(f"{sim.model.solver.name}, {len(sim.model.mesh.cells)} cells, {seconds:.3f} s")
    output.result(_as_data(frame, flat, seconds), _as_table(frame, flat))
    if view is not None:
        from eitskin.simulator.view import draw

        draw(sim, [(scene.stem, what)], view)
        output.note(f"picture: {view}")


def _relative_change(frame: Frame, flat: Frame) -> list[float | None]:
    """Change from the flat frame, of the real part; None where that is zero but for rounding."""
    before = flat.impedance.real
    rounding = 1e-9 * np.abs(before).max()
    return [
        float(now / then - 1.0) if abs(then) > rounding else None
        for now, then in zip(frame.impedance.real, before, strict=True)
    ]


def _as_data(frame: Frame, flat: Frame, seconds: float) -> dict[str, object]:
    return {
        "measurements": list(frame.protocol.labels),
        "independent": frame.protocol.rank,
        "impedance_real_ohm": frame.impedance.real.tolist(),
        "impedance_imag_ohm": frame.impedance.imag.tolist(),
        "change_ohm": (frame.impedance - flat.impedance).real.tolist(),
        "relative_change": _relative_change(frame, flat),
        "seconds": seconds,
    }


def _as_table(frame: Frame, flat: Frame) -> Table:
    table = Table("measurement", "R, ohm", "X, ohm", "change, ohm", "change, %")
    for column in table.columns[1:]:
        column.justify = "right"
    for label, Z, before, part in zip(
        frame.protocol.labels,
        frame.impedance,
        flat.impedance,
        _relative_change(frame, flat),
        strict=True,
    ):
        percent = "" if part is None else f"{100 * part:+.3f}"
        change = f"{(Z - before).real:+.3f}"
        table.add_row(label, f"{Z.real:.3f}", f"{Z.imag:.3f}", change, percent)
    return table
