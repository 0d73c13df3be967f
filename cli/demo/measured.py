"""The parts of a demo that measure a pipeline."""

import dataclasses
from collections.abc import Mapping
from typing import TYPE_CHECKING

import msgspec
import numpy as np

from eitskin.cli.demo.parts import Part, drawn_picture, drawn_pictures
from eitskin.cli.demo.pictures import latencies, tracked_angle
from eitskin.cli.episode import run_episode
from eitskin.datasets.store.dataset import Dataset
from eitskin.training.evaluation.report.drawing import style

if TYPE_CHECKING:
    from eitskin.training.evaluation.evaluate import Report
    from eitskin.training.pipeline.pipeline import Pipeline

PICTURES = {
    "confusion": "Matrix of true against estimated states",
    "bend_angle": "Estimated over true bend angle, and the distribution of the errors",
    "touch_maps_angles": "Touch maps of one touch at several bend angles beside the truth",
    "touch_maps_counts": "Touch maps of one to four touches beside the truth",
    "error_vectors": "Lines on the sensor from true places to those found",
    "localisation_errors": "Histogram of the distances between true and found places",
}
"""Of an evaluation, and what is seen on them."""


def report_of(part: Part) -> "Report":
    """The report whose figures `evaluated` wrote down."""
    from eitskin.training.evaluation.evaluate import Report

    return msgspec.convert(part.numbers, Report)


def training(pipeline: "Pipeline") -> Part:
    """How long it took, on what, and how the losses fell."""
    from eitskin.training.evaluation.report.curves import loss_curves

    learning_curves = {
        name: dataclasses.asdict(history)
        for name, history in pipeline.method.learning_curves.items()
    }
    numbers = {
        "frames": pipeline.trained_on["frames"],
        "seconds": pipeline.metrics["training"]["seconds"],
        "epochs": {name: len(each["training"]) for name, each in learning_curves.items()},
        "losses": learning_curves,
    }
    with style():
        drawn = {"losses": (loss_curves(pipeline), "Loss over the epochs of each network")}
        return Part(numbers, drawn_pictures(drawn))


def evaluated(pipeline: "Pipeline", data: Dataset) -> Part:
    """The figures of `evaluate`, and the pictures of its report that these frames have."""
    from eitskin.training.evaluation.evaluate import Evaluation
    from eitskin.training.evaluation.report.folder import PICTURES as DRAWN

    evaluation = Evaluation.of(pipeline, data)
    with style():
        pictures = drawn_pictures(
            {name: (DRAWN[f"{name}.png"](evaluation), alt) for name, alt in PICTURES.items()}
        )
    return Part(evaluation.report.as_dict(), pictures)


def latency(pipelines: "Mapping[str, Pipeline]", data: Dataset) -> Part:
    """Times of both pipelines, and of the stages of the first."""
    from eitskin.cli.demo.latency import time_pipeline

    times = {name: time_pipeline(pipeline, data) for name, pipeline in pipelines.items()}
    with style():
        picture = drawn_picture(latencies(times), "Histogram of times per frame; bars per stage")
    return Part({name: each.as_dict() for name, each in times.items()}, {"latency": picture})


def live(pipeline: "Pipeline", seed: int, frames: int) -> Part:
    """The episode, `frames` of every step."""
    rows = run_episode(pipeline, seed, frames)
    with style():
        picture = drawn_picture(tracked_angle(rows), "True and estimated bend angle of each frame")
    said = np.concatenate([row["angles_deg"] for row in rows])
    true = np.repeat([row["true_angle_deg"] for row in rows], [len(row["states"]) for row in rows])
    times = np.concatenate([row["latencies_ms"] for row in rows])
    errors = [error for row in rows for error in row["errors_mm"]]
    p50, p99 = np.percentile(times, [50, 99])
    numbers = {
        "frames": len(said),
        "right_states": sum(row["right_frames"] for row in rows),
        "angle_rmse_deg": float(np.sqrt(np.mean((said - true) ** 2))),
        "touches": sum(len(row["true_touches_mm"]) for row in rows),
        "touches_found": len(errors),
        "mean_error_mm": float(np.mean(errors)) if errors else None,
        "latency": {"p50_ms": float(p50), "p99_ms": float(p99)},
        "steps": rows,
    }
    return Part(numbers, {"episode": picture})
