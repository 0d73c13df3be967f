"""`eitskin evaluate`: the paper's table, with what a pipeline reaches beside it."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.table import Table

from eitskin.cli.options import Json, Output, Quiet, Seed, Verbose

if TYPE_CHECKING:
    from eitskin.training import PositionScore, Report

COUNTS = {"1": "one touch", "2": "two touches", "3": "three touches", "4": "four touches"}
PAPER_ERROR_MM = {"1": "4.8 +- 2.8", "2": "5.5", "3": "4.3", "4": "5.0"}
PAPER_SSIM = {"1": ("0.29", "0.71", "0.94"), "several": ("0.11", "0.47", "0.80")}
PICTURES = {
    "static": "static reference",
    "dynamic": "dynamic reference",
    "touch_map": "post-processed",
}


def command(
    pipeline: Annotated[Path, typer.Argument(help="The trained pipeline, NAME.eitmodel.")],
    dataset: Annotated[Path, typer.Argument(help="Dataset to measure it on.")],
    *,
    seed: Seed = 0,
    as_json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Measure a pipeline; on the dataset it was trained on, only the part it never saw."""
    from eitskin.datasets import open_dataset
    from eitskin.training import Pipeline, RecordedTouches, evaluate
    from eitskin.training.saved_pipeline import read_pipeline

    output = Output(as_json, quiet, verbose)
    output.detail(f"nothing is random in an evaluation, seed {seed} is not used")
    data = open_dataset(dataset)
    if read_pipeline(pipeline).kind == RecordedTouches.KIND:
        score = RecordedTouches.load(pipeline).evaluate(data)
        output.result(score.as_dict(), position_table(score))
        return
    trained = Pipeline.load(pipeline)
    frames = trained.held_out(data)
    if len(frames) < len(data):
        output.note(f"trained on this dataset: only the {len(frames)} frames never seen count")
    report = evaluate(trained, data.select(frames))
    output.result(report.as_dict(), paper_table(report))


def paper_table(report: "Report") -> Table:
    """The figures of the paper beside those of `report`."""
    table = Table("experiment", "paper", "here", title=f"{report.frames} frames")
    for count, name in COUNTS.items():
        if score := report.touches.get(count):
            error = _figure(score.mean_error_mm, "{:.1f}") + _figure(
                score.deviation_mm, " +- {:.1f}"
            )
            details = f"{error} mm, {score.found:.1%} found, {score.false_per_touch:.1%} false"
            table.add_row(f"{name}: error", f"{PAPER_ERROR_MM[count]} mm", details)
    for count, paper in PAPER_SSIM.items():
        if (score := report.touches.get(count)) and score.ssim:
            name = COUNTS.get(count, "several touches")
            for (key, picture), figure in zip(PICTURES.items(), paper, strict=True):
                table.add_row(f"{name}: SSIM, {picture}", figure, f"{score.ssim[key]:.2f}")
    states = report.states
    table.add_row("idle recognised", "> 97 %", _figure(states.accuracy["idle"], "{:.1%}"))
    table.add_row("touch recognised", "99 %", _figure(states.accuracy["touch"], "{:.1%}"))
    table.add_row("  on a bent sensor", "-", _figure(states.bent_touch_accuracy, "{:.1%}"))
    table.add_row("bend recognised", "-", _figure(states.accuracy["bend"], "{:.1%}"))
    table.add_row("bend angle, R2", "0.997", _figure(report.bend.r2, "{:.4f}"))
    table.add_row("bend angle, RMSE", "0.90 deg", _figure(report.bend.rmse_deg, "{:.2f} deg"))
    touched = _figure(report.bend.touched_rmse_deg, "{:.2f} deg")
    table.add_row("  while touched", "-", touched)
    latency = report.latency
    table.add_row(
        "time per frame",
        "606.6 ms, 303 ms of it acquisition",
        f"{latency.p50_ms:.1f} ms median, {latency.p99_ms:.1f} ms p99, processing alone",
    )
    return table


def position_table(score: "PositionScore") -> Table:
    """Touch positions learned without geometry."""
    table = Table("touch position", "here", title=f"{score.frames} frames")
    table.add_row("mean error", f"{score.mean_error_mm:.2f} mm")
    table.add_row("median error", f"{score.median_error_mm:.2f} mm")
    table.add_row("mean error of saying the middle", f"{score.guess_error_mm:.1f} mm")
    return table


def _figure(value: float | None, form: str) -> str:
    """`value` in its form; a dash where there is none."""
    return "-" if value is None else form.format(value)
