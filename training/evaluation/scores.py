"""Scores of a pipeline in an evaluation, and the report that holds them all."""

from dataclasses import asdict, dataclass, field
from typing import Any

from eitskin.training.evaluation.metrics import Consistency
from eitskin.training.method.targets import Targets

SSIM_DEFINITION = (
    "SSIM: scikit-image's structural_similarity with its 7 x 7 window and data_range 1, between a "
    "picture scaled to its own maximum, values below zero taken as zero, and the true contact map, "
    "discs of the indenter's radius; the mean over the frames."
)
"""Definition to be printed beside every SSIM; see `metrics.similarity`."""


@dataclass(frozen=True, slots=True)
class StateScore:
    """Classification of the state.

    Attributes:
        accuracy: share of correct frames by true state; None for a state without frames.
        bent_touch_accuracy: the same of touches on a bent sensor.
        idle_as_touch: share of the idle frames that are classified as touch.
        confusion: confusion matrix, rows the true and columns the estimated state: idle, touch,
            bend.
        left_out: number of frames of a state that the pipeline does not tell apart.
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
        false_per_touch: found touches without a match, per true touch.
        ssim: mean SSIM of the reconstructions with the static and the dynamic reference, of the
            touch map, and of an image of zeros.
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
        states, bend, latency: of all frames; None inside where the pipeline does not estimate
            them.
        touches: of frames with "1" to "4" touches, with "several", and with any on a "bent" sensor.
        untouched: of untouched frames; None without any.
        force: None for forces that are not known or not estimated.
        place_calibration: consistency of the standard errors of positions; None without any.
        estimates: quantities that the pipeline estimates; only these are judged.
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
