"""Option `--reference` of commands, and the use of stored references."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from eitskin.cli.options import Output
    from eitskin.hardware.protocol.messages import Info
    from eitskin.training.adaptation.recorded_touches import RecordedTouches
    from eitskin.training.pipeline.pipeline import Pipeline

ReferenceFile = Annotated[
    Path | None,
    typer.Option(
        "--reference",
        help="Stored reference of this sensor, from eitskin tare: the session need not begin flat.",
    ),
]


def board_number(info: "Info") -> str:
    """Unique number of a board in hexadecimal digits; empty where it has none."""
    return info.uid.hex() if any(info.uid) else ""


def use_reference(
    pipeline: "Pipeline | RecordedTouches", path: Path, info: "Info | None", output: "Output"
) -> None:
    """Use the reference in a file; note its zero, and another board than this one.

    Raises the errors of `StoredReference.read` and of the pipeline's `use`.
    """
    from eitskin.training.pipeline.stored_reference import StoredReference

    reference = StoredReference.read(path)
    pipeline.use(reference)
    output.note(f"zero: the sensor {reference.zero}, as stored in {path} at {reference.taken}")
    number = "" if info is None else board_number(info)
    if number and reference.board and number != reference.board:
        output.note(
            f"the reference was taken with board {reference.board}, this is board {number}, whose "
            "channels differ by some tenths of a percent: take it again with this board"
        )


def tell_unjudged(pipeline: "Pipeline | RecordedTouches", output: "Output") -> None:
    """Note where a pipeline cannot judge whether a session begins flat and untouched."""
    from eitskin.training.pipeline.flat_sensors import FEWEST_SPECIMENS

    if pipeline.stored is None and getattr(pipeline, "flat_sensors", None) is None:
        count = f"one of {pipeline.trained_on.get('specimens', 'an unknown number')}"
        known = "one of touch positions only" if pipeline.targets.positions_only else count
        output.note(
            "whether the sensor starts flat and untouched is not checked: expected a pipeline "
            f"trained on {FEWEST_SPECIMENS} specimens or more, got {known}; make sure that it lies "
            "flat and untouched, or give a reference that was taken so (eitskin tare, --reference)"
        )
