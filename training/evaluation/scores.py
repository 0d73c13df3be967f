"""Matching of touches, metrics of estimates, and the report of all scores of a pipeline."""

from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import linear_sum_assignment

from eitskin.datasets import Dataset
from eitskin.extras import require
from eitskin.training.method.predictions import Predictions
from eitskin.training.method.targets import Targets

GATE = 0.015  # m; half of the 30 mm that the test touches are apart, so that no two can claim one

Array = NDArray[np.float64]
Rows = NDArray[np.intp]


def match_distances(true: ArrayLike, estimated: ArrayLike) -> list[float]:
    """Distances [m] of the matched pairs of one frame; see `match`."""
    rows, columns = match(true, estimated)
    away = np.linalg.norm(_positions(true)[rows] - _positions(estimated)[columns], axis=1)
    distances: list[float] = away.tolist()
    return distances


def match(true: ArrayLike, estimated: ArrayLike) -> tuple[Rows, Rows]:
    """Matched rows of `true` and of `estimated` in one frame, both positions (touches, 2) [m].

    The Hungarian method makes as many pairs closer than `GATE` as there can be and, among
    those, the pairs of the smallest total distance (Kuhn 1955).
    """
    a, b = _positions(true), _positions(estimated)
    distance = np.linalg.norm(a[:, None] - b[None], axis=2)
    # A pair beyond the gate costs more than any number of pairs within it can save.
    cost = np.where(distance <= GATE, distance, GATE * (1 + len(a) + len(b)))
    rows, columns = linear_sum_assignment(cost)
    near = distance[rows, columns] <= GATE
    return rows[near], columns[near]


def ospa(true: ArrayLike, estimated: ArrayLike, cutoff: float = GATE) -> float:
    """OSPA distance [m] of the true and found positions of one frame (touches, 2) [m].

    Optimal subpattern assignment of order 1 (Schuhmacher et al. 2008): the mean distance of the
    best assignment, distances above `cutoff` [m] and touches without a partner counting as
    `cutoff`. 0 where there is neither a true nor a found touch.
    """
    a, b = _positions(true), _positions(estimated)
    most = max(len(a), len(b))
    if most == 0:
        return 0.0
    distance = np.minimum(np.linalg.norm(a[:, None] - b[None], axis=2), cutoff)
    assigned = float(distance[linear_sum_assignment(distance)].sum())
    return (assigned + cutoff * abs(len(a) - len(b))) / most


def _positions(values: ArrayLike) -> Array:
    return np.asarray(values, dtype=float).reshape(-1, 2)


@dataclass(frozen=True, slots=True, eq=False)
class Matches:
    """The m matched touches of a dataset of n frames; see `match`.

    Attributes:
        frame: index of each touch's frame (m,).
        true, found: positions (m, 2) [m].
        true_force, found_force: (m,) [N]; NaN where not known.
        deviation: standard error of the found position (m,) [m]; NaN where not stated.
        false: number of found touches without a match in each frame (n,).
    """

    frame: NDArray[np.int64]
    true: Array
    found: Array
    true_force: Array
    found_force: Array
    deviation: Array
    false: NDArray[np.int64]

    @classmethod
    def from_dataset(cls, dataset: Dataset, predictions: Predictions) -> "Matches":
        """Matches of the touches of every frame."""
        false = np.zeros(len(dataset), np.int64)
        rows: list[Array] = [np.zeros((0, 8))]
        truth = np.stack([dataset.touch_x, dataset.touch_y, dataset.touch_force], axis=2)
        for i, touches in enumerate(predictions.touches):
            true = truth[i][np.isfinite(truth[i, :, 0])].astype(float)
            a, b = match(true[:, :2], touches.place)
            false[i] = len(touches) - len(b)
            matched_touches = np.column_stack([touches.place, touches.force, touches.deviation])[b]
            rows.append(np.column_stack([np.full(len(a), i), true[a], matched_touches]))
        frame, x, y, force, found_x, found_y, found_force, deviation = np.concatenate(rows).T
        return cls(
            frame.astype(np.int64),
            np.stack([x, y], axis=1),
            np.stack([found_x, found_y], axis=1),
            force,
            found_force,
            deviation,
            false,
        )

    @property
    def error(self) -> Array:
        """Distance of each found from its true position (m,) [m]."""
        distance: Array = np.linalg.norm(self.found - self.true, axis=1)
        return distance


SSIM_DEFINITION = (
    "SSIM: scikit-image's structural_similarity with its 7 x 7 window and data_range 1, between a "
    "picture scaled to its own maximum, values below zero taken as zero, and the true contact map, "
    "discs of the indenter's radius; the mean over the frames."
)
"""Definition to be printed next to every SSIM; see `similarity`."""


@dataclass(frozen=True, slots=True)
class Consistency:
    """Agreement of errors with their stated standard errors.

    Attributes:
        count: number of errors that come with a standard error.
        rms_ratio: root mean square of error / standard error; 1 for standard errors that are
            right, more for those that are too small.
        within_one: share of errors within one standard error; of normal errors 0.683 in one
            dimension, and 0.632 (round) to 0.683 (long and thin) of distances in two.
    """

    count: int
    rms_ratio: float
    within_one: float


@dataclass(frozen=True, slots=True)
class StateScore:
    """Classification of the state.

    Attributes:
        accuracy: share of correct frames by true state; None for a state without frames.
        bent_touch_accuracy: the same of touches on a bent sensor.
        idle_as_touch: share of the idle frames that are classified as touch.
        confusion: confusion matrix, rows the true and columns the estimated state: idle, touch,
            bend.
        left_out: number of frames of a state that the pipeline does not show apart.
    """

    accuracy: dict[str, float | None]
    bent_touch_accuracy: float | None
    idle_as_touch: float | None
    confusion: list[list[int]]
    left_out: int = 0


@dataclass(frozen=True, slots=True)
class BendScore:
    """Errors of the bend angle; None without frames of the kind.

    Attributes:
        r2, rmse_deg, bias_deg: coefficient of determination, root mean square and mean error
            [deg] of bent, untouched frames.
        touched_rmse_deg, touched_bias_deg: the errors [deg] of touched frames, flat and bent.
        calibration: consistency of the standard errors of all frames; None without any.
    """

    r2: float | None
    rmse_deg: float | None
    bias_deg: float | None
    touched_rmse_deg: float | None
    touched_bias_deg: float | None
    calibration: Consistency | None


@dataclass(frozen=True, slots=True)
class TouchScore:
    """Localisation of the touches in a group of touched frames.

    Attributes:
        frames: number of frames.
        mean_error_mm, deviation_mm: mean and standard deviation of the distances between matched
            positions [mm]; None without matches.
        median_error_mm, p95_error_mm: median and 95th percentile of the distances [mm].
        found: share of the true touches that were matched.
        false_per_touch: detected touches without a match, per true touch.
        ssim: mean SSIM of the reconstructions with the static and the dynamic reference, of the
            touch map, and of an image of zeros.
        guess_error_mm: mean distance of the true positions from their mean [mm].
    """

    frames: int
    mean_error_mm: float | None
    deviation_mm: float | None
    median_error_mm: float | None
    p95_error_mm: float | None
    found: float
    false_per_touch: float
    ssim: dict[str, float]
    guess_error_mm: float


@dataclass(frozen=True, slots=True)
class UntouchedScore:
    """False touches in untouched frames.

    Attributes:
        frames: number of idle and bent frames.
        touched: share of these frames with a false touch.
        touches: number of false touches.
    """

    frames: int
    touched: float
    touches: int


@dataclass(frozen=True, slots=True)
class ForceScore:
    """Errors of the forces of matched touches with a true and an estimated force.

    Attributes:
        touches: number of touches.
        mean_error_n, bias_n: mean of the absolute and of the signed error [N].
    """

    touches: int
    mean_error_n: float
    bias_n: float


@dataclass(frozen=True, slots=True)
class LatencyScore:
    """Median and 99th percentile of the time of `Pipeline.process` per frame [ms]."""

    p50_ms: float
    p99_ms: float


@dataclass(frozen=True, slots=True)
class Report:
    """All scores of an evaluation.

    Attributes:
        frames: number of frames.
        states, bend, latency: scores of all frames; None inside where the pipeline does not
            estimate them.
        touches: touches of frames with "1" to "4" touches, with "several", and with any on a "bent"
            sensor.
        untouched: scores of untouched frames; None without any.
        force: None for forces that are not known or not estimated.
        place_calibration: consistency of the standard errors of positions; None without any.
        estimates: quantities that the pipeline estimates; only these are tested.

    Example:
        >>> from eitskin.training import evaluate
        >>> evaluate(pipeline, dataset).bend.rmse_deg  # doctest: +SKIP
    """

    frames: int
    states: StateScore
    bend: BendScore
    touches: dict[str, TouchScore]
    untouched: UntouchedScore | None
    force: ForceScore | None
    place_calibration: Consistency | None
    latency: LatencyScore
    estimates: Targets = field(default_factory=Targets)

    def as_dict(self) -> dict[str, Any]:
        """The report as JSON takes it."""
        return {**asdict(self), "estimates": self.estimates.as_dict()}


def similarity(picture: ArrayLike, truth: ArrayLike) -> float:
    """Structural similarity (SSIM) of a picture, scaled to its maximum, and the true contact map.

    scikit-image's structural_similarity with data_range 1 and its 7 x 7 window. Both are
    (rows, columns); the truth is drawn as discs of the indenter's radius, 0 to 1. Values of the
    picture below zero are no touch and count as zero.
    """
    skimage_metrics = require("skimage.metrics", "training")
    shown = np.maximum(np.asarray(picture, dtype=float), 0.0)
    if shown.max() > 0:
        shown = shown / shown.max()
    return float(
        skimage_metrics.structural_similarity(shown, np.asarray(truth, dtype=float), data_range=1.0)
    )


def root_mean_square(errors: ArrayLike) -> float:
    """Root mean square, in the unit of the errors."""
    return float(np.sqrt(np.mean(np.square(np.asarray(errors, dtype=float)))))


def consistency(errors: ArrayLike, deviations: ArrayLike) -> Consistency | None:
    """Consistency of errors (n,) with standard errors (n,); None where none of these is stated.

    An error of position is a distance, and its standard error is sqrt(var x + var y), the root
    mean square of that distance.
    """
    error, deviation = (np.asarray(values, dtype=float) for values in (errors, deviations))
    stated = np.isfinite(error) & np.isfinite(deviation) & (deviation > 0)
    if not stated.any():
        return None
    ratio = np.abs(error[stated]) / deviation[stated]
    return Consistency(len(ratio), root_mean_square(ratio), float(np.mean(ratio <= 1)))


def determination(true: ArrayLike, estimated: ArrayLike) -> float | None:
    """Coefficient of determination R2; None where `true` does not vary, or is empty."""
    truth = np.asarray(true, dtype=float)
    if not truth.size:
        return None
    variance = float(np.sum((truth - truth.mean()) ** 2))
    error = float(np.sum((truth - np.asarray(estimated, dtype=float)) ** 2))
    return 1.0 - error / variance if variance > 0 else None
