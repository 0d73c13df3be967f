"""`eitskin train`, `eitskin evaluate`: a pipeline from a dataset, and its figures."""

import json
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer
from rich.console import Group
from rich.table import Table

from eitskin import datasets, training
from eitskin.cli.options import (
    TRAINING,
    MethodCode,
    Model,
    Output,
    Replace,
    make_table,
    own_method,
    with_output,
)
from eitskin.errors import ConfigurationError
from eitskin.extras import require_all

if TYPE_CHECKING:
    from eitskin.training.evaluation.evaluate import Evaluation
    from eitskin.training.evaluation.selection import Selection

AUTO = "auto"


@with_output
def command(
    dataset: Annotated[Path, typer.Argument(help="Dataset, from eitskin generate or import.")],
    *,
    out: Annotated[Path, typer.Option(help="File of the trained pipeline, NAME.eitmodel.")],
    epochs: Annotated[
        int | None, typer.Option(min=1, help="Passes over the frames, instead of the preset's.")
    ] = None,
    preset: Annotated[
        Literal["auto", "joint", "paper", "quick", "ridge", "mlp", "extra-trees", "greit"] | None,
        typer.Option(
            help="Method: auto (recommended, the default) compares joint and quick on held-out "
            "specimens; joint fits a learned model to each frame; paper is the paper's method, "
            "quick the same with faster settings; the others are baselines."
        ),
    ] = None,
    method: MethodCode = None,
    settings: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="NAME=VALUE",
            help="Hyper-parameter of the method. Repeatable.",
        ),
    ] = None,
    report: Annotated[
        Path | None,
        typer.Option(help="Folder for a report with figures; an earlier report is replaced."),
    ] = None,
    replace: Replace = False,
    seed: int = 0,
    output: Output,
) -> None:
    """Train a pipeline on a dataset and test it on held-out specimens.

    A quantity without labels in the dataset is not estimated. From positions of touches alone, or
    without the sensor's geometry, positions are learned, from the first 80 % in time.
    """
    from eitskin.training.evaluation.report import require_report_folder
    from eitskin.training.evaluation.selection import data_warnings
    from eitskin.training.pipeline.saved_form import require_writable

    require_all(training=TRAINING)
    require_writable(out, replace)
    data = datasets.open_dataset(dataset)
    alone = _positions_alone(data)
    if report is not None:
        require_report_folder(report)
    choice = choose(preset, method, settings, epochs, seed)
    if alone and choice.method:
        raise ConfigurationError(
            f"{alone}: touch positions are learned by a method of their own; leave out --method"
        )
    start = time.perf_counter()
    evaluation: Evaluation | None = None
    warnings: tuple[str, ...] = ()
    if alone:
        output.note(f"{alone}: learning touch positions only")
        trained, score = train_positions(data)
        warnings = score.warnings
        summary = (
            f"mean error {score.mean_error_mm:.2f} mm (guessing {score.guess_error_mm:.0f} mm)"
        )
    else:
        evaluation = train_and_measure(data, choice, output)
        trained, warnings = evaluation.pipeline, data_warnings(data, evaluation)
        summary = _summary(evaluation.report)
    seconds = time.perf_counter() - start
    saved = trained.save(out)
    if report is not None:
        _save_report(evaluation or (trained, data), report, output)
    for warning in warnings:
        output.note(f"warning: {warning}")
    frames, missing = trained.trained_on["frames"], trained.targets.missing
    if missing:
        output.note(f"not estimated, for lack of labels or by the method: {', '.join(missing)}")
    output.result(
        {
            "out": str(saved),
            "frames": frames,
            "seconds": round(seconds, 3),
            "metrics": trained.metrics,
            "estimates": trained.targets.as_dict(),
            "warnings": list(warnings),
        },
        f"{saved}: trained on {frames} frames in {seconds:.0f} s; on frames never seen: {summary}",
    )


def _positions_alone(data: "datasets.Dataset") -> str:
    """Reason why only positions of touches can be learned; empty where more can be."""
    from eitskin.training.method.targets import with_implied_labels

    if data.design is None:
        return "no geometry in this dataset"
    if data.protocol is None:
        return "no table of measurements in this dataset"
    if training.Targets.from_dataset(with_implied_labels(data)).positions_only:
        return "neither untouched frames nor bend angles in this dataset"
    return ""


def _summary(report: "training.Report") -> str:
    """States, position and angle of a report in a line."""
    shares = report.states.accuracy.items()
    shown = [f"{name} {share:.1%}" for name, share in shares if share is not None]
    single = report.touches.get("1")
    if single is not None and single.mean_error_mm is not None:
        error, guess = single.mean_error_mm, single.guess_error_mm
        shown.append(
            f"one touch: {single.found:.0%} within 15 mm, error {error:.2f} mm (guessing "
            f"{guess:.0f} mm)"
        )
    if report.bend.rmse_deg is not None:
        shown.append(f"bends: error {report.bend.rmse_deg:.2f} deg")
    return ", ".join(shown)


@dataclass(frozen=True)
class Choice:
    """Choice of what is trained, from the options of the command.

    Attributes:
        settings: settings of the training; None where the method is selected by held-out specimens.
        method: method of the user, in place of the one that the settings name.
        seed: seed of the training.
        epochs: passes over the frames; None for those of the settings.
    """

    settings: "training.TrainingSettings | None"
    method: "type[training.Method] | None"
    seed: int
    epochs: int | None


def choose(
    preset: str | None = None,
    method: str | None = None,
    options: Sequence[str] | None = None,
    epochs: int | None = None,
    seed: int = 0,
) -> Choice:
    """Choice by preset, or by the code of an own method; raises ConfigurationError for both."""
    if method is not None and preset is not None:
        raise ConfigurationError(
            f"expected --preset or --method, got both, {preset} and {method}; leave one out"
        )
    values = read_options(options or ())
    own = own_method(method)
    if own is not None:
        settings = training.TrainingSettings(method=own.KIND, seed=seed, options=values)
    elif preset in (None, AUTO):
        if values:
            raise ConfigurationError(
                "--set is for one method, got it with --preset auto, which tries several; name one"
            )
        return Choice(None, None, seed, epochs)
    else:
        settings = replace(training.TrainingSettings.preset(str(preset), seed), options=values)
    if epochs is not None:
        settings = settings.with_epochs(epochs)
    return Choice(settings, own, seed, epochs)


def read_options(texts: Sequence[str]) -> dict[str, Any]:
    """Values by name from texts NAME=VALUE; a value that is no JSON is text.

    Raises ConfigurationError for a text without a name.
    """
    values: dict[str, Any] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not (name and equals):
            raise ConfigurationError(f"expected --set NAME=VALUE, got '{text}'")
        try:
            values[name] = json.loads(value, parse_constant=str)
        except (ValueError, RecursionError):
            values[name] = value
    return values


def train_and_measure(data: "datasets.Dataset", choice: Choice, output: Output) -> "Evaluation":
    """Evaluation of a newly trained pipeline on its held-out frames; shows a bar per network."""
    from eitskin.training.evaluation.evaluate import Evaluation
    from eitskin.training.evaluation.selection import Selection

    start = time.perf_counter()
    selection = None
    with output.bars() as show:
        if choice.settings is None:
            selection = Selection.from_dataset(
                data, choice.seed, epochs=choice.epochs, progress=show
            )
        else:
            pipeline = training.Pipeline.fit(data, choice.settings, show, choice.method)
    output.detail(f"trained in {time.perf_counter() - start:.0f} s, measuring")
    if selection is not None:
        output.show(_comparison(selection))
        evaluation = selection.evaluation
    else:
        evaluation = Evaluation.from_dataset(pipeline, data.select(pipeline.held_out(data)))
    evaluation.pipeline.metrics.update(evaluation.report.as_dict())
    return evaluation


def _comparison(selection: "Selection") -> Group:
    """Table of the candidates on the held-out frames, and the choice."""
    from eitskin.datasets.store.summary import specimens_in_words

    forms = {
        "states": "{:.1%}",
        "error_mm": "{:.2f} mm",
        "found": "{:.1%}",
        "false_per_touch": "{:.1%}",
        "angle_rmse_deg": "{:.2f} deg",
    }
    judged, rows, remarks = selection.evaluation.dataset, [], []
    for trial in selection.trials:
        figures = [(form, trial.figures.get(name)) for name, form in forms.items()]
        shown = ["-" if figure is None else form.format(figure) for form, figure in figures]
        loss = f"{trial.loss:.3f}" if trial.losses else "-"
        rows.append((trial.preset, *shown, loss, f"{trial.seconds:.0f} s"))
        if trial.refusal:
            remarks.append(f"{trial.preset} cannot be trained here: {trial.refusal}")
        if trial.stopped:
            remarks.append(f"{trial.preset} was not trained to the end: {trial.stopped}")
    table = make_table(
        ("method", "states", "touch error", "found", "false", "bend error", "loss", "time"),
        rows,
        title=f"{len(judged)} held-out frames of {specimens_in_words(judged)}",
        caption="loss: mean of the relative errors of states, touches and bends; 1 for guesses",
    )
    return Group(table, *remarks, f"chosen: {selection.preset}")


def train_positions(
    data: "datasets.Dataset",
) -> "tuple[training.Pipeline, training.PositionScore]":
    """Regression of touch positions from a recording without geometry, with its score."""
    from eitskin.training.method.settings import POSITIONS

    learned = training.Pipeline.fit(data, training.TrainingSettings(POSITIONS))
    score = training.PositionScore.from_dataset(learned, data)
    learned.metrics.update(score.as_dict())
    return learned, score


@with_output
def evaluate(
    model: Model,
    dataset: Annotated[Path, typer.Argument(help="Dataset to evaluate the pipeline on.")],
    *,
    out: Annotated[
        Path | None,
        typer.Option(help="Folder for a report with figures; an earlier report is replaced."),
    ] = None,
    method: MethodCode = None,
    output: Output,
) -> None:
    """Evaluate a pipeline on a dataset (on its training dataset, on the held-out part)."""
    from eitskin.datasets.store.summary import specimens_in_words
    from eitskin.training.evaluation.evaluate import Evaluation
    from eitskin.training.evaluation.report import require_report_folder
    from eitskin.training.method.settings import POSITIONS

    data = datasets.open_dataset(dataset)
    trained = training.open_pipeline(model, own_method(method))
    if out is not None:
        require_report_folder(out)
    if trained.settings.method == POSITIONS:
        score = training.PositionScore.from_dataset(trained, data)
        if out is not None:
            _save_report((trained, data), out, output)
        rows = (
            ("mean error", f"{score.mean_error_mm:.2f} mm"),
            ("median error", f"{score.median_error_mm:.2f} mm"),
            ("mean error of guessing the middle", f"{score.guess_error_mm:.1f} mm"),
            (
                "error over standard error",
                "-" if (over := score.error_ratio) is None else f"{over:.2f}",
            ),
        )
        for fault in score.faults:
            output.note(fault)
        table = make_table(("touch position", "here"), rows, title=f"{score.frames} frames")
        output.result(score.as_dict(), table)
        return
    frames = trained.held_out(data)
    if len(frames) < len(data):
        held_out = f"{len(frames)} frames never seen, of {specimens_in_words(data.select(frames))}"
        output.note(f"trained on this dataset: only the {held_out}, count")
    for fault in trained.mark_failures(data.select(frames))[1]:
        output.note(fault)
    evaluation = Evaluation.from_dataset(trained, data.select(frames))
    if out is not None:
        _save_report(evaluation, out, output)
    output.result(evaluation.report.as_dict(), paper_table(evaluation.report))


def _save_report(
    source: "Evaluation | tuple[training.Pipeline, datasets.Dataset]", folder: Path, output: Output
) -> None:
    """Write the report folder of an evaluation, or of touch positions and their frames."""
    from eitskin.provenance import Provenance
    from eitskin.training.evaluation.report import write_position_report, write_report

    made = Provenance.now(0)
    versions = ", ".join(f"{name} {made.packages[name]}" for name in ("eitskin", "numpy", "scipy"))
    made_with = {
        "machine": made.machine,
        "versions": f"Python {made.python}, {versions}",
        "date": made.date,
    }
    if isinstance(source, tuple):
        written = write_position_report(*source, folder, made_with)
    else:
        written = write_report(source, folder, made_with)
    output.note(f"report: {written}")


def paper_table(report: "training.Report") -> Table:
    """Table of the paper's figures next to those of `report`."""
    from eitskin.training.evaluation.report import HEADINGS, table_rows
    from eitskin.training.evaluation.scores import SSIM_DEFINITION

    title = f"{report.frames} frames"
    return make_table(HEADINGS, table_rows(report), title=title, caption=SSIM_DEFINITION)
