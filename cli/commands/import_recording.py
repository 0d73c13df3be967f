"""`eitskin import`: measured voltages with labels, as a dataset."""

from pathlib import Path
from typing import Annotated

import typer

from eitskin.cli.options import Json, MeasuredPairs, Output, Quiet, Seed, Verbose


def command(
    file: Annotated[Path, typer.Argument(help="Recording: .csv, .mat, .npz or OpenEIT .txt.")],
    *,
    out: Annotated[Path, typer.Option(help="Folder for the dataset; new or empty.")],
    values: Annotated[
        str | None, typer.Option(help="Variable (CSV: beginning of columns) with the values.")
    ] = None,
    touch_reference: Annotated[
        str | None, typer.Option(help="The same for frames just before a touch.")
    ] = None,
    positions: Annotated[
        str | None, typer.Option(help="Variable with x, y of each touch, in metres.")
    ] = None,
    protocol: MeasuredPairs = None,
    frequency: Annotated[float, typer.Option(help="Frequency of the excitation, in hertz.")] = 40e3,
    seed: Seed = 0,
    as_json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Import measured voltages and labels, as a dataset for training and evaluation."""
    from eitskin.datasets.recordings.recording import RecordingNames, read_recording
    from eitskin.datasets.store.folder import save_dataset
    from eitskin.datasets.store.summary import DatasetSummary
    from eitskin.protocol import Protocol

    output = Output(as_json, quiet, verbose)
    data = read_recording(
        file,
        RecordingNames(values, touch_reference, positions),
        Protocol.named(protocol) if protocol else None,
        frequency,
    )
    output.detail(f"nothing is random in an import, seed {seed} is not used")
    save_dataset(data, out)
    summary = DatasetSummary()
    summary.add(data)
    counts = summary.states
    shown = ", ".join(f"{count} {name}" for name, count in counts.items() if count)
    output.result(
        {
            "out": str(out),
            "frames": len(data),
            "channels": data.impedance.shape[1],
            "states": counts,
            "protocol": protocol,
        },
        f"{len(data)} frames of {data.impedance.shape[1]} channels ({shown}) in {out}",
    )
