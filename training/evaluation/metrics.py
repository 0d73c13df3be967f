"""How good an estimate is: localisation, picture similarity, bend angle, state, latency."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import linear_sum_assignment

from eitskin.extras import require

GATE = 0.015  # m; half of the 30 mm that the test touches are apart, so that no two can claim one
STATES = ("idle", "touch", "bend")

Places = NDArray[np.float64]
Rows = NDArray[np.intp]


@dataclass(frozen=True, slots=True)
class Localisation:
    """How well touches were found.

    Attributes:
        errors: distances of matched touches [m].
        missed: true touches that nothing was matched to.
        false: found touches that match no true one.
    """

    errors: tuple[float, ...]
    missed: int
    false: int

    @property
    def true(self) -> int:
        """How many touches there were."""
        return len(self.errors) + self.missed


def localisation(frames: Iterable[tuple[ArrayLike, ArrayLike]], gate: float = GATE) -> Localisation:
    """Match the found places of each frame to its true places; both (touches, 2) [m].

    The Hungarian method makes as many pairs closer than `gate` as there can be and, among those,
    the pairs of the smallest total distance.
    """
    errors: list[float] = []
    missed = false = 0
    for true, found in frames:
        distances = match_distances(true, found, gate)
        errors += distances
        missed += len(_places(true)) - len(distances)
        false += len(_places(found)) - len(distances)
    return Localisation(tuple(errors), missed, false)


def match_distances(true: ArrayLike, found: ArrayLike, gate: float = GATE) -> list[float]:
    """Distances [m] of the matched pairs of one frame; see `localisation`."""
    rows, columns = match(true, found, gate)
    return [float(d) for d in np.linalg.norm(_places(true)[rows] - _places(found)[columns], axis=1)]


def match(true: ArrayLike, found: ArrayLike, gate: float = GATE) -> tuple[Rows, Rows]:
    """Rows of `true` and of `found` that belong together in one frame; see `localisation`."""
    a, b = _places(true), _places(found)
    distance = np.linalg.norm(a[:, None] - b[None], axis=2)
    # A pair beyond the gate costs more than any number of pairs within it can save.
    cost = np.where(distance <= gate, distance, gate * (1 + len(a) + len(b)))
    rows, columns = linear_sum_assignment(cost)
    near = distance[rows, columns] <= gate
    return rows[near], columns[near]


def _places(values: ArrayLike) -> Places:
    return np.asarray(values, dtype=float).reshape(-1, 2)


def similarity(picture: ArrayLike, truth: ArrayLike) -> float:
    """SSIM between a picture scaled to its own maximum and the true contact map.

    scikit-image's structural_similarity with data_range 1 and its 7 x 7 window; the truth is drawn
    as discs of the indenter's radius, 0 to 1. Values below zero are no touch and count as zero.
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
class Calibration:
    """Whether errors are as large as their stated standard errors say.

    Attributes:
        count: of errors that come with a standard error.
        rms_ratio: root mean square of error / standard error; 1 where they are stated truly, more
            where an estimate is surer than it should be.
        within_one: share of errors within one standard error; of normal errors 0.683 in one
            dimension, and 0.632 (round) to 0.683 (long and thin) of distances in two.
    """

    count: int
    rms_ratio: float
    within_one: float


def calibration(errors: ArrayLike, deviations: ArrayLike) -> Calibration | None:
    """Compare errors with their standard errors; None where none of these is stated.

    An error of place is a distance, and its standard error sqrt(var x + var y), which the distance
    has as its root mean square.
    """
    error, deviation = (np.asarray(values, dtype=float) for values in (errors, deviations))
    stated = np.isfinite(error) & np.isfinite(deviation) & (deviation > 0)
    if not stated.any():
        return None
    ratio = np.abs(error[stated]) / deviation[stated]
    return Calibration(len(ratio), root_mean_square(ratio), float(np.mean(ratio <= 1)))


def determination(true: ArrayLike, estimated: ArrayLike) -> float | None:
    """R2, the share of the variance of `true` that is explained; None where nothing varies."""
    truth = np.asarray(true, dtype=float)
    variance = float(np.sum((truth - truth.mean()) ** 2))
    error = float(np.sum((truth - np.asarray(estimated, dtype=float)) ** 2))
    return 1.0 - error / variance if variance > 0 else None


def confusion(true: ArrayLike, estimated: ArrayLike) -> NDArray[np.int64]:
    """Counts (3, 3): rows the true state, columns the estimated one, in the order of `STATES`."""
    counts = np.zeros((len(STATES), len(STATES)), np.int64)
    np.add.at(counts, (np.asarray(true, dtype=int), np.asarray(estimated, dtype=int)), 1)
    return counts


def percentiles(values: Sequence[float]) -> tuple[float, float]:
    """The median and the 99th percentile, in the unit of the values."""
    p50, p99 = np.percentile(values, [50, 99])
    return float(p50), float(p99)
