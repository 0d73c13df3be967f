"""`eitskin export`: datasets, recordings and scenes in file formats of other programs."""

import math
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated

import typer
from rich import box
from rich.filesize import decimal

from eitskin import hardware, simulator, training
from eitskin.cli import options
from eitskin.cli.commands.simulate import announce_unsolved
from eitskin.cli.help import Command
from eitskin.errors import ConfigurationError

app = typer.Typer(
    help="Write datasets, recordings and scenes in formats of other programs.",
    no_args_is_help=True,
)
License = Annotated[
    str, typer.Option("--license", help="Licence of the frames, such as cc-by-4.0.")
]


def _exporting(form: str) -> Callable[..., None]:
    """Command that writes a dataset in a format."""

    def export(
        dataset: Annotated[Path, typer.Argument(help="Folder of the dataset.")],
        *,
        out: Annotated[Path, typer.Option(help="Folder to write to; new or empty.")],
        license_name: License = "unknown",
        output: options.Output,
    ) -> None:
        from eitskin.datasets.export.export import export_dataset

        with output.counting("shards") as show:
            done = export_dataset(dataset, out, form, license_name, show)
        result = {"out": str(out), "format": form, "frames": done.frames, "files": done.files}
        splits = ", ".join(f"{name} {count}" for name, count in done.frames.items())
        output.result(
            result | {"megabytes": round(done.size / 1e6, 3)},
            f"{sum(done.frames.values())} frames ({splits}) in {done.files} files in {out}, "
            f"{decimal(done.size)}",
        )

    export.__doc__ = f"Write a dataset for {_FORMATS[form]}, split by specimen."
    return export


_FORMATS = {
    "parquet": "pandas and PyTorch (Parquet)",
    "huggingface": "Hugging Face `datasets`",
    "lerobot": "LeRobot, from episodes",
}
for _form in _FORMATS:
    app.command(_form, cls=Command)(options.with_output(_exporting(_form)))


@app.command("mcap", cls=Command)
@options.with_output
def export_mcap(
    recording: options.FramesPath,
    *,
    out: Annotated[Path, typer.Option(help="The new file, NAME.mcap.")],
    model: Annotated[
        Path | None, typer.Option(help="Also write this pipeline's estimate of every frame.")
    ] = None,
    method: options.MethodCode = None,
    output: options.Output,
) -> None:
    """Write the frames of a recording, and a pipeline's estimates, as ROS 2 messages (MCAP).

    docs/reference/live.md has the topics and their units.
    """
    from eitskin.hardware.ros2.messages import McapWriter, require_new

    require_new(out)
    board, start = hardware.ReplayBoard(str(recording)), time.perf_counter()
    readings, frames, estimates = _readings(board, model, method), 0, 0
    writer = McapWriter(out)
    try:
        with output.counting("frames") as show:
            for reading in readings:
                writer.write(reading)
                frames, estimates = frames + 1, estimates + (reading.estimate is not None)
                show(frames, None)
    except BaseException:
        writer.discard()  # the recording is still there
        raise
    writer.close()
    seconds = time.perf_counter() - start
    data = {
        "file": str(out),
        "frames": frames,
        "estimates": estimates,
        "messages": writer.messages,
        "megabytes": round(out.stat().st_size / 1e6, 3),
        "seconds": seconds,
    }
    text = f"{frames} frames, {estimates} estimates, {data['megabytes']} MB in {seconds:.1f} s"
    output.result(data, f"{out}: {text}")


@app.command("onnx", hidden=True, context_settings={"ignore_unknown_options": True})
def export_onnx(_words: Annotated[list[str] | None, typer.Argument()] = None) -> None:
    """State what replaces ONNX graphs, which version 0.2 wrote."""
    raise ConfigurationError(
        "eitskin writes no ONNX graphs any more\nexpected a machine with numpy alone, which the "
        "networks of a pipeline now need: pip install 'eitskin[live]', then eitskin live, or "
        'Pipeline.load("NAME.eitmodel").process(frame)'
    )


@app.command("vtu", cls=Command)
@options.with_output
def export_vtu(
    scene: options.SceneFile,
    *,
    out: Annotated[Path, typer.Option("--out", help="Folder to write to; new or empty.")],
    sensor: options.SensorOptions,
    drive: Annotated[
        str | None,
        typer.Option(
            metavar="A-B", help="Only the current from A to B; all of the protocol when omitted."
        ),
    ] = None,
    cell: Annotated[
        float | None, typer.Option(help="Largest cell [m]; a sixtieth of the length when omitted.")
    ] = None,
    output: options.Output,
) -> None:
    """Write the deformed sensor of a scene, its fields and its electrodes, for ParaView."""
    from eitskin.datasets.store.folder import make_folder, require_empty
    from eitskin.simulator.view.vtu import field_resolution, scene_grids, write_grids

    what = simulator.Scene.from_toml(scene)
    require_empty(out)
    design = options.read_design(sensor.sensor)
    sim = sensor.simulator(field_resolution(design, cell), design)
    announce_unsolved(sim, what, output)
    start = time.perf_counter()
    pair = None if drive is None else [options.electrode_pair(drive, len(design.electrodes))]
    grids = scene_grids(sim, what, pair)
    make_folder(out)
    write_grids(grids, out)
    fields = {name: grid.array_names for name, grid in grids.items()}
    rows = [
        ("" if number else str(out / name), field)
        for name, names in fields.items()
        for number, field in enumerate(names)
    ]
    output.result(
        {
            "folder": str(out),
            "cells": len(sim.model.mesh.cells),
            "points": len(sim.model.mesh.points),
            "fields": fields,
            "seconds": time.perf_counter() - start,
        },
        options.make_table(("file", "field"), rows, box=box.SIMPLE),
    )


def _readings(
    board: "hardware.ReplayBoard", model: Path | None, method: str | None
) -> "Iterator[hardware.Reading]":
    """Readings of all recorded frames, with estimates where there is a model; latency unknown."""
    if model is None:
        return (hardware.Reading(frame, None, math.nan, math.nan) for frame in board.frames())

    pipeline = training.open_pipeline(model, options.own_method(method))
    return hardware.run_live(board, pipeline, newest=False, clock=lambda: math.nan)
