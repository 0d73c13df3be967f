"""Report of an evaluation as a folder: figures, and numbers next to those of the paper."""

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from eitskin.datasets import Dataset
from eitskin.datasets.store.summary import specimens_in_words
from eitskin.extras import require
from eitskin.files import atomic_file, new_contents
from eitskin.geometry import ConfigurationError, PartialError
from eitskin.training.evaluation.drawing import EXTRA, CaptionedFigure, NoFigure, style
from eitskin.training.evaluation.evaluate import Evaluation, PositionScore, held_out_positions
from eitskin.training.evaluation.figures import (
    ANGLES_DEG,
    COUNTED,
    MAX_VECTORS,
    SEVERAL_DEG,
    bend_angles,
    bend_sequence,
    confusion_matrix,
    draw_error_vectors,
    draw_errors,
    error_vectors,
    learning_curves,
    localisation_errors,
    loss_curves,
    pictures_by_count,
    touch_map_images,
)
from eitskin.training.evaluation.scores import SSIM_DEFINITION, Consistency, Report
from eitskin.training.method.observations import fingerprint
from eitskin.training.pipeline.pipeline import Pipeline

DOCUMENT, TEXT = "report.json", "report.md"
PICTURES: Mapping[str, Callable[[Evaluation], CaptionedFigure | NoFigure]] = {
    "training_curves.png": lambda evaluation: loss_curves(evaluation.pipeline),
    "confusion.png": confusion_matrix,
    "bend_angle.png": bend_angles,
    "bend_sequence.png": bend_sequence,
    "touch_maps_angles.png": lambda evaluation: touch_map_images(evaluation, [1], ANGLES_DEG),
    "touch_maps_counts.png": lambda evaluation: touch_map_images(evaluation, COUNTED, SEVERAL_DEG),
    "pictures.png": pictures_by_count,
    "error_vectors.png": error_vectors,
    "localisation_errors.png": localisation_errors,
}
_REMEDY = "make room, or choose another folder, and write the report again"

Row = tuple[str, str, str]

NOTHING = "-"  # where a figure has no value
ERROR, ANGLE = "{:.2f} +- {:.2f} mm", "{:.2f} deg (bias {:+.2f})"
HEADINGS: Row = ("experiment", "paper", "here")
COUNTS = {"1": "one touch", "2": "two touches", "3": "three touches", "4": "four touches"}
GROUPS = {**COUNTS, "bent": "bent and touched"}
PAPER_ERROR_MM = {"1": "4.8 +- 2.8 mm", "2": "5.5 mm", "3": "4.3 mm", "4": "5.0 mm"}
PAPER_SSIM = {"1": ("0.29", "0.71", "0.94", "-"), "several": ("0.11", "0.47", "0.80", "-")}
IMAGES = {
    "static": "static",
    "dynamic": "dynamic",
    "touch_map": "post-processed",
    "empty": "empty picture",
}


def require_report_folder(folder: Path) -> None:
    """Try the folder of a report, before the evaluation; a new one is not left.

    Raises ConfigurationError for a folder that cannot be made, or that holds anything but an
    earlier report, which is replaced; ImportError without matplotlib.
    """
    require("matplotlib", EXTRA)
    try:
        new = not folder.exists()
        folder.mkdir(parents=True, exist_ok=True)
        others = any(folder.iterdir()) and not (folder / DOCUMENT).is_file()
        if new:
            folder.rmdir()
    except OSError as error:
        raise ConfigurationError(
            f"no report can be written to {folder}: {error.strerror or error}; name a folder that "
            "can be made or written to"
        ) from error
    if others:
        raise ConfigurationError(
            f"{folder} holds other things and no report; name a new or empty folder"
        )


def write_report(evaluation: Evaluation, folder: str | Path, made_with: Mapping[str, str]) -> Path:
    """Write figures, report.json and report.md, replacing an earlier report; returns the folder.

    Args:
        evaluation: the evaluation to report.
        folder: path of the folder, made if missing.
        made_with: provenance that only the caller knows: machine, versions, date.

    Raises:
        ConfigurationError: as `require_report_folder`.
        PartialError: for a folder that can no longer be written to; its files are whole.
    """
    pipeline, data = evaluation.pipeline, evaluation.dataset
    seeds = {
        "training seed": str(pipeline.settings.seed),
        "seed of these frames": str(data.seed),
    }
    notes = [
        SSIM_DEFINITION,
        "Errors of positions are those of touches matched by the Hungarian method within 15 mm.",
    ]
    recipe: list[str] = []
    if data.recipe:
        recipe = [
            "Recipe of the frames, with instrument and specimens:",
            f"```toml\n{data.recipe.rstrip()}\n```",
        ]
    document = {
        "provenance": {**_provenance(pipeline, data), **seeds, **made_with},
        "report": evaluation.report.as_dict(),
        "definitions": {"ssim": SSIM_DEFINITION},
        "losses": {name: asdict(each) for name, each in learning_curves(pipeline).items()},
    }
    drawings = {name: partial(draw, evaluation) for name, draw in PICTURES.items()}
    table = [HEADINGS, *table_rows(evaluation.report)]
    title = "Evaluation of a pipeline"
    return _write_folder(Path(folder), title, table, drawings, document, notes, recipe)


def write_position_report(
    touches: Pipeline, dataset: Dataset, folder: str | Path, made_with: Mapping[str, str]
) -> Path:
    """Write the report of positions that were learned from a recording; returns the folder.

    The frames of `dataset` that were held out are tested. Raises DataError without any, and errors
    as `write_report`.
    """
    score = PositionScore.from_dataset(touches, dataset).as_dict()
    true, places = held_out_positions(touches, dataset)
    estimated = places.place
    errors = np.linalg.norm(estimated - true, axis=1)
    caption = f"Localisation errors of {len(true)} touches; the largest are in the last bin."
    drawings = {
        "error_vectors.png": lambda: draw_error_vectors(
            touches.layout.known_design, true[:MAX_VECTORS], estimated[:MAX_VECTORS]
        ),
        "localisation_errors.png": lambda: draw_errors(errors, caption),
    }
    rows = [
        (name.replace("_mm", " [mm]").replace("_", " "), f"{value:.2f}")
        if isinstance(value, float)
        else (name.replace("_", " "), str(value))
        for name, value in score.items()
    ]
    provenance = _provenance(touches, dataset.select(touches.held_out(dataset)))
    document = {"provenance": {**provenance, **made_with}, "report": score}
    table, title = [("figure", "here"), *rows], "Evaluation of touch positions"
    return _write_folder(Path(folder), title, table, drawings, document)


def _write_folder(
    folder: Path,
    title: str,
    table: Sequence[Sequence[str]],
    drawings: Mapping[str, Callable[[], CaptionedFigure | NoFigure]],
    document: dict[str, Any],
    notes: Sequence[str] = (),
    ends: Sequence[str] = (),
) -> Path:
    """Write pictures, report.json and report.md; returns the folder.

    The document of report.json also gets captions and reasons of missing pictures; `notes` follow
    the table of report.md, `ends` its pictures. Raises errors as `write_report`.
    """
    require_report_folder(folder)
    captions, left_out = {}, {}
    with new_contents(folder), style():
        for name, draw in drawings.items():
            drawn = draw()
            if isinstance(drawn, NoFigure):
                left_out[name] = drawn.why
                continue
            with atomic_file(folder / name, PartialError, _REMEDY) as path:
                drawn.figure.savefig(path)
            captions[name] = drawn.caption
        document |= {"pictures": captions, "left_out": left_out}
        first, *rows = ("| " + " | ".join(row) + " |" for row in table)
        paragraphs = [
            f"# {title}",
            "\n".join(f"- {name}: {value}" for name, value in document["provenance"].items()),
            "\n".join([first, "|---" * len(table[0]) + "|", *rows]),
            *notes,
        ]
        for name, caption in captions.items():
            words = name.removesuffix(".png").replace("_", " ")
            paragraphs += [f"![{words}]({name})", caption]
        if left_out:
            reasons = (f"- {name}: {why}" for name, why in left_out.items())
            paragraphs += ["Left out:", "\n".join(reasons)]
        texts = {
            DOCUMENT: json.dumps(document, indent=1, allow_nan=False),
            TEXT: "\n\n".join([*paragraphs, *ends]),
        }
        for name, text in texts.items():
            with atomic_file(folder / name, PartialError, _REMEDY) as path:
                path.write_text(text + "\n", encoding="utf-8")
    for name in left_out:
        (folder / name).unlink(missing_ok=True)  # of an earlier report
    return folder


def _provenance(pipeline: Pipeline, data: Dataset) -> dict[str, Any]:
    """Method, training set and frames of an evaluation."""
    made = pipeline.trained_on
    return {
        "method": pipeline.method.KIND,
        "trained on": f"{made['frames']} {made['source']} frames of the dataset {made['sha256']}",
        "measured on": f"{len(data)} {data.source} frames of {specimens_in_words(data)}, frames "
        + fingerprint(data),
    }


def table_rows(report: Report) -> Iterator[Row]:
    """Rows of experiment, result of the paper and result of `report`, of what is estimated."""
    yield from _touch_rows(report)
    yield from _state_rows(report)
    if report.estimates.angle:
        yield from _bend_rows(report)
    if missing := report.estimates.missing:
        yield "not estimated", NOTHING, ", ".join(missing)
    latency = report.latency
    # The paper's 606.6 ms hold 303 ms of acquisition.
    times = f"{latency.p50_ms:.1f} ms (p99 {latency.p99_ms:.1f} ms)"
    yield "processing of a frame", "303.6 of 606.6 ms", times


def _touch_rows(report: Report) -> Iterator[Row]:
    for group, name in GROUPS.items():
        if score := report.touches.get(group):
            spread = (score.mean_error_mm, score.deviation_mm)
            yield f"{name}: error", PAPER_ERROR_MM.get(group, "-"), _text(ERROR, *spread)
            quantiles = (score.median_error_mm, score.p95_error_mm)
            yield "  median, 95 % within", "-", _text("{:.2f} mm, {:.2f} mm", *quantiles)
            yield "  error of guessing the middle", "-", f"{score.guess_error_mm:.1f} mm"
            yield "  detected, false", "-", f"{score.found:.1%}, {score.false_per_touch:.1%}"
    for group, paper in PAPER_SSIM.items():
        if score := report.touches.get(group):
            name = COUNTS.get(group, group)
            for (key, picture), figure in zip(IMAGES.items(), paper, strict=True):
                if key in score.ssim:
                    yield f"{name}: SSIM {picture}", figure, f"{score.ssim[key]:.2f}"
    if untouched := report.untouched:
        shown = f"in {untouched.touched:.2%} of {untouched.frames} frames"
        yield "touches where there are none", "-", shown
    if calibration := report.place_calibration:
        yield "position error / standard error", "-", _consistency(calibration)
    if force := report.force:
        shown = f"{force.mean_error_n:.2f} N (bias {force.bias_n:+.2f})"
        yield "force of a touch: error", "-", shown


def _state_rows(report: Report) -> Iterator[Row]:
    states, told_apart = report.states, report.estimates.states
    if "idle" in told_apart:
        yield "idle recognised", "> 97 %", _text("{:.1%}", states.accuracy["idle"])
        yield "  mistaken for a touch", NOTHING, _text("{:.1%}", states.idle_as_touch)
    if "touch" in told_apart:
        yield "touch recognised", "99 %", _text("{:.1%}", states.accuracy["touch"])
        if "bend" in told_apart or states.bent_touch_accuracy is not None:
            yield "  on a bent sensor", NOTHING, _text("{:.1%}", states.bent_touch_accuracy)
    if "bend" in told_apart:
        yield "bend recognised", NOTHING, _text("{:.1%}", states.accuracy["bend"])
    if states.left_out:
        yield "frames of another state", NOTHING, f"{states.left_out}, not scored"


def _bend_rows(report: Report) -> Iterator[Row]:
    bend = report.bend
    touched = (bend.touched_rmse_deg, bend.touched_bias_deg)
    yield "bend angle, R2", "0.997", _text("{:.4f}", bend.r2)
    yield "bend angle, RMSE", "0.90 deg", _text(ANGLE, bend.rmse_deg, bend.bias_deg)
    yield "  while touched", "-", _text(ANGLE, *touched)
    if bend.calibration:
        yield "angle error / standard error", "-", _consistency(bend.calibration)


def _consistency(consistency: Consistency) -> str:
    return f"rms {consistency.rms_ratio:.2f}, {consistency.within_one:.0%} within one"


def _text(form: str, *values: float | None) -> str:
    """Values in a format; a dash where there are none."""
    return NOTHING if None in values else form.format(*values)
