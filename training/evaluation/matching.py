"""Matching of found touches to true ones, and the errors that follow."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import linear_sum_assignment

from eitskin.datasets.store.dataset import Dataset
from eitskin.training.method.predictions import Predictions

GATE = 0.015  # m; half of the 30 mm that the test touches are apart, so that no two can claim one

Array = NDArray[np.float64]
Rows = NDArray[np.intp]


def match_distances(true: ArrayLike, found: ArrayLike, gate: float = GATE) -> list[float]:
    """Distances [m] of the matched pairs of one frame; see `match`."""
    rows, columns = match(true, found, gate)
    away = np.linalg.norm(_positions(true)[rows] - _positions(found)[columns], axis=1)
    distances: list[float] = away.tolist()
    return distances


def match(true: ArrayLike, found: ArrayLike, gate: float = GATE) -> tuple[Rows, Rows]:
    """Matched rows of `true` and of `found` in one frame, both positions (touches, 2) [m].

    The Hungarian method makes as many pairs closer than `gate` [m] as there can be and, among
    those, the pairs of the smallest total distance (Kuhn 1955).
    """
    a, b = _positions(true), _positions(found)
    distance = np.linalg.norm(a[:, None] - b[None], axis=2)
    # A pair beyond the gate costs more than any number of pairs within it can save.
    cost = np.where(distance <= gate, distance, gate * (1 + len(a) + len(b)))
    rows, columns = linear_sum_assignment(cost)
    near = distance[rows, columns] <= gate
    return rows[near], columns[near]


def ospa(true: ArrayLike, found: ArrayLike, cutoff: float = GATE) -> float:
    """OSPA distance [m] of the true and found positions of one frame (touches, 2) [m].

    Optimal subpattern assignment of order 1 (Schuhmacher et al. 2008): the mean distance of the
    best assignment, distances above `cutoff` [m] and touches without a partner counting as
    `cutoff`. 0 where there is neither a true nor a found touch.
    """
    a, b = _positions(true), _positions(found)
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
    def of(cls, dataset: Dataset, predictions: Predictions) -> "Matches":
        """Matches of the touches of every frame."""
        false = np.zeros(len(dataset), np.int64)
        rows: list[Array] = [np.zeros((0, 8))]
        truth = np.stack([dataset.touch_x, dataset.touch_y, dataset.touch_force], axis=2)
        for i, touches in enumerate(predictions.touches):
            true = truth[i][np.isfinite(truth[i, :, 0])].astype(float)
            a, b = match(true[:, :2], touches.place)
            false[i] = len(touches) - len(b)
            found = np.column_stack([touches.place, touches.force, touches.deviation])[b]
            rows.append(np.column_stack([np.full(len(a), i), true[a], found]))
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
