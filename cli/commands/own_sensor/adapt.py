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
    asked,
    bent,
    frames_in_poses,
    left_alone,
    staged,
)
from eitskin.cli.commands.recorded_frames import Recorded, Values, of_one_sensor, read_recorded
from eitskin.cli.commands.tare import ReferenceFile, use_reference
from eitskin.cli.terminal import table_of
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
    specimen: Annotated[
        int | None, typer.Option(min=0, help="Number of the specimen in the dataset.")
    ] = None,
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
    number of labelled frames, on blocks of time that were left out. The saved pipeline has learned
    from all frames.
    """
    from eitskin.training.pipeline.saved_form import require_writable

    require_all(training=options.TRAINING)
    require_writable(out, replace)
    before = open_start(model, options.own_method(method))
    data = of_one_sensor(read_recorded(recording, values, protocol), specimen)
    if before is not None and data.protocol is not None:
        before.layout.require_same_measurements(data.protocol, data.frequency)
    curve = () if no_table else curve_of(before, data, output)
    if curve:
        output.show(curve_table(curve))
    adapted = adapt(before, data, twin)
    saved = adapted.save(out)
    told = said(adapted)
    result = {"out": str(saved), "errors": [asdict(point) for point in curve], **told}
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

    Raises the errors of `Pipeline.adapt`, `InputSpec.described`, `Pipeline.fit` and
    `PressedTwin.read`, and ConfigurationError for a twin beside touch positions.
    """
    from eitskin.training.method.settings import POSITIONS

    if before is None or before.settings.method == POSITIONS:
        if twin is None:
            settings = training.TrainingSettings(POSITIONS, options={"share": 1.0})
            return training.Pipeline.fit(
                before.layout.described(data) if before else data, settings
            )
        raise ConfigurationError(
            "expected a pipeline that knows the forces of touches with --twin, got one of touch "
            "positions, which learns from presses alone; leave out --twin"
        )

    layout = before.layout
    before.adapt(data, twin=training.PressedTwin.read(twin, layout.protocol) if twin else None)
    return before


def curve_of(
    before: "training.Pipeline | None", data: "datasets.Dataset", output: options.Output
) -> "tuple[CurvePoint, ...]":
    """Errors against the number of labelled frames; none, with a note, where these are too few."""
    from eitskin.training.adaptation.press_fit import LabelledPresses
    from eitskin.training.evaluation.adaptation_curve import pipeline_curve, press_curve
    from eitskin.training.method.settings import POSITIONS

    with output.counting("errors by frames") as show:
        try:
            if before is None or before.settings.method == POSITIONS:
                known = data if before is None else before.layout.described(data)
                return press_curve(LabelledPresses.of(known), show)
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
        ("lost, %", _lost, "{:.0f}"),
    ]
    told = [each for each in shown if any(each[1](point) is not None for point in curve)]
    title = f"errors in blocks of time that were left out, {BLOCKS} in turn"
    rows = []
    for point in sorted(curve, key=lambda point: point.frames):
        values = [(read(point), form) for _, read, form in told]
        cells = ["" if value is None else form.format(value) for value, form in values]
        rows.append((str(point.frames), point.method, *cells))
    figures = (Column(name, justify="right") for name, _, _ in told)
    return table_of(("labelled frames", "method", *figures), rows, title=title)


def _lost(point: "CurvePoint") -> float | None:
    """Share of the touches that were not found [%]; None where all were."""
    return None if point.found is None or point.found == 1.0 else 100.0 * (1.0 - point.found)


def said(adapted: "training.Pipeline") -> dict[str, object]:
    """Facts of an adaptation for JSON."""
    known = adapted.adaptation or adapted.trained_on["validated"]
    return {"estimates": adapted.targets.as_dict(), "adaptation": dict(known)}


def in_words(adapted: "training.Pipeline") -> str:
    """A sentence about an adapted pipeline: what it learned from."""
    if not adapted.adaptation:
        frames, error = (
            adapted.trained_on["frames"],
            adapted.trained_on["validated"]["mean_error_mm"],
        )
        return (
            f"touch positions from {frames} frames of presses, {error:.1f} mm off in presses that "
            "were left out"
        )
    known = adapted.adaptation
    words = (
        f"adapted by {known['flat']} flat frames, {known['bends']} at known angles and "
        f"{known['touches']} with known touches; {known['left_out']} not used"
    )
    return words + twin_in_words(known["twin"]) if known.get("twin") else words


def twin_in_words(trial: "Mapping[str, Any]") -> str:
    """End of the sentence: whether the twin's response was taken."""
    from eitskin.training.method.interface import TwinTrial

    judged = TwinTrial(**trial)
    if judged.without is None or judged.with_twin is None:
        return "; touches answer as on the twin, which no known touch has judged"
    left = f"{judged.without:.1%} of the known touches' changes unexplained, {judged.with_twin:.1%}"
    return f"; {left} with the twin, which is {'taken' if judged.kept else 'not taken'}"


def calibration_table(calibration: "Calibration") -> Table:
    """Table of the standard errors of the angle before and after known angles were seen."""
    before, after = calibration.error_before_deg, calibration.error_after_deg
    rows = [
        (f"{angle:.1f}", f"{b:.2f}", f"{a:.2f}")
        for angle, b, a in zip(calibration.angles_deg, before, after, strict=True)
    ]
    caption = f"residual of the calibration frames {calibration.residual_deg:.2f} deg"
    headings = ("angle, deg", "standard error before, deg", "after, deg")
    return table_of(headings, rows, caption=caption)


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
    wanted = ([0.0] if pipeline.stored is None else []) + angles_of(angles)
    layout, taken = pipeline.layout, []
    with options.opened_board(board, seed) as opened:
        layout.require_same_measurements(opened.protocol, opened.info.frequency)
        alone = left_alone if opened.stage is None or "scene=" in board else staged(0.0)
        hand = alone if no_prompt else asked(TerminalDialogue(output))
        poses, newest = [bent(angle) for angle in wanted], not no_prompt

        def done(pose: Pose) -> None:
            output.note(f"{frames} frames: {pose.words}")

        for frame, label in frames_in_poses(opened, poses, frames, hand, done, newest=newest):
            if label.flat:  # refused now, not after the work of all angles
                layout.require_same_sensor(layout.voltages(frame)[0], adapting=True)
            taken.append(frame)
    known = [angle for angle in wanted for _ in range(frames)]
    if pipeline.stored is not None:
        moved = [pair for pair in zip(taken, known, strict=True) if pair[1]]
        begun = taken[0].time - STORED_AGE
        taken = [pipeline.stored.frame(begun), *(frame for frame, _ in moved)]
        known = [0.0, *(angle for _, angle in moved)]
    elif doubt := pipeline.doubt(layout.voltages(taken[0])[0]):
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
