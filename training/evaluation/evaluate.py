"""Evaluation of a pipeline on a dataset: the figures of the paper, by stated definitions."""

import time
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eitskin.datasets.store.dataset import Dataset
from eitskin.datasets.store.schema import State
from eitskin.datasets.store.touch_map import touch_maps
from eitskin.errors import DataError
from eitskin.frame import Frame
from eitskin.protocol import Protocol
from eitskin.training.evaluation.scores import (
    BendScore,
    ForceScore,
    LatencyScore,
    Matches,
    Report,
    StateScore,
    TouchScore,
    UntouchedScore,
    confusion,
    consistency,
    determination,
    percentiles,
    root_mean_square,
    similarity,
)
from eitskin.training.method.observations import Observations
from eitskin.training.method.predictions import Predictions
from eitskin.training.method.targets import STATE_NAMES, with_implied_labels
from eitskin.training.paper.method import PaperMethod
from eitskin.training.pipeline.pipeline import Pipeline

__all__ = ["Evaluation", "Report", "TouchScore", "evaluate"]

TIMED_FRAMES = 300
PIECE = 512  # frames at once

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class Evaluation:
    """A pipeline, n frames, the predictions for the frames, and the report.

    Attributes:
        pipeline: the pipeline, unchanged.
        dataset: n frames.
        predictions: estimates for the frames, each by itself.
        matches: found touches matched to the true ones.
        similarity: SSIM of each frame's images (n,), by image: "touch_map" and, for a method that
            reconstructs, "static" and "dynamic"; and "empty", the SSIM of an image of zeros. NaN
            in untouched frames and where a radius is not known. Empty for a pipeline that does not
            estimate touches.
        report: the figures.
    """

    pipeline: Pipeline
    dataset: Dataset
    predictions: Predictions
    matches: Matches
    similarity: dict[str, Array]
    report: Report

    @classmethod
    def of(cls, pipeline: Pipeline, dataset: Dataset) -> "Evaluation":
        """Evaluation of a pipeline on all frames of a dataset.

        Frames count one by one: the static reference is the specimen's flat reference, the dynamic
        one the frame's own `touch_reference`, as a session would hold it. A touch in a frame whose
        state is not estimated as touch counts as missed.

        Raises DataError for a dataset without frames, with other measurements than the pipeline's,
        or with touches far off the sensor.
        """
        if len(dataset) == 0:
            raise DataError("expected frames to evaluate on, got no frames; name another dataset")
        if dataset.protocol is None:
            raise DataError(
                "expected a dataset that names its protocol, got one without; import it again "
                "with --protocol"
            )
        pipeline.layout.require_same_measurements(dataset.protocol, dataset.frequency)
        require_on_sheet(dataset, pipeline.layout.outline)
        dataset, targets = with_implied_labels(dataset), pipeline.targets
        predictions = _perceive(pipeline, dataset)
        matches = Matches.of(dataset, predictions)
        located = targets.touches
        similarity = _similarities(pipeline, dataset, predictions) if located else {}
        report = Report(
            len(dataset),
            _state_score(dataset, predictions, targets.states),
            _bend_score(dataset, predictions),
            _touch_scores(dataset, matches, similarity) if located else {},
            _untouched_score(dataset, matches) if located else None,
            _force_score(matches),
            consistency(matches.error, matches.deviation),
            _latency(pipeline, dataset),
            targets,
        )
        return cls(pipeline, dataset, predictions, matches, similarity, report)


def require_on_sheet(dataset: Dataset, outline: tuple[float, float]) -> None:
    """Check that touches lie within twice the length of the sensor; raises DataError."""
    for name, places in (("x", dataset.touch_x), ("y", dataset.touch_y)):
        known = places[np.isfinite(places)]
        if len(known) and np.abs(known).max() > 2.0 * max(outline):
            raise DataError(
                f"touches of the dataset lie at {name} = {known.min():g} to {known.max():g} m, the "
                f"pipeline's sensor is {outline[0]:g} by {outline[1]:g} m; give positions in "
                "metres from the sensor's corner"
            )


def evaluate(pipeline: Pipeline, dataset: Dataset) -> Report:
    """Report of `Evaluation.of`."""
    return Evaluation.of(pipeline, dataset).report


def contact_maps(
    dataset: Dataset, pipeline: Pipeline, shape: tuple[int, ...]
) -> NDArray[np.float32]:
    """True contact maps (n, rows, columns) of touched frames, 0 to 1."""
    discs = (dataset.touch_x, dataset.touch_y, dataset.touch_radius)
    return touch_maps(*discs, pipeline.layout.outline, (shape[-2], shape[-1]))


def drawable(dataset: Dataset) -> NDArray[np.intp]:
    """Numbers of the frames with touches, all of known position and radius."""
    placed = np.isfinite(dataset.touch_x)
    known = (np.isfinite(dataset.touch_radius) | ~placed).all(axis=1)
    return np.flatnonzero(placed.any(axis=1) & known)


def reconstructions(pipeline: Pipeline, dataset: Dataset) -> dict[str, NDArray[np.float32]]:
    """Reconstructions (n, rows, columns) with either reference, positive for lower conductivity.

    Empty for a method without reconstructions.
    """
    if not isinstance(pipeline.method, PaperMethod):
        return {}
    static, dynamic = pipeline.method.reconstructions(Observations.of(dataset))
    return {"static": -static, "dynamic": -dynamic}


def _perceive(pipeline: Pipeline, dataset: Dataset) -> Predictions:
    """Predictions in pieces of `PIECE` frames, which bounds the memory for feature maps."""
    starts = range(0, len(dataset), PIECE)
    return Predictions.joined(
        [pipeline.perceive(dataset.select(slice(start, start + PIECE))) for start in starts]
    )


def _similarities(
    pipeline: Pipeline, dataset: Dataset, predictions: Predictions
) -> dict[str, Array]:
    """SSIM of every image, in pieces; see `Evaluation`."""
    values: dict[str, Array] = {}
    chosen = drawable(dataset)
    for start in range(0, len(chosen), PIECE):
        piece = chosen[start : start + PIECE]
        frames = dataset.select(piece)
        truth = contact_maps(frames, pipeline, predictions.touch_map.shape)
        pictures = {"touch_map": predictions.touch_map[piece], **reconstructions(pipeline, frames)}
        pictures["empty"] = np.zeros_like(truth)
        for name, maps in pictures.items():
            pairs = zip(maps, truth, strict=True)
            row = values.setdefault(name, np.full(len(dataset), np.nan))
            row[piece] = [similarity(*pair) for pair in pairs]
    return values


def _state_score(
    dataset: Dataset, predictions: Predictions, told_apart: tuple[str, ...]
) -> StateScore:
    """Score of the frames whose true state is one that the pipeline tells apart."""
    known = np.isin(dataset.state, [STATE_NAMES.index(name) for name in told_apart])
    counts = confusion(dataset.state[known], predictions.state[known])
    bent = known & (dataset.state == State.TOUCH) & _bent(dataset)
    right = predictions.state == dataset.state
    idle = counts[State.IDLE]
    return StateScore(
        {
            name: _share(row[i], row.sum())
            for i, (name, row) in enumerate(zip(STATE_NAMES, counts, strict=True))
        },
        _share(right[bent].sum(), bent.sum()),
        _share(idle[State.TOUCH], idle.sum()),
        counts.tolist(),
        int(np.isin(dataset.state, list(State)).sum() - known.sum()),
    )


def _bend_score(dataset: Dataset, predictions: Predictions) -> BendScore:
    known = np.isfinite(dataset.bend_angle_deg) & np.isfinite(predictions.bend_angle_deg)
    bent, touched = (known & (dataset.state == state) for state in (State.BEND, State.TOUCH))
    true, estimated = dataset.bend_angle_deg.astype(float), predictions.bend_angle_deg
    error = estimated - true

    def size_and_bias(mask: Mask) -> tuple[float | None, float | None]:
        errors = error[mask]
        return (root_mean_square(errors), float(errors.mean())) if errors.size else (None, None)

    return BendScore(
        determination(true[bent], estimated[bent]) if bent.any() else None,
        *size_and_bias(bent),
        *size_and_bias(touched),
        consistency(error, predictions.bend_deviation_deg),
    )


def _touch_scores(
    dataset: Dataset, matches: Matches, similarity: dict[str, Array]
) -> dict[str, TouchScore]:
    """Scores of the groups of frames that `Report` names, without empty ones."""
    counts = dataset.touch_count
    groups = {str(n): counts == n for n in range(1, dataset.touch_x.shape[1] + 1)}
    groups |= {"several": counts > 1, "bent": (counts > 0) & _bent(dataset)}
    return {
        name: _touch_score(group, counts, matches, similarity)
        for name, group in groups.items()
        if group.any()
    }


def _touch_score(
    group: Mask, counts: NDArray[np.int64], matches: Matches, similarity: dict[str, Array]
) -> TouchScore:
    """Score of the frames of a mask (n,)."""
    errors = matches.error[group[matches.frame]] * 1e3
    some = errors.size > 0
    true = int(counts[group].sum())
    drawn = {name: values[group & np.isfinite(values)] for name, values in similarity.items()}
    return TouchScore(
        int(group.sum()),
        float(errors.mean()) if some else None,
        float(errors.std()) if some else None,
        float(np.median(errors)) if some else None,
        float(np.percentile(errors, 95)) if some else None,
        errors.size / true,
        int(matches.false[group].sum()) / true,
        {name: float(values.mean()) for name, values in drawn.items() if values.size},
    )


def _untouched_score(dataset: Dataset, matches: Matches) -> UntouchedScore | None:
    untouched = np.isin(dataset.state, (State.IDLE, State.BEND))
    if not untouched.any():
        return None
    false = matches.false[untouched]
    return UntouchedScore(int(untouched.sum()), float(np.mean(false > 0)), int(false.sum()))


def _force_score(matches: Matches) -> ForceScore | None:
    error = matches.found_force - matches.true_force
    error = error[np.isfinite(error)]
    if not error.size:
        return None
    return ForceScore(len(error), float(np.abs(error).mean()), float(error.mean()))


def _latency(pipeline: Pipeline, dataset: Dataset) -> LatencyScore:
    """Latency of `process` in a session of one specimen."""
    pipeline.reset()
    seconds = []
    for frame in _session(dataset, pipeline.layout.protocol):
        start = time.perf_counter()
        pipeline.process(frame)
        seconds.append(time.perf_counter() - start)
    pipeline.reset()
    p50, p99 = percentiles(seconds[1:])
    return LatencyScore(p50 * 1e3, p99 * 1e3)


def _session(dataset: Dataset, protocol: Protocol) -> list[Frame]:
    """Session of one specimen: its flat reference, then some of its frames."""
    mine = np.flatnonzero(dataset.specimen == dataset.specimen[0])[:TIMED_FRAMES]
    values = [dataset.reference[dataset.specimen[0]], *dataset.impedance[mine]]
    return [
        Frame(value.astype(np.complex128), protocol, 0.1 * n, n, 0, dataset.frequency)
        for n, value in enumerate(values)
    ]


def _bent(dataset: Dataset) -> Mask:
    bent: Mask = np.abs(dataset.bend_angle_deg) > 0
    return bent


def _share(part: int, whole: int) -> float | None:
    return float(part) / float(whole) if whole else None
