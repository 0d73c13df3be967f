"""`eitskin adapt`, `eitskin calibrate`: a pipeline for one sensor, from its labelled frames."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.table import Column, Table

from eitskin import datasets, training
from eitskin.cli import options
from eitskin.cli.commands.own_sensor.poses import (
    Pose,
    TerminalDialogue,
    ask_for_poses,
    bent_pose,
    frames_in_poses,
    left_alone,
    stage_poses,
)
from eitskin.cli.commands.recorded_frames import (
    OneSpecimen,
    Recorded,
    Values,
    read_recorded,
    select_one_sensor,
)
from eitskin.cli.commands.tare import ReferenceFile, use_reference
from eitskin.errors import ConfigurationError, DataError
from eitskin.extras import require_all

if TYPE_CHECKING:
    from eitskin.training.evaluation.adaptation_curve import CurvePoint
    from eitskin.training.method.interface import Calibration

ANGLES = "-20,15,30,42.5,50"  # deg
NOTHING = "none"
"""Name in place of a pipeline, where nothing was trained before."""

StartModel = Annotated[
    Path,
    typer.Argument(
        help="Trained pipeline, NAME.eitmodel; none, to learn touch positions alone.",
        metavar="MODEL",
    ),
]


@options.with_output
def command(
    model: StartModel,
    recording: Recorded,
    *,
    out: Annotated[Path, typer.Option(help="File of the adapted pipeline, NAME.eitmodel.")],
    specimen: OneSpecimen = None,
    values: Values = None,
    protocol: options.MeasuredPairs = None,
    method: options.MethodCode = None,
    twin: Annotated[
        Path | None,
        typer.Option(help="Folder of `eitskin fit twin`, whose touch response is used."),
    ] = None,
    no_table: Annotated[
        bool, typer.Option("--no-table", help="Skip the error table (faster).")
    ] = False,
    replace: options.Replace = False,
    output: options.Output,
) -> None:
    """Adapt a pipeline to one sensor with labelled frames.

    All labels count: angles, positions, forces, or just untouched. The table shows errors over the
    number of labelled frames, on blocks of time that were left out. The saved pipeline uses all.
    """
    from eitskin.training.pipeline.saved_form import require_writable

    require_all(training=options.TRAINING)
    require_writable(out, replace)
    before = open_start(model, options.own_method(method))
    data = select_one_sensor(read_recorded(recording, values, protocol), specimen)
    if before is not None and data.protocol is not None:
        before.layout.require_same_measurements(data.protocol, data.frequency)
    curve = () if no_table else adaptation_curve(before, data, output)
    if curve:
        output.show(curve_table(curve))
    adapted = adapt(before, data, twin)
    saved = adapted.save(out)
    facts = adaptation_facts(adapted)
    result = {"out": str(saved), "errors": [asdict(point) for point in curve], **facts}
    output.result(result, f"{saved}: {in_words(adapted)}")
    output.note("use it with this sensor only")


def open_start(model: Path, method: "type[training.Method] | None") -> "training.Pipeline | None":
    """The pipeline to start from; None for the word `none`, unless a folder has that name."""
    if str(model) == NOTHING and not model.exists():
        return None
    return training.open_pipeline(model, method)


def adapt(
    before: "training.Pipeline | None", data: "datasets.Dataset", twin: Path | None = None
) -> "training.Pipeline":
    """Pipeline for the one sensor of a dataset; touch positions are learned from its presses alone.

    Raises the errors of `Pipeline.adapt`, `InputSpec.complete_dataset`, `Pipeline.fit` and
    `PressedTwin.read`, and ConfigurationError for a twin next to touch positions.
    """
    from eitskin.training.method.settings import POSITIONS

    if before is None or before.settings.method == POSITIONS:
        if twin is None:
            settings = training.TrainingSettings(POSITIONS, options={"share": 1.0})
            return training.Pipeline.fit(
                before.layout.complete_dataset(data) if before else data, settings
            )
        raise ConfigurationError(
            "expected a pipeline that knows the forces of touches with --twin, got one of touch "
            "positions, which learns from presses alone; leave out --twin"
        )

    layout = before.layout
    before.adapt(data, twin=training.PressedTwin.read(twin, layout.protocol) if twin else None)
    return before


def adaptation_curve(
    before: "training.Pipeline | None", data: "datasets.Dataset", output: options.Output
) -> "tuple[CurvePoint, ...]":
    """Errors against the number of labelled frames; none, with a note, where these are too few."""
    from eitskin.training.adaptation.press_fit import LabelledPresses
    from eitskin.training.evaluation.adaptation_curve import pipeline_curve, press_curve
    from eitskin.training.method.settings import POSITIONS

    with output.counting("errors by frames") as show:
        try:
            if before is None or before.settings.method == POSITIONS:
                labelled = data if before is None else before.layout.complete_dataset(data)
                return press_curve(LabelledPresses.from_dataset(labelled), show)
            return pipeline_curve(before, data, show)
        except DataError as error:
            output.note(f"no table of errors: {error}")
            return ()


def curve_table(curve: "Sequence[CurvePoint]") -> Table:
    """Table of errors, a row for each number of frames and method."""
    from eitskin.training.evaluation.adaptation_curve import BLOCKS

    shown: list[tuple[str, Callable[[CurvePoint], float | None], str]] = [
        ("angle, deg rms", lambda point: point.angle_deg, "{:.2f}"),
        ("place, mm", lambda point: point.place_mm, "{:.1f}"),
        ("lost, %", lambda point: point.missed_percentage, "{:.0f}"),
    ]
    shown_columns = [each for each in shown if any(each[1](point) is not None for point in curve)]
    title = f"errors in blocks of time that were left out, {BLOCKS} in turn"
    rows = []
    for point in sorted(curve, key=lambda point: point.frames):
        values = [(read(point), form) for _, read, form in shown_columns]
        cells = ["" if value is None else form.format(value) for value, form in values]
        rows.append((str(point.frames), point.method, *cells))
    figures = (Column(name, justify="right") for name, _, _ in shown_columns)
    return options.make_table(("labelled frames", "method", *figures), rows, title=title)


def adaptation_facts(pipeline: "training.Pipeline") -> dict[str, object]:
    """Facts of an adaptation for JSON."""
    facts = pipeline.adaptation or pipeline.trained_on["validated"]
    return {"estimates": pipeline.targets.as_dict(), "adaptation": dict(facts)}


def in_words(pipeline: "training.Pipeline") -> str:
    """A sentence about an adapted pipeline: what it learned from."""
    if not pipeline.adaptation:
        frames, error = (
            pipeline.trained_on["frames"],
            pipeline.trained_on["validated"]["mean_error_mm"],
        )
        return (
            f"touch positions from {frames} frames of touches, {error:.1f} mm off in touches that "
            "were left out"
        )
    facts = pipeline.adaptation
    words = (
        f"adapted by {facts['flat']} flat frames, {facts['bends']} at known angles and "
        f"{facts['touches']} with known touches; {facts['left_out']} not used"
    )
    return words + twin_in_words(facts["twin"]) if facts.get("twin") else words


def twin_in_words(trial: "Mapping[str, Any]") -> str:
    """End of the sentence: whether the twin's response was taken."""
    from eitskin.training.method.interface import TwinTrial

    judged = TwinTrial(**trial)
    if judged.without is None or judged.with_twin is None:
        return "; the touch response is the twin's, which no known touch tested"
    left = f"{judged.without:.1%} of the known touches' changes unexplained, {judged.with_twin:.1%}"
    return f"; {left} with the twin, which is {'taken' if judged.accepts_twin else 'not taken'}"


def calibration_table(calibration: "Calibration") -> Table:
    """Table of the standard errors of the angle before and after known angles were seen."""
    before, after = calibration.error_before_deg, calibration.error_after_deg
    rows = [
        (f"{angle:.1f}", f"{b:.2f}", f"{a:.2f}")
        for angle, b, a in zip(calibration.angles_deg, before, after, strict=True)
    ]
    caption = f"residual of the calibration frames {calibration.residual_deg:.2f} deg"
    headings = ("angle, deg", "standard error before, deg", "after, deg")
    return options.make_table(headings, rows, caption=caption)


Angles = Annotated[
    str,
    typer.Option(
        help="Known angles in degrees, separated by commas; the flat sensor always comes first."
    ),
]


@options.with_output
def calibrate(
    model: options.Model,
    *,
    out: Annotated[Path, typer.Option(help="File of the adapted pipeline, NAME.eitmodel.")],
    board: options.BoardOption = None,
    reference: ReferenceFile = None,
    angles: Angles = ANGLES,
    frames: Annotated[
        int, typer.Option("--frames", min=1, help="Number of frames at each angle.")
    ] = 8,
    no_prompt: Annotated[
        bool,
        typer.Option(
            "--no-prompt",
            help="Do not wait for Enter: a virtual: board bends its sensor, a script or recording "
            "goes through the angles in turn.",
        ),
    ] = False,
    method: options.MethodCode = None,
    replace: options.Replace = False,
    seed: int = 0,
    output: options.Output,
) -> None:
    """Calibrate the bend angle of a sensor at known angles.

    Bring the sensor to each angle when asked, hold it still and untouched, and press Enter. With
    --reference the angles count from the stored state, and the sensor need not be flat. For
    frames that you recorded before, use `eitskin adapt`.
    """
    from eitskin.training.pipeline.saved_form import require_writable
    from eitskin.training.pipeline.session import STORED_AGE

    board = options.named_board(board)
    require_writable(out, replace)
    pipeline = training.open_pipeline(model, options.own_method(method))
    pipeline.require_bends()
    if reference is not None:
        use_reference(pipeline, reference, None, output)
    all_angles = ([0.0] if pipeline.stored_reference is None else []) + parse_angles(angles)
    layout, taken_frames = pipeline.layout, []
    with options.opened_board(board, seed, layout) as opened:
        layout.require_same_measurements(opened.protocol, opened.info.frequency)
        alone = left_alone if opened.stage is None or "scene=" in board else stage_poses(0.0)
        hand = alone if no_prompt else ask_for_poses(TerminalDialogue(output))
        poses, newest = [bent_pose(angle) for angle in all_angles], not no_prompt

        def note_pose(pose: Pose) -> None:
            output.note(f"{frames} frames: {pose.words}")

        for frame, label in frames_in_poses(opened, poses, frames, hand, note_pose, newest=newest):
            if label.flat:  # refused now, not after the work of all angles
                layout.require_same_sensor(layout.voltages(frame)[0], adapting=True)
            taken_frames.append(frame)
    known_angles = [angle for angle in all_angles for _ in range(frames)]
    if pipeline.stored_reference is not None:
        moved = [pair for pair in zip(taken_frames, known_angles, strict=True) if pair[1]]
        begun = taken_frames[0].time - STORED_AGE
        taken_frames = [pipeline.stored_reference.frame(begun), *(frame for frame, _ in moved)]
        known_angles = [0.0, *(angle for _, angle in moved)]
    elif doubt := pipeline.doubt(layout.voltages(taken_frames[0])[0]):
        output.note(f"{doubt}; calibrating nevertheless, since you stated that it is flat")
    calibration = pipeline.calibrate(taken_frames, known_angles)
    saved = pipeline.save(out)
    output.result({"out": str(saved), **calibration.as_dict()}, calibration_table(calibration))
    output.note(f"saved {saved}; use it with this sensor only")


def parse_angles(text: str) -> list[float]:
    """Angles in degrees from text, without 0; raises ConfigurationError for other text."""
    try:
        return [angle for angle in map(float, text.split(",")) if angle]
    except ValueError as error:
        raise ConfigurationError(
            f"expected angles in degrees, apart by commas, such as -20,15,50, got {text!r}"
        ) from error
