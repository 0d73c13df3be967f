"""What `evaluate` measures of a pipeline; every figure by a stated definition."""

from dataclasses import asdict, dataclass
from typing import Any

from eitskin.training.evaluation.metrics import Consistency

SSIM_DEFINITION = (
    "SSIM: scikit-image's structural_similarity with its 7 x 7 window and data_range 1, between a "
    "picture scaled to its own maximum, values below zero taken as zero, and the true contact map, "
    "discs of the indenter's radius; the mean over the frames."
)
"""Belongs beside every figure of it; see metrics.similarity."""


@dataclass(frozen=True, slots=True)
class StateScore:
    """States told apart.

    Attributes:
        accuracy: per true state, None where the dataset has none.
        bent_touch_accuracy: of touches on a bent sensor alone.
        idle_as_touch: share of the idle frames that are taken for touched.
        confusion: counts, rows the true and columns the estimated state: idle, touch, bend.
    """

    accuracy: dict[str, float | None]
    bent_touch_accuracy: float | None
    idle_as_touch: float | None
    confusion: list[list[int]]


@dataclass(frozen=True, slots=True)
class BendScore:
    """Bend angles of bent frames and of touched ones; None where there are none.

    Attributes:
        r2, rmse_deg, bias_deg: of bent, untouched frames.
        touched_rmse_deg, touched_bias_deg: of touched frames, flat and bent.
        calibration: of the stated standard errors, all frames; None where none is stated.
    """

    r2: float | None
    rmse_deg: float | None
    bias_deg: float | None
    touched_rmse_deg: float | None
    touched_bias_deg: float | None
    calibration: Consistency | None


@dataclass(frozen=True, slots=True)
class TouchScore:
    """Touches found in a group of touched frames.

    Attributes:
        frames: how many there are.
        mean_error_mm, deviation_mm: of matched touches, with the standard deviation.
        median_error_mm, p95_error_mm: of the same; the 95th percentile.
        found: share of the true touches that were matched.
        false_per_touch: found touches that match none, per true touch.
        ssim: of the picture with the static and the dynamic reference, of the touch map, and of
            an empty picture.
    """

    frames: int
    mean_error_mm: float | None
    deviation_mm: float | None
    median_error_mm: float | None
    p95_error_mm: float | None
    found: float
    false_per_touch: float
    ssim: dict[str, float]


@dataclass(frozen=True, slots=True)
class UntouchedScore:
    """Touches found where there are none.

    Attributes:
        frames: idle and bent ones.
        touched: share of them in which any touch was found.
        touches: how many touches were found in all of them.
    """

    frames: int
    touched: float
    touches: int


@dataclass(frozen=True, slots=True)
class ForceScore:
    """Forces of matched touches, where the truth and the method both say one.

    Attributes:
        touches: how many.
        mean_error_n, bias_n: mean of the absolute and of the signed error [N].
    """

    touches: int
    mean_error_n: float
    bias_n: float


@dataclass(frozen=True, slots=True)
class LatencyScore:
    """Time of `Pipeline.process` per frame [ms], on one thread."""

    p50_ms: float
    p99_ms: float


@dataclass(frozen=True, slots=True)
class Report:
    """Everything that `evaluate` measures.

    Attributes:
        frames: how many.
        states, bend, latency: see their classes.
        touches: of frames with "1" to "4" touches, with "several", and with any on a "bent" sensor.
        untouched: None without such frames.
        force: None where forces are not known or not estimated.
        place_calibration: of the stated standard errors of places; None where none is stated.
    """

    frames: int
    states: StateScore
    bend: BendScore
    touches: dict[str, TouchScore]
    untouched: UntouchedScore | None
    force: ForceScore | None
    place_calibration: Consistency | None
    latency: LatencyScore

    def as_dict(self) -> dict[str, Any]:
        """Plain data, as JSON takes it."""
        return asdict(self)
