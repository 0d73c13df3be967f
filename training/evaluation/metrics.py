"""Metrics of estimates: SSIM, RMSE, R2, confusion matrix, consistency of standard errors."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eitskin.extras import require

STATES = ("idle", "touch", "bend")


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
    """Coefficient of determination R2; None where `true` does not vary."""
    truth = np.asarray(true, dtype=float)
    variance = float(np.sum((truth - truth.mean()) ** 2))
    error = float(np.sum((truth - np.asarray(estimated, dtype=float)) ** 2))
    return 1.0 - error / variance if variance > 0 else None


def confusion(true: ArrayLike, estimated: ArrayLike) -> NDArray[np.int64]:
    """Confusion matrix (3, 3): rows the true state, columns the estimated one, as in `STATES`."""
    counts = np.zeros((len(STATES), len(STATES)), np.int64)
    np.add.at(counts, (np.asarray(true, dtype=int), np.asarray(estimated, dtype=int)), 1)
    return counts


def percentiles(values: Sequence[float]) -> tuple[float, float]:
    """The median and the 99th percentile, in the unit of the values."""
    p50, p99 = np.percentile(values, [50, 99])
    return float(p50), float(p99)
