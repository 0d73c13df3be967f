"""The stages about datasets and pipelines: contents, training, accuracy, run time, live episode."""

import dataclasses
import time
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from eitskin.cli.demo.film import episode_film
from eitskin.cli.demo.pictures import raw_frames, touch_positions, tracked_angle
from eitskin.cli.demo.results import StageResult, as_pictures
from eitskin.cli.episode import run_episode
from eitskin.datasets.recipe.recipe import Recipe
from eitskin.datasets.store.dataset import Dataset
from eitskin.datasets.store.schema import State
from eitskin.frame import Frame
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.training.evaluation.evaluate import Evaluation, Report
from eitskin.training.evaluation.report.figures import loss_curves
from eitskin.training.evaluation.report.folder import PICTURES
from eitskin.training.evaluation.scores import percentiles
from eitskin.training.paper.method import PaperMethod

if TYPE_CHECKING:
    from eitskin.training.pipeline.pipeline import Pipeline

ALT = {
    "confusion": "Matrix of true against estimated states",
    "bend_angle": "Estimated over true bend angle, and the distribution of the errors",
    "touch_maps_angles": "Touch maps of one touch at several bend angles beside the truth",
    "touch_maps_counts": "Touch maps of one to four touches beside the truth",
    "error_vectors": "Lines on the sensor from true to estimated positions",
    "localisation_errors": "Histogram of the distances between true and estimated positions",
}
"""Pictures of an evaluation, and their alternative texts."""

STEPS = {
    "classifier": "state",
    "bend_angle": "bend angle",
    "reconstruction": "reconstruction",
    "postprocessor": "touch map",
}
"""Attributes of the paper's method, and the result of each."""

TIMED_FRAMES = 300


def contents(sets: Mapping[str, Dataset], recipes: Mapping[str, Recipe]) -> StageResult:
    """Contents of every dataset; touches and frames of the first as pictures."""
    first, data = next(iter(sets.items()))
    drawn = {
        "positions": (touch_positions(data, first), "Positions of the touches on the sensor"),
        "frames": (raw_frames(data, first), "Raw frames: changes of all resistances"),
    }
    numbers = {name: _contents(sets[name], recipes[name]) for name in sets}
    return StageResult(numbers, as_pictures(drawn))


def _contents(data: Dataset, recipe: Recipe) -> dict[str, Any]:
    angles = data.bend_angle_deg[data.state != State.IDLE]
    counts = data.touch_count
    return {
        "frames": len(data),
        "seed": data.seed,
        "resolution": recipe.resolution,
        "snr_db": recipe.instrument.snr_db,
        "specimens": len(np.unique(data.specimen)),
        "states": {state.name.lower(): int(np.sum(data.state == state)) for state in State},
        "frames_by_touches": {str(n): int(np.sum(counts == n)) for n in np.unique(counts)},
        "touches": int(counts.sum()),
        "smallest_angle_deg": float(angles.min()) if angles.size else 0.0,
        "largest_angle_deg": float(angles.max()) if angles.size else 0.0,
    }


def training(pipeline: "Pipeline") -> StageResult:
    """Duration and frames of the training, and its losses."""
    curves = {
        name: dataclasses.asdict(history)
        for name, history in pipeline.method.learning_curves.items()
    }
    numbers = {
        "frames": pipeline.trained_on["frames"],
        "seconds": pipeline.metrics["training"]["seconds"],
        "epochs": {name: len(each["training"]) for name, each in curves.items()},
        "losses": curves,
    }
    drawn = {"losses": (loss_curves(pipeline), "Loss over the epochs of each network")}
    return StageResult(numbers, as_pictures(drawn))


def evaluated(pipeline: "Pipeline", data: Dataset) -> StageResult:
    """Figures of `eitskin evaluate`, and the pictures of its report."""
    evaluation = Evaluation.of(pipeline, data)
    drawn = {name: (PICTURES[f"{name}.png"](evaluation), alt) for name, alt in ALT.items()}
    return StageResult(evaluation.report.as_dict(), as_pictures(drawn))


def report_of(result: StageResult) -> Report:
    """Report of an evaluation, from the numbers of its stage."""
    return msgspec.convert(result.numbers, Report)


def latency(pipelines: "Mapping[str, Pipeline]", data: Dataset) -> StageResult:
    """Median and 99th percentile of the time per frame, whole and by steps of the method."""
    numbers = {}
    for which, pipeline in pipelines.items():
        numbers[which] = {
            name: dict(zip(("p50_ms", "p99_ms"), percentiles(milliseconds), strict=True))
            | {"times": len(milliseconds)}
            for name, milliseconds in timed(pipeline, data).items()
            if milliseconds
        }
    return StageResult(numbers)


def timed(pipeline: "Pipeline", data: Dataset) -> dict[str, list[float]]:
    """Times [ms] of frames of the first specimen in a row, after its flat reference.

    Returns the times of `Pipeline.process` as "whole frame" and, for the paper's method, those of
    each of its `STEPS` in the frames that need the step.
    """
    method, clocks = pipeline.method, {}
    if isinstance(method, PaperMethod):
        clocks = {name: _Clock(getattr(method, name)) for name in STEPS}
        pipeline = dataclasses.replace(pipeline, method=dataclasses.replace(method, **clocks))  # type: ignore[arg-type]
    rows = np.flatnonzero(data.specimen == data.specimen[0])[:TIMED_FRAMES]
    frames = [_numbered(data.frame(int(row)), n + 1) for n, row in enumerate(rows)]
    flat = data.reference[data.specimen[0]].astype(np.complex128)
    pipeline.process(dataclasses.replace(_numbered(frames[0], 0), impedance=flat))
    for clock in clocks.values():
        clock.milliseconds.clear()
    whole = []
    for frame in frames:
        start = time.perf_counter()
        pipeline.process(frame)
        whole.append(1e3 * (time.perf_counter() - start))
    steps = {STEPS[name]: clock.milliseconds for name, clock in clocks.items()}
    return {"whole frame": whole, **steps}


class _Clock:
    """Step of a method that records the time of each `apply`."""

    def __init__(self, step: Any) -> None:
        self._step = step
        self.milliseconds: list[float] = []

    def apply(self, *inputs: Any) -> Any:
        start = time.perf_counter()
        output = self._step.apply(*inputs)
        self.milliseconds.append(1e3 * (time.perf_counter() - start))
        return output

    def __getattr__(self, name: str) -> Any:
        return getattr(self._step, name)


def _numbered(frame: Frame, number: int) -> Frame:
    return dataclasses.replace(frame, number=number, time=0.1 * number, session=0)


def live(pipeline: "Pipeline", design: SensorDesign, seed: int, frames: int) -> StageResult:
    """The live episode on a virtual board, with `frames` frames in each step."""
    rows = run_episode(pipeline, seed, frames)
    angles = np.concatenate([row["angles_deg"] for row in rows])
    true = np.repeat([row["true_angle_deg"] for row in rows], [len(row["states"]) for row in rows])
    errors = [error for row in rows for error in row["errors_mm"]]
    p50, p99 = np.percentile(np.concatenate([row["latencies_ms"] for row in rows]), [50, 99])
    numbers = {
        "frames": len(angles),
        "right_states": sum(row["right_frames"] for row in rows),
        "angle_rmse_deg": float(np.sqrt(np.mean((angles - true) ** 2))),
        "touches": sum(len(row["true_touches_mm"]) for row in rows),
        "touches_found": len(errors),
        "mean_error_mm": float(np.mean(errors)) if errors else None,
        "latency": {"p50_ms": float(p50), "p99_ms": float(p99)},
        "steps": rows,
    }
    drawn = {"episode": (tracked_angle(rows), "True and estimated bend angle of each frame")}
    return StageResult(numbers, {"film": episode_film(rows, design), **as_pictures(drawn)})
