"""`eitskin tare` stores the zero of a sensor; other commands use the stored reference."""

from itertools import islice
from pathlib import Path
from typing import Annotated

import typer

from eitskin import datasets, hardware, simulator, training
from eitskin.cli import options
from eitskin.errors import ConfigurationError, DataError

FRAMES = 32  # that are averaged


@options.with_output
def command(
    model: options.Model,
    *,
    out: Annotated[Path, typer.Option(help="File of the reference, NAME.json.")],
    board: options.BoardOption = None,
    dataset: Annotated[
        Path | None,
        typer.Option(
            "--dataset",
            help="Take the reference of a specimen of this dataset, instead of a board.",
        ),
    ] = None,
    specimen: options.Specimen = 0,
    frames: Annotated[int, typer.Option(min=1, help="Number of frames to average.")] = FRAMES,
    mounted: Annotated[
        bool,
        typer.Option(
            "--mounted",
            help="Take the present shape of a sensor on a curved body as the reference.",
        ),
    ] = False,
    method: options.MethodCode = None,
    seed: int = 0,
    output: options.Output,
) -> None:
    """Store the still, untouched sensor as the reference of later sessions.

    Lay the sensor flat, or, with --mounted, leave it as it is mounted. For the first frames of a
    recording use --board replay:DIRECTORY. Give the file to live, check or calibrate by
    --reference.
    """
    if (board is None) == (dataset is None):
        raise ConfigurationError("give either --board or --dataset, the sensor of the reference")
    options.require_parent(out)
    pipeline = training.open_pipeline(model, options.own_method(method))
    zero = training.Zero.MOUNTED if mounted else training.Zero.FLAT
    if zero is training.Zero.FLAT:
        tell_unjudged(pipeline, output)
    if dataset is not None:
        reference = pipeline.tare([reference_frame(dataset, specimen)], zero, "", str(dataset))
    else:
        with options.opened_board(str(board), seed, pipeline.layout) as opened:
            output.note(f"measuring {frames} frames; keep the sensor {zero}, still and untouched")
            reference = measure_reference(pipeline, opened, frames, zero)
    reference.write(out)
    facts = {"frames": reference.frames, "noise": reference.noise, "taken": reference.taken}
    result = {"out": str(out), "zero": str(zero), **facts, "board": reference.board}
    output.result(result, f"{out}: the sensor {zero}, mean of {reference.frames} frames")
    output.note(f"use it by --reference {out}, with this sensor on this board only")


def measure_reference(
    pipeline: "training.Pipeline", board: "hardware.Board", frames: int, zero: "training.Zero"
) -> "training.StoredReference":
    """Stored reference from frames of a board, which the pipeline uses from now on."""
    pipeline.layout.require_same_measurements(board.protocol, board.info.frequency)
    taken_frames = list(islice(board.frames(), frames))
    return pipeline.tare(taken_frames, zero, board_number(board.info), board.uri)


def reference_frame(folder: Path, specimen: int) -> "simulator.Frame":
    """Frame of the flat, untouched specimen of a dataset.

    Raises DataError where the dataset has no such specimen, or no protocol.
    """
    import numpy as np

    data = datasets.open_dataset(folder)
    rows = np.flatnonzero(data.specimen_number == specimen)
    if not len(rows) or data.protocol is None:
        raise DataError(
            f"expected specimen {specimen} and a protocol in {folder}, found specimens "
            f"{data.specimen_number[:8].tolist()}, protocol {data.protocol}; choose another "
            "--specimen, or import the recording with --protocol"
        )
    reference = data.reference[rows[0]].astype(np.complex128)
    return simulator.Frame(reference, data.protocol, frequency=data.frequency)


ReferenceFile = Annotated[
    Path | None,
    typer.Option(
        "--reference",
        help="Stored reference of this sensor, from eitskin tare: the session need not begin flat.",
    ),
]


def board_number(info: "hardware.Info") -> str:
    """Unique number of a board in hexadecimal digits; empty where it has none."""
    return info.uid.hex() if any(info.uid) else ""


def use_reference(
    pipeline: "training.Pipeline", path: Path, info: "hardware.Info | None", output: options.Output
) -> None:
    """Use the reference in a file; note its zero, and another board than this one.

    Raises the errors of `StoredReference.read` and of the pipeline's `use`.
    """
    reference = training.StoredReference.read(path)
    pipeline.use(reference)
    output.note(f"zero: the sensor {reference.zero}, as stored in {path} at {reference.taken}")
    number = "" if info is None else board_number(info)
    if number and reference.board and number != reference.board:
        output.note(
            f"the reference was taken with board {reference.board}, this is board {number}, whose "
            "channels differ by some tenths of a percent: take it again with this board"
        )


def tell_unjudged(pipeline: "training.Pipeline", output: options.Output) -> None:
    """Note where a pipeline cannot test whether a session begins flat and untouched."""
    from eitskin.training.pipeline.flat_sensors import MIN_SPECIMENS

    if pipeline.stored_reference is None and pipeline.flat_sensors is None:
        count = f"one of {pipeline.trained_on.get('specimens', 'an unknown number')}"
        reason = "one of touch positions only" if pipeline.targets.positions_only else count
        output.note(
            "whether the sensor starts flat and untouched is not checked: expected a pipeline "
            f"trained on {MIN_SPECIMENS} specimens or more, got {reason}; make sure that it lies "
            "flat and untouched, or give a reference that was taken so (eitskin tare, --reference)"
        )
