"""`eitskin tare`: a stored reference of one sensor, the zero of its estimates."""

from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from eitskin.cli.commands.stored_references import board_number, tell_unjudged
from eitskin.cli.options import (
    BoardOption,
    Json,
    MethodCode,
    Model,
    Output,
    Quiet,
    Seed,
    Specimen,
    Verbose,
    own_method,
    seeded,
)
from eitskin.errors import ConfigurationError

if TYPE_CHECKING:
    from eitskin.frame import Frame
    from eitskin.hardware.boards.board import Board
    from eitskin.training.adaptation.recorded_touches import RecordedTouches
    from eitskin.training.pipeline.pipeline import Pipeline
    from eitskin.training.pipeline.stored_reference import StoredReference, Zero

DatasetOption = Annotated[
    Path | None, typer.Option("--dataset", help="Instead of a board: the reference of a specimen.")
]
FrameCount = Annotated[int, typer.Option(min=1, help="Number of frames that are averaged.")]
Mounted = Annotated[
    bool,
    typer.Option(
        "--mounted",
        help="The sensor is curved by what it is mounted on: its shape now is the zero.",
    ),
]

FRAMES = 32  # that are averaged


def command(
    model: Model,
    *,
    out: Annotated[Path, typer.Option(help="File of the reference, NAME.json.")],
    board: BoardOption = None,
    dataset: DatasetOption = None,
    specimen: Specimen = 0,
    frames: FrameCount = FRAMES,
    mounted: Mounted = False,
    method: MethodCode = None,
    seed: Seed = 0,
    as_json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Store the still, untouched sensor as the zero of later sessions (live, check, calibrate).

    The sensor must lie flat, or, with --mounted, be as it is mounted. A recording is a board, too:
    replay:DIRECTORY gives its first frames.
    """
    from eitskin.training.adaptation.opening import open_pipeline
    from eitskin.training.pipeline.stored_reference import Zero

    output = Output(as_json, quiet, verbose)
    if (board is None) == (dataset is None):
        raise ConfigurationError("give either --board or --dataset, the sensor of the reference")
    if not out.absolute().parent.is_dir():
        raise ConfigurationError(
            f"cannot write {out}: there is no folder {out.parent}; make it, or name another"
        )
    pipeline = open_pipeline(model, own_method(method))
    zero = Zero.MOUNTED if mounted else Zero.FLAT
    if zero is Zero.FLAT:
        tell_unjudged(pipeline, output)
    if dataset is not None:
        reference = pipeline.tare([reference_frame(dataset, specimen)], zero, "", str(dataset))
    else:
        from eitskin.hardware.opening import open_board

        with open_board(str(board), **seeded(str(board), seed)) as opened:
            output.note(f"measuring {frames} frames; keep the sensor {zero}, still and untouched")
            reference = taken_from_board(pipeline, opened, frames, zero)
    reference.write(out)
    facts = {"frames": reference.frames, "noise": reference.noise, "taken": reference.taken}
    result = {"out": str(out), "zero": str(zero), **facts, "board": reference.board}
    output.result(result, f"{out}: the sensor {zero}, mean of {reference.frames} frames")
    output.note(f"use it by --reference {out}, with this sensor on this board only")


def taken_from_board(
    pipeline: "Pipeline | RecordedTouches", board: "Board", frames: int, zero: "Zero"
) -> "StoredReference":
    """Stored reference from frames of a board, which the pipeline uses from now on."""
    require_same_measurements(pipeline, board)
    taken = list(islice(board.frames(), frames))
    return pipeline.tare(taken, zero, board_number(board.info), board.uri)


def require_same_measurements(pipeline: "Pipeline | RecordedTouches", board: "Board") -> None:
    """Raise DataError where a board measures otherwise than a pipeline was trained."""
    from eitskin.training.pipeline.pipeline import Pipeline

    spec = pipeline.layout if isinstance(pipeline, Pipeline) else pipeline
    spec.require_same_measurements(board.protocol, board.info.frequency)


def reference_frame(folder: Path, specimen: int) -> "Frame":
    """Frame of the flat, untouched specimen of a dataset.

    Raises DataError where the dataset has no such specimen, or no protocol.
    """
    import numpy as np

    from eitskin.datasets.store.folder import open_dataset
    from eitskin.errors import DataError
    from eitskin.frame import Frame

    data = open_dataset(folder)
    rows = np.flatnonzero(data.specimen_number == specimen)
    if not len(rows) or data.protocol is None:
        raise DataError(
            f"expected specimen {specimen} and a protocol in {folder}, found specimens "
            f"{data.specimen_number[:8].tolist()}, protocol {data.protocol}; choose another "
            "--specimen, or import the recording with --protocol"
        )
    reference = data.reference[rows[0]].astype(np.complex128)
    return Frame(reference, data.protocol, frequency=data.frequency)
