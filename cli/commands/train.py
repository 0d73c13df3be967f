"""`eitskin train`: a pipeline from a dataset."""

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from eitskin.cli.commands.evaluate import save_report
from eitskin.cli.options import TRAINING, Json, Output, Quiet, Seed, Verbose
from eitskin.extras import require_all

if TYPE_CHECKING:
    from eitskin.datasets.store.dataset import Dataset
    from eitskin.training.evaluation.evaluate import Evaluation
    from eitskin.training.pipeline.pipeline import Pipeline
    from eitskin.training.positions.recorded_touches import RecordedTouches


def command(
    dataset: Annotated[Path, typer.Argument(help="Dataset, from eitskin generate or import.")],
    *,
    out: Annotated[Path, typer.Option(help="Where to save the pipeline, NAME.eitmodel.")],
    epochs: Annotated[
        int | None, typer.Option(min=1, help="Passes over the frames, instead of the preset's.")
    ] = None,
    preset: Annotated[
        str,
        typer.Option(
            help="joint: a learned model fitted to each frame; paper: the paper's stages, trained "
            "as published; quick: the same, trained faster."
        ),
    ] = "joint",
    report: Annotated[
        Path | None,
        typer.Option(help="Folder for a report with pictures; an earlier report is replaced."),
    ] = None,
    seed: Seed = 0,
    as_json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Train on 60 % of a dataset and evaluate on 20 % that were held out.

    Where the dataset does not know its sensor's geometry, only touch positions are learned, from
    the first 80 % in time.
    """
    from eitskin.datasets.store.folder import open_dataset
    from eitskin.training.pipeline.saved_form import require_writable

    output = Output(as_json, quiet, verbose)
    require_all(training=TRAINING)
    require_writable(out)
    data = open_dataset(dataset)
    if report is not None:
        _require_reportable(data, report)
    start = time.perf_counter()
    trained: Pipeline | RecordedTouches
    evaluation = None
    if data.design is None:
        output.note("no geometry in this dataset: learning touch positions only")
        trained = train_positions(data)
        found = f"mean error {trained.metrics['mean_error_mm']:.2f} mm"
    else:
        evaluation = train_and_measure(data, preset, epochs, seed, output)
        trained = evaluation.pipeline
        shares = evaluation.report.states.accuracy.items()
        found = ", ".join(f"{name} {share:.1%}" for name, share in shares if share is not None)
    seconds = time.perf_counter() - start
    saved = trained.save(out)
    if evaluation is not None and report is not None:
        save_report(evaluation, report, output)
    frames = trained.trained_on["frames"]
    output.result(
        {
            "out": str(saved),
            "frames": frames,
            "seconds": round(seconds, 3),
            "metrics": trained.metrics,
        },
        f"{saved}: trained on {frames} frames in {seconds:.0f} s; on frames never seen: {found}",
    )


def _require_reportable(data: "Dataset", report: Path) -> None:
    """Refuse a report that could not be written, before the training."""
    from eitskin.errors import ConfigurationError
    from eitskin.training.evaluation.report.folder import require_report_folder

    if data.design is None:
        raise ConfigurationError(
            "a dataset without geometry trains touch positions only, which have no report; "
            "leave out --report"
        )
    require_report_folder(report)


def train_pipeline(
    data: "Dataset", preset: str, epochs: int | None, seed: int, output: Output
) -> "Pipeline":
    """Trained pipeline with its metrics on held-out frames; shows a bar per network."""
    return train_and_measure(data, preset, epochs, seed, output).pipeline


def train_and_measure(
    data: "Dataset", preset: str, epochs: int | None, seed: int, output: Output
) -> "Evaluation":
    """Evaluation of a newly trained pipeline on its held-out frames."""
    from eitskin.training.evaluation.evaluate import Evaluation
    from eitskin.training.method.settings import TrainingSettings
    from eitskin.training.pipeline.pipeline import Pipeline

    settings = TrainingSettings.preset(preset, seed)
    if epochs is not None:
        settings = settings.with_epochs(epochs)
    start = time.perf_counter()
    with output.progress() as bar:
        tasks: dict[str, Any] = {}

        def show(stage: str, done: int, total: int) -> None:
            if stage not in tasks:
                tasks[stage] = bar.add_task(stage, total=total, rate="")
            bar.update(tasks[stage], completed=done)

        pipeline = Pipeline.fit(data, settings, show)
    output.detail(f"trained in {time.perf_counter() - start:.0f} s, measuring")
    evaluation = Evaluation.of(pipeline, data.select(pipeline.held_out(data)))
    pipeline.metrics.update(evaluation.report.as_dict())
    return evaluation


def train_positions(data: "Dataset") -> "RecordedTouches":
    """Regression of touch positions from a recording without geometry, with its metrics."""
    from eitskin.training.positions.recorded_touches import RecordedTouches

    learned = RecordedTouches.fit(data)
    learned.metrics.update(learned.evaluate(data).as_dict())
    return learned
