"""`eitskin check`: diagnosis of the sensor on a board, and a list of serial ports."""

import dataclasses
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.table import Table

from eitskin.cli.commands.live import BoardUri, seeded
from eitskin.cli.options import Json, Output, Quiet, Seed, Verbose

if TYPE_CHECKING:
    from eitskin.frame import Frame
    from eitskin.hardware.diagnosis.sensor_check import SensorCheck

ReferenceModel = Annotated[
    Path, typer.Argument(help="The trained pipeline, which has the expected impedances.")
]
FrameCount = Annotated[int, typer.Option(min=1, help="Number of frames to measure.")]
Calibrate = Annotated[
    bool, typer.Option("--calibrate", help="Have the board measure its resistor RCAL first.")
]
List = Annotated[bool, typer.Option("--list", help="Only list the serial ports of this machine.")]

EXIT_UNHEALTHY = 4


def command(
    model: ReferenceModel = Path("reference.eitmodel"),
    *,
    board: BoardUri = "virtual:",
    frames: FrameCount = 16,
    calibrate: Calibrate = False,
    list_ports: List = False,
    seed: Seed = 0,
    as_json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Diagnose the flat, untouched sensor on a board; exit code 4 where there are findings.

    Finds open, loose, shorted and swapped electrodes, bad contacts, faulty channels and boards.
    See docs/boards.md.
    """
    output = Output(as_json, quiet, verbose)
    if list_ports:
        _list(output)
        return
    from eitskin.hardware.diagnosis.sensor_check import check_sensor
    from eitskin.hardware.opening import open_board
    from eitskin.training.pipeline.pipeline import Pipeline

    layout = Pipeline.load(model).layout
    with open_board(board, **seeded(board, seed)) as opened:
        layout.require_same_measurements(opened.protocol, opened.info.frequency)
        if calibrate:
            opened.calibrate()
        output.note(f"measuring {frames} frames; keep the sensor flat and untouched")
        taken = list(islice(opened.frames(), frames))
    check = check_sensor(taken, layout.reference)
    output.result({"board": board, **_plain(check, taken)}, _shown(check, taken))
    if not check.healthy:
        raise typer.Exit(EXIT_UNHEALTHY)


def _plain(check: "SensorCheck", frames: "list[Frame]") -> dict[str, object]:
    """Findings as plain data, channels by their labels."""
    labels = frames[0].protocol.labels
    return {
        "healthy": check.healthy,
        "frames": len(frames),
        "findings": [
            {
                "what": str(each.what),
                "electrodes": list(each.electrodes),
                "channels": [labels[k] for k in each.channels],
                "message": each.message,
            }
            for each in check.findings
        ],
    }


def _shown(check: "SensorCheck", frames: "list[Frame]") -> str:
    if check.healthy:
        return f"healthy: nothing was found in {len(frames)} frames"
    return "\n".join(each.message for each in check.findings)


def _list(output: Output) -> None:
    from eitskin.hardware.boards.port import serial_ports

    ports = serial_ports()
    table = Table("port", "description", "manufacturer", "USB", "serial number")
    table.add_column("opens with", overflow="fold")
    for port in ports:
        usb = "" if port.vid is None else f"{port.vid:04x}:{port.pid or 0:04x}"
        told = (port.description, port.manufacturer, usb, port.serial_number, port.uri)
        table.add_row(port.device, *told)
    data = {"ports": [{**dataclasses.asdict(port), "uri": port.uri} for port in ports]}
    output.result(data, table if ports else "no serial port was found here")
