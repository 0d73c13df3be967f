"""`eitskin evaluate`: figures of a pipeline beside those of the paper."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.table import Table

from eitskin import datasets, training
from eitskin.cli.options import (
    MethodCode,
    Output,
    own_method,
    with_output,
)
from eitskin.cli.terminal import table_of

if TYPE_CHECKING:
    from eitskin.training.evaluation.evaluate import Evaluation


@with_output
def command(
    pipeline: Annotated[Path, typer.Argument(help="The trained pipeline, NAME.eitmodel.")],
    dataset: Annotated[Path, typer.Argument(help="Dataset to evaluate the pipeline on.")],
    *,
    out: Annotated[
        Path | None,
        typer.Option(help="Folder for a report with pictures; an earlier report is replaced."),
    ] = None,
    method: MethodCode = None,
    output: Output,
) -> None:
    """Evaluate a pipeline; on its own training dataset, only on the held-out frames."""
    from eitskin.datasets.store.summary import specimens_in_words
    from eitskin.training.evaluation.evaluate import Evaluation
    from eitskin.training.evaluation.report import require_report_folder
    from eitskin.training.method.settings import POSITIONS

    data = datasets.open_dataset(dataset)
    trained = training.open_pipeline(pipeline, own_method(method))
    if out is not None:
        require_report_folder(out)
    if trained.settings.method == POSITIONS:
        score = training.PositionScore.of(trained, data)
        if out is not None:
            save_position_report(trained, data, out, output)
        output.result(score.as_dict(), position_table(score))
        return
    frames = trained.held_out(data)
    if len(frames) < len(data):
        held_out = f"{len(frames)} frames never seen, of {specimens_in_words(data.select(frames))}"
        output.note(f"trained on this dataset: only the {held_out}, count")
    evaluation = Evaluation.of(trained, data.select(frames))
    if out is not None:
        save_report(evaluation, out, output)
    output.result(evaluation.report.as_dict(), paper_table(evaluation.report))


def save_report(evaluation: "Evaluation", folder: Path, output: Output) -> None:
    """Write the report folder, with machine, versions and date."""
    from eitskin.training.evaluation.report import write_report

    made_with = _made_with(evaluation.pipeline.settings.seed)
    output.note(f"report: {write_report(evaluation, folder, made_with)}")


def save_position_report(
    touches: "training.Pipeline", data: "datasets.Dataset", folder: Path, output: Output
) -> None:
    """Write the report folder of touch positions, with machine, versions and date."""
    from eitskin.training.evaluation.report import write_position_report

    written = write_position_report(touches, data, folder, _made_with(0))
    output.note(f"report: {written}")


def _made_with(seed: int) -> dict[str, str]:
    """Machine, versions and date."""
    from eitskin.provenance import Provenance

    made = Provenance.now(seed)
    versions = ", ".join(f"{name} {made.packages[name]}" for name in ("eitskin", "numpy", "scipy"))
    return {
        "machine": made.machine,
        "versions": f"Python {made.python}, {versions}",
        "date": made.date,
    }


def paper_table(report: "training.Report") -> Table:
    """Table of the paper's figures beside those of `report`."""
    from eitskin.training.evaluation.report import HEADINGS, table_rows
    from eitskin.training.evaluation.scores import SSIM_DEFINITION

    title = f"{report.frames} frames"
    return table_of(HEADINGS, table_rows(report), title=title, caption=SSIM_DEFINITION)


def position_table(score: "training.PositionScore") -> Table:
    """Table of position errors learned without geometry."""
    rows = (
        ("mean error", f"{score.mean_error_mm:.2f} mm"),
        ("median error", f"{score.median_error_mm:.2f} mm"),
        ("mean error of always the middle", f"{score.guess_error_mm:.1f} mm"),
    )
    return table_of(("touch position", "here"), rows, title=f"{score.frames} frames")
