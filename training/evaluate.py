"""How good a pipeline is on a dataset: the figures of the paper, by stated definitions."""

import time
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eitskin.datasets import Dataset, State, touch_maps
from eitskin.geometry import DataError
from eitskin.simulator import Frame, Protocol
from eitskin.training import metrics
from eitskin.training.observed import Observed
from eitskin.training.paper import PaperMethod
from eitskin.training.perceived import Perceived
from eitskin.training.pipeline import Pipeline

TIMED_FRAMES = 300
PIECE = 512  # frames at once


@dataclass(frozen=True, slots=True)
class StateScore:
    """States told apart.

    Attributes:
        accuracy: per true state, None where the dataset has none.
        bent_touch_accuracy: of touches on a bent sensor alone.
        confusion: counts, rows the true and columns the estimated state: idle, touch, bend.
    """

    accuracy: dict[str, float | None]
    bent_touch_accuracy: float | None
    confusion: list[list[int]]


@dataclass(frozen=True, slots=True)
class BendScore:
    """Bend angles of bent frames and of touched ones.

    Attributes:
        r2, rmse_deg: of bent, untouched frames.
        touched_rmse_deg: of touched frames, flat and bent.
    """

    r2: float | None
    rmse_deg: float | None
    touched_rmse_deg: float | None


@dataclass(frozen=True, slots=True)
class TouchScore:
    """Touches found in frames that have a certain number of them.

    Attributes:
        frames: how many there are.
        mean_error_mm, deviation_mm: of matched touches.
        found: share of the true touches that were matched.
        false_per_touch: found touches that match none, per true touch.
        ssim: of the picture with the static and the dynamic reference, and of the touch map.
    """

    frames: int
    mean_error_mm: float | None
    deviation_mm: float | None
    found: float
    false_per_touch: float
    ssim: dict[str, float]


@dataclass(frozen=True, slots=True)
class LatencyScore:
    """Time of `Pipeline.process` per frame [ms], on one thread."""

    p50_ms: float
    p99_ms: float


@dataclass(frozen=True, slots=True)
class Report:
    """Everything that `evaluate` measures; see metrics.py for the definitions."""

    frames: int
    states: StateScore
    bend: BendScore
    touches: dict[str, TouchScore]
    latency: LatencyScore

    def as_dict(self) -> dict[str, Any]:
        """Plain data, as JSON takes it."""
        return asdict(self)


def evaluate(pipeline: Pipeline, dataset: Dataset) -> Report:
    """Measure `pipeline` on all frames of `dataset`.

    Frames count one by one: each is compared with its specimen's flat reference and with its own
    `touch_reference`, which is what the dynamic reference of a session would hold. Touches are
    those the pipeline gives out, so a touch whose state was not recognised counts as missed.

    Raises DataError for a dataset without frames, or of other measurements than the pipeline's.
    """
    layout = pipeline.layout
    if len(dataset) == 0:
        raise DataError("there are no frames to evaluate on")
    if dataset.protocol != layout.protocol:
        raise DataError(
            f"the pipeline was trained for {len(layout.protocol)} measurements, the dataset has "
            "others; evaluate on a dataset of the same sensor"
        )
    perceived = _perceive(pipeline, dataset)
    return Report(
        len(dataset),
        _state_score(dataset, perceived),
        _bend_score(dataset, perceived),
        _touch_scores(pipeline, dataset, perceived),
        _latency(pipeline, dataset),
    )


def _perceive(pipeline: Pipeline, dataset: Dataset) -> Perceived:
    """In pieces: the maps inside a network take memory."""
    starts = range(0, len(dataset), PIECE)
    return Perceived.joined(
        [pipeline.perceive(dataset.select(slice(start, start + PIECE))) for start in starts]
    )


def _state_score(dataset: Dataset, perceived: Perceived) -> StateScore:
    known = np.isin(dataset.state, list(State))
    counts = metrics.confusion(dataset.state[known], perceived.state[known])
    bent = (dataset.state == State.TOUCH) & (np.abs(dataset.bend_angle_deg) > 0)
    right = perceived.state == dataset.state
    return StateScore(
        {
            name: _share(row[i], row.sum())
            for i, (name, row) in enumerate(zip(metrics.STATES, counts, strict=True))
        },
        _share(right[bent].sum(), bent.sum()),
        counts.tolist(),
    )


def _bend_score(dataset: Dataset, perceived: Perceived) -> BendScore:
    known = np.isfinite(dataset.bend_angle_deg)
    bent, touched = (known & (dataset.state == state) for state in (State.BEND, State.TOUCH))
    true, estimated = dataset.bend_angle_deg.astype(float), perceived.bend_angle_deg
    error = estimated - true
    return BendScore(
        metrics.determination(true[bent], estimated[bent]) if bent.any() else None,
        metrics.root_mean_square(error[bent]) if bent.any() else None,
        metrics.root_mean_square(error[touched]) if touched.any() else None,
    )


def _touch_scores(
    pipeline: Pipeline, dataset: Dataset, perceived: Perceived
) -> dict[str, TouchScore]:
    """Scores by the number of touches, "1" to "4", and of all frames with several."""
    counts = dataset.touch_count
    groups = {str(n): counts == n for n in range(1, dataset.touch_x.shape[1] + 1)}
    groups["several"] = counts > 1
    return {
        name: _touch_score(pipeline, dataset, perceived, np.flatnonzero(group))
        for name, group in groups.items()
        if group.any()
    }


def _touch_score(
    pipeline: Pipeline,
    dataset: Dataset,
    perceived: Perceived,
    frames: NDArray[np.int64],
) -> TouchScore:
    pairs = []
    for i in frames:
        true = np.stack([dataset.touch_x[i], dataset.touch_y[i]], axis=1)
        pairs.append((true[np.isfinite(true[:, 0])], perceived.touches[i].place))
    score = metrics.localisation(pairs)
    errors = np.array(score.errors) * 1e3
    return TouchScore(
        len(frames),
        float(errors.mean()) if errors.size else None,
        float(errors.std()) if errors.size else None,
        errors.size / score.true,
        score.false / score.true,
        _similarities(pipeline, dataset, perceived, frames),
    )


def _similarities(
    pipeline: Pipeline,
    dataset: Dataset,
    perceived: Perceived,
    frames: NDArray[np.int64],
) -> dict[str, float]:
    """Mean SSIM of the three pictures; a touch lowers the conductivity, hence the minus."""
    if not np.isfinite(dataset.touch_radius[frames]).any(axis=1).all():
        return {}
    chosen = dataset.select(frames)
    shape = perceived.touch_map.shape[1:]
    truth = touch_maps(
        chosen.touch_x,
        chosen.touch_y,
        chosen.touch_radius,
        pipeline.layout.outline,
        (shape[0], shape[1]),
    )
    pictures = {"touch_map": perceived.touch_map[frames]}
    if isinstance(pipeline.method, PaperMethod):
        static, dynamic = pipeline.method.pictures(Observed.of(chosen))
        pictures |= {"static": -static, "dynamic": -dynamic}
    return {
        name: float(np.mean([metrics.similarity(*pair) for pair in zip(maps, truth, strict=True)]))
        for name, maps in pictures.items()
    }


def _latency(pipeline: Pipeline, dataset: Dataset) -> LatencyScore:
    """Time `process` on frames of one specimen as they come, after its flat reference."""
    pipeline.reset()
    seconds = []
    for frame in _session(dataset, pipeline.layout.protocol):
        start = time.perf_counter()
        pipeline.process(frame)
        seconds.append(time.perf_counter() - start)
    pipeline.reset()
    p50, p99 = metrics.percentiles(seconds[1:])
    return LatencyScore(p50 * 1e3, p99 * 1e3)


def _session(dataset: Dataset, protocol: Protocol) -> list[Frame]:
    """A session: the flat reference of one specimen and some of its frames, numbered on."""
    mine = np.flatnonzero(dataset.specimen == dataset.specimen[0])[:TIMED_FRAMES]
    values = [dataset.reference[dataset.specimen[0]], *dataset.impedance[mine]]
    return [
        Frame(value.astype(np.complex128), protocol, 0.1 * n, n, 0, dataset.frequency)
        for n, value in enumerate(values)
    ]


def _share(part: int, whole: int) -> float | None:
    return float(part) / float(whole) if whole else None
