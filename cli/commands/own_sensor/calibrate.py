"""`eitskin calibrate`: a pipeline adapted to one sensor, from a few known angles."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from eitskin.cli.commands.own_sensor.adapt import calibration_table
from eitskin.cli.commands.own_sensor.poses import (
    TerminalDialogue,
    asked,
    bent,
    frames_in_poses,
    left_alone,
    staged,
)
from eitskin.cli.commands.tare import ReferenceFile, use_reference
from eitskin.cli.options import (
    BoardUri,
    MethodCode,
    Model,
    Output,
    Replace,
    own_method,
    seeded,
    with_output,
)
from eitskin.errors import ConfigurationError

if TYPE_CHECKING:
    from eitskin.frame import Frame
    from eitskin.training.method.input_spec import InputSpec

Angles = Annotated[
    str,
    typer.Option(
        help="Known angles in degrees, separated by commas; the flat sensor always comes first."
    ),
]
PerAngle = Annotated[int, typer.Option("--frames", min=1, help="Number of frames at each angle.")]
NoPrompt = Annotated[
    bool,
    typer.Option(
        "--no-prompt",
        help="Do not wait: a virtual: board bends its sensor; a script or a recording goes through "
        "the angles by itself, in turn.",
    ),
]


@with_output
def command(
    model: Model,
    *,
    out: Annotated[Path, typer.Option(help="File of the adapted pipeline, NAME.eitmodel.")],
    board: BoardUri,
    reference: ReferenceFile = None,
    angles: Angles = "-20,15,30,42.5,50",
    frames: PerAngle = 8,
    no_prompt: NoPrompt = False,
    method: MethodCode = None,
    replace: Replace = False,
    seed: int = 0,
    output: Output,
) -> None:
    """Adapt a trained pipeline to the sensor at hand, from a flat reference and known angles.

    Bring the sensor to each angle when asked, hold it still and untouched, and press Enter. With
    --reference the angles count from the stored state, and the sensor is not asked to be flat.
    Frames that were recorded before are taken by `eitskin adapt`.
    """
    from eitskin.training.pipeline.pipeline import open_pipeline
    from eitskin.training.pipeline.saved_form import require_writable
    from eitskin.training.pipeline.session import STORED_AGE

    require_writable(out, replace)
    pipeline = open_pipeline(model, own_method(method))
    pipeline.require_bends()
    if reference is not None:
        use_reference(pipeline, reference, None, output)
    wanted = ([0.0] if pipeline.stored is None else []) + angles_of(angles)
    taken = list(_from_board(board, pipeline.layout, wanted, frames, no_prompt, seed, output))
    known = [angle for angle in wanted for _ in range(frames)]
    if pipeline.stored is not None:
        bent = [pair for pair in zip(taken, known, strict=True) if pair[1]]
        begun = taken[0].time - STORED_AGE
        taken = [pipeline.stored.frame(begun), *(frame for frame, _ in bent)]
        known = [0.0, *(angle for _, angle in bent)]
    elif doubt := pipeline.doubt(pipeline.layout.voltages(taken[0])[0]):
        output.note(f"{doubt}; calibrating nevertheless, since you said that it is flat")
    calibration = pipeline.calibrate(taken, known)
    saved = pipeline.save(out)
    output.result({"out": str(saved), **calibration.as_dict()}, calibration_table(calibration))
    output.note(f"saved {saved}; use it with this sensor only")


def angles_of(text: str) -> list[float]:
    """Angles in degrees from text, without 0; raises ConfigurationError for other text."""
    try:
        return [angle for angle in map(float, text.split(",")) if angle]
    except ValueError as error:
        raise ConfigurationError(
            f"expected angles in degrees, apart by commas, such as -20,15,50, got {text!r}"
        ) from error


def _from_board(
    uri: str,
    layout: "InputSpec",
    angles: Sequence[float],
    frames: int,
    no_prompt: bool,
    seed: int,
    output: Output,
) -> "Iterator[Frame]":
    from eitskin.hardware.opening import open_board

    with open_board(uri, **seeded(uri, seed)) as board:
        layout.require_same_measurements(board.protocol, board.info.frequency)
        alone = left_alone if board.stage is None or "scene=" in uri else staged(0.0)
        hand = alone if no_prompt else asked(TerminalDialogue(output))
        poses = [bent(angle) for angle in angles]
        taken = frames_in_poses(
            board,
            poses,
            frames,
            hand,
            lambda pose: output.note(f"{frames} frames: {pose.words}"),
            newest=not no_prompt,
        )
        for frame, label in taken:
            if label.flat:  # refused now, not after the work of all angles
                layout.require_adaptable(layout.voltages(frame)[0])
            yield frame
