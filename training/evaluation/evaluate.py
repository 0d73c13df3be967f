"""Evaluation of a pipeline on a dataset: the figures of the paper, by stated definitions."""

import time
import warnings
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eitskin.datasets import Dataset, State, touch_maps
from eitskin.extras import old_names
from eitskin.geometry import DataError
from eitskin.simulator import Frame
from eitskin.training.adaptation.locator import Places
from eitskin.training.adaptation.press_fit import LabelledPresses
from eitskin.training.adaptation.touch_positions import TouchPositions
from eitskin.training.evaluation.scores import (
    BendScore,
    ForceScore,
    LatencyScore,
    Matches,
    Report,
    StateScore,
    TouchScore,
    UntouchedScore,
    consistency,
    determination,
    root_mean_square,
    similarity,
)
from eitskin.training.method.interface import Method
from eitskin.training.method.observations import Observations
from eitskin.training.method.predictions import Predictions
from eitskin.training.method.settings import POSITION_SHARE, POSITIONS, TrainingSettings
from eitskin.training.method.targets import STATE_NAMES, with_implied_labels
from eitskin.training.paper.method import PaperMethod
from eitskin.training.pipeline.pipeline import Pipeline

__all__ = ["Evaluation", "Report", "TouchScore", "evaluate"]

TIMED_FRAMES = 300
PIECE = 512  # frames at once, which bounds the memory for feature maps

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Evaluation:
    """A pipeline, n frames, the predictions for the frames, and the report.

    Attributes:
        pipeline: the pipeline, unchanged.
        dataset: n frames.
        predictions: estimates for the frames, each on its own.
        matches: detected touches matched to the true ones.
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
    def from_dataset(cls, pipeline: Pipeline, dataset: Dataset) -> "Evaluation":
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
        dataset = pipeline.mark_failures(dataset)[0]
        pieces = (slice(start, start + PIECE) for start in range(0, len(dataset), PIECE))
        predictions = Predictions.concatenate(
            [pipeline.perceive(dataset.select(p)) for p in pieces]
        )
        matches = Matches.from_dataset(dataset, predictions)
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
    """Report of `Evaluation.from_dataset`.

    Example:
        >>> from eitskin.training import evaluate
        >>> evaluate(pipeline, dataset).touches["1"].mean_error_mm  # doctest: +SKIP
    """
    return Evaluation.from_dataset(pipeline, dataset).report


def drawable(dataset: Dataset) -> NDArray[np.intp]:
    """Numbers of the frames with touches, all of known position and radius."""
    placed = np.isfinite(dataset.touch_x)
    has_label = (np.isfinite(dataset.touch_radius) | ~placed).all(axis=1)
    return np.flatnonzero(placed.any(axis=1) & has_label)


def images(
    pipeline: Pipeline, dataset: Dataset, touch_map: NDArray[np.float32]
) -> dict[str, NDArray[np.float32]]:
    """Images (n, rows, columns) of touched frames, by name.

    "truth" is the true contact map, 0 to 1; "static" and "dynamic" are the reconstructions with
    either reference of a method that makes some, positive for lower conductivity; "touch_map" are
    the estimated maps, as given.
    """
    discs = (dataset.touch_x, dataset.touch_y, dataset.touch_radius)
    rows, columns = touch_map.shape[1:]
    maps = {"truth": touch_maps(*discs, pipeline.layout.outline, (rows, columns))}
    if isinstance(pipeline.method, PaperMethod):
        static, dynamic = pipeline.method.reconstructions(Observations.from_dataset(dataset))
        maps |= {"static": -static, "dynamic": -dynamic}
    return {**maps, "touch_map": touch_map}


def _similarities(
    pipeline: Pipeline, dataset: Dataset, predictions: Predictions
) -> dict[str, Array]:
    """SSIM of every image, in pieces; see `Evaluation`."""
    values: dict[str, Array] = {}
    chosen = drawable(dataset)
    for start in range(0, len(chosen), PIECE):
        piece = chosen[start : start + PIECE]
        pictures = images(pipeline, dataset.select(piece), predictions.touch_map[piece])
        truth = pictures.pop("truth")
        for name, maps in {**pictures, "empty": np.zeros_like(truth)}.items():
            row = values.setdefault(name, np.full(len(dataset), np.nan))
            row[piece] = [similarity(*pair) for pair in zip(maps, truth, strict=True)]
    return values


def _state_score(
    dataset: Dataset, predictions: Predictions, distinguished: tuple[str, ...]
) -> StateScore:
    """Score of the frames whose true state is one that the pipeline distinguishes."""
    is_known = np.isin(dataset.state, [STATE_NAMES.index(name) for name in distinguished])
    counts = np.zeros((len(STATE_NAMES), len(STATE_NAMES)), np.int64)
    np.add.at(counts, (dataset.state[is_known].astype(int), predictions.state[is_known]), 1)
    bent = is_known & (dataset.state == State.TOUCH) & _is_bent(dataset)
    recognised = predictions.state == dataset.state
    totals = counts.sum(axis=1)
    return StateScore(
        {name: _share(counts[i, i], totals[i]) for i, name in enumerate(STATE_NAMES)},
        _share(recognised[bent].sum(), bent.sum()),
        _share(counts[State.IDLE, State.TOUCH], totals[State.IDLE]),
        counts.tolist(),
        int(np.isin(dataset.state, list(State)).sum() - is_known.sum()),
    )


def _bend_score(dataset: Dataset, predictions: Predictions) -> BendScore:
    true, estimated = dataset.bend_angle_deg.astype(float), predictions.bend_angle_deg
    error = estimated - true
    bent, touched = (
        np.isfinite(error) & (dataset.state == state) for state in (State.BEND, State.TOUCH)
    )
    return BendScore(
        determination(true[bent], estimated[bent]),
        _statistic(root_mean_square, error[bent]),
        _statistic(np.mean, error[bent]),
        _statistic(root_mean_square, error[touched]),
        _statistic(np.mean, error[touched]),
        consistency(error, predictions.bend_deviation_deg),
    )


def _touch_scores(
    dataset: Dataset, matches: Matches, similarity: dict[str, Array]
) -> dict[str, TouchScore]:
    """Scores of the groups of frames that `Report` names, without empty ones."""
    counts = dataset.touch_count
    groups = {str(n): counts == n for n in range(1, dataset.touch_x.shape[1] + 1)}
    groups |= {"several": counts > 1, "bent": (counts > 0) & _is_bent(dataset)}
    scores = {}
    for name, group in groups.items():
        if not group.any():
            continue
        errors = matches.error[group[matches.frame]] * 1e3
        true = int(counts[group].sum())
        places = np.stack([dataset.touch_x[group], dataset.touch_y[group]], axis=-1)
        places = 1e3 * places[np.isfinite(places).all(axis=-1)]
        drawn = {key: values[group & np.isfinite(values)] for key, values in similarity.items()}
        scores[name] = TouchScore(
            int(group.sum()),
            _statistic(np.mean, errors),
            _statistic(np.std, errors),
            _statistic(np.median, errors),
            _statistic(partial(np.percentile, q=95), errors),
            errors.size / true,
            int(matches.false[group].sum()) / true,
            {key: float(values.mean()) for key, values in drawn.items() if values.size},
            float(np.linalg.norm(places - places.mean(axis=0), axis=-1).mean()),
        )
    return scores


def _untouched_score(dataset: Dataset, matches: Matches) -> UntouchedScore | None:
    false = matches.false[np.isin(dataset.state, (State.IDLE, State.BEND))]
    if not false.size:
        return None
    return UntouchedScore(false.size, float(np.mean(false > 0)), int(false.sum()))


def _force_score(matches: Matches) -> ForceScore | None:
    error = matches.found_force - matches.true_force
    error = error[np.isfinite(error)]
    if not error.size:
        return None
    return ForceScore(len(error), float(np.abs(error).mean()), float(error.mean()))


def _latency(pipeline: Pipeline, dataset: Dataset) -> LatencyScore:
    """Latency of `process` in a session of one specimen: its flat reference, then its frames."""
    mine = np.flatnonzero(dataset.specimen == dataset.specimen[0])[:TIMED_FRAMES]
    values = [dataset.reference[dataset.specimen[0]], *dataset.impedance[mine]]
    protocol, frequency, seconds = pipeline.layout.protocol, dataset.frequency, []
    pipeline.reset()
    for n, value in enumerate(values):
        frame = Frame(value.astype(np.complex128), protocol, 0.1 * n, n, 0, frequency)
        start = time.perf_counter()
        pipeline.process(frame)
        seconds.append(time.perf_counter() - start)
    pipeline.reset()
    p50, p99 = (1e3 * np.percentile(seconds[1:], [50, 99])).tolist()
    return LatencyScore(p50, p99)


def _is_bent(dataset: Dataset) -> NDArray[np.bool_]:
    bent: NDArray[np.bool_] = np.abs(dataset.bend_angle_deg) > 0
    return bent


def _statistic(statistic: Callable[[Array], Any], errors: Array) -> float | None:
    """A statistic of some errors; None without any."""
    return float(statistic(errors)) if errors.size else None


def _share(part: int, whole: int) -> float | None:
    return float(part) / float(whole) if whole else None


@old_names(of="from_dataset")
@dataclass(frozen=True, slots=True)
class PositionScore:
    """Errors of estimated positions.

    Attributes:
        frames: number of frames.
        mean_error_mm, median_error_mm: mean and median distance from the true position [mm].
        guess_error_mm: mean distance of the mean training position from the true one [mm].
        error_ratio: root mean square of error over standard error; None without standard errors.
        faults: electrodes that failed, in words.

    Example:
        >>> from eitskin.training import PositionScore
        >>> PositionScore(100, 1.5, 1.2, 47.3).mean_error_mm
        1.5
    """

    frames: int
    mean_error_mm: float
    median_error_mm: float
    guess_error_mm: float
    error_ratio: float | None = None
    faults: tuple[str, ...] = ()

    @classmethod
    def from_dataset(cls, pipeline: Pipeline, dataset: Dataset) -> "PositionScore":
        """Score on the held-out frames of `dataset`; raises DataError where there are none."""
        true, places = held_out_positions(pipeline, dataset)
        error = np.linalg.norm(places.place - true, axis=1)
        guess = np.linalg.norm(_method(pipeline).locator.centre - true, axis=1)
        values = (error.mean(), np.median(error), guess.mean())
        mean, middle, guessed = (1e3 * float(value) for value in values)
        over = float(np.sqrt(np.mean((error / places.deviation) ** 2)))
        faults = pipeline.mark_failures(dataset)[1]
        ratio = None if np.isnan(over) else over
        return cls(len(true), mean, middle, guessed, ratio, faults)

    @property
    def warnings(self) -> tuple[str, ...]:
        """Reasons not to believe in the estimates, a sentence each."""
        few = []
        if self.frames < 10:
            few.append(f"too few touches were held out ({self.frames}) to know the error")
        if self.mean_error_mm > 0.8 * self.guess_error_mm:
            few.append(
                f"the mean error of {self.mean_error_mm:.0f} mm is not clearly below the "
                f"{self.guess_error_mm:.0f} mm of always guessing the mean position"
            )
        remedy = "record presses at 50 places or more, all over the sensor"
        return tuple(f"{each}; {remedy}" for each in few)

    def as_dict(self) -> dict[str, Any]:
        """Plain data for JSON."""
        return asdict(self)


def held_out_positions(pipeline: Pipeline, dataset: Dataset) -> tuple[Array, Places]:
    """True (k, 2) [m] and estimated positions in the held-out frames of `dataset`.

    Raises DataError where no frame is held out, or for a pipeline of another method, and FrameError
    for a dataset of another protocol, where both are known.
    """
    locator, protocol = _method(pipeline).locator, dataset.protocol
    if pipeline.layout.known_protocol is not None and protocol is not None:
        pipeline.layout.require_same_measurements(protocol, pipeline.layout.frequency)
    frames = pipeline.held_out(dataset)
    if len(frames) == 0:
        raise DataError(
            "expected frames with exactly one touch to evaluate on, got none; record more"
        )
    presses = LabelledPresses.from_dataset(dataset, frames, pipeline.usual)
    return presses.places, locator.locate(presses.ratios)[0]


def _method(pipeline: Pipeline) -> TouchPositions:
    if not isinstance(pipeline.method, TouchPositions):
        raise DataError(
            f"expected a pipeline of touch positions, got one of the method "
            f"'{pipeline.method.KIND}'; evaluate it with eitskin.training.evaluate"
        )
    return pipeline.method


_DEPRECATION_MESSAGE = (
    "RecordedTouches is deprecated; use Pipeline, with TrainingSettings('touch position') to fit"
)

_FORMER: dict[str, Callable[[Pipeline], Any]] = {
    "protocol": lambda pipeline: pipeline.layout.known_protocol,
    "design": lambda pipeline: pipeline.layout.known_design,
    "frequency": lambda pipeline: pipeline.layout.frequency,
    "extent": lambda pipeline: pipeline.layout.extent,
    "described": lambda pipeline: pipeline.layout.complete_dataset,
    "require_same_measurements": lambda pipeline: pipeline.layout.require_same_measurements,
    "position": lambda pipeline: _method(pipeline).locator,
    "still": lambda pipeline: pipeline.noise,
}


class RecordedTouches(Pipeline):
    """Deprecated name of a `Pipeline` of the method "touch position".

    Example:
        >>> from eitskin.training import Pipeline, RecordedTouches
        >>> issubclass(RecordedTouches, Pipeline)
        True
    """

    KIND = POSITIONS

    @classmethod
    def fit(cls, dataset: Dataset, share: float = POSITION_SHARE) -> "RecordedTouches":  # type: ignore[override]
        """`Pipeline.fit` with `TrainingSettings("touch position", options={"share": share})`."""
        warnings.warn(_DEPRECATION_MESSAGE, DeprecationWarning, stacklevel=2)
        return super().fit(dataset, TrainingSettings(POSITIONS, options={"share": share}))

    @classmethod
    def load(cls, path: str | Path, method: type[Method] | None = None) -> "RecordedTouches":
        """`Pipeline.load`."""
        warnings.warn(_DEPRECATION_MESSAGE, DeprecationWarning, stacklevel=2)
        return super().load(path, method)

    def __getattr__(self, name: str) -> Any:
        """Attributes that the class had before it was a `Pipeline`."""
        if name not in _FORMER:
            raise AttributeError(f"'{type(self).__name__}' has no attribute '{name}'")
        return _FORMER[name](self)

    def found(self, dataset: Dataset) -> tuple[Array, Array]:
        """`held_out_positions`, (k, 2) [m] each."""
        true, estimated = held_out_positions(self, dataset)
        return true, estimated.place

    def evaluate(self, dataset: Dataset) -> PositionScore:
        """`PositionScore.from_dataset`."""
        return PositionScore.from_dataset(self, dataset)
