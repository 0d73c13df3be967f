"""Touches that were found beside those that there were."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eitskin.datasets.store.dataset import Dataset
from eitskin.training.evaluation.metrics import match
from eitskin.training.method.predictions import Perceived

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Matches:
    """The m touches that were matched; `metrics.localisation` says how.

    Attributes:
        frame: that each is in (m,).
        true, found: places (m, 2) [m].
        true_force, found_force: (m,) [N]; NaN where not known.
        deviation: standard error of the found place (m,) [m]; NaN where not stated.
        false: touches that match none, per frame of the dataset (n,).
    """

    frame: NDArray[np.int64]
    true: Array
    found: Array
    true_force: Array
    found_force: Array
    deviation: Array
    false: NDArray[np.int64]

    @classmethod
    def of(cls, dataset: Dataset, perceived: Perceived) -> "Matches":
        """Match the touches of every frame."""
        false = np.zeros(len(dataset), np.int64)
        rows: list[Array] = [np.zeros((0, 8))]
        truth = np.stack([dataset.touch_x, dataset.touch_y, dataset.touch_force], axis=2)
        for i, touches in enumerate(perceived.touches):
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
        """Distance of each from the truth (m,) [m]."""
        distance: Array = np.linalg.norm(self.found - self.true, axis=1)
        return distance
