"""What a flat, untouched sensor's resistances say of how it differs from others of its design."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eitskin.training.joint.symmetry import Mirror

Array = NDArray[np.float64]

COUNT = 8  # most features; each costs weights that the specimens must determine


@dataclass(frozen=True, slots=True, eq=False)
class SpecimenFeatures:
    """Linear features of the logarithms of the flat resistances, without their common factor.

    A common factor is conductivity, thickness or the board's gain, which leave relative changes
    alone. What remains is contacts and places of the electrodes, and the errors of paths.

    Attributes:
        middle: logarithms of the flat magnitudes of the middle sensor, their mean taken off (C,).
        directions: principal directions of the specimens' departures from it, each divided by
            the standard deviation along it, so that features have variance one (P, C).
    """

    middle: Array
    directions: Array

    @classmethod
    def fit(
        cls, flat: ArrayLike, mirrors: Sequence[Mirror], count: int = COUNT
    ) -> "SpecimenFeatures":
        """Learn from flat magnitudes of S specimens (S, C) [ohm] and their mirror images.

        There are at most `count`, and at most one for five specimens.
        """
        logs = _without_common(np.log(np.asarray(flat, dtype=float)))
        images = np.concatenate([logs[:, mirror.order] for mirror in mirrors])
        middle = images.mean(axis=0)
        _, sizes, directions = np.linalg.svd(images - middle, full_matrices=False)
        deviations = sizes / np.sqrt(max(len(images), 1))
        kept = min(count, len(logs) // 5, int(np.sum(deviations > 1e-9)))
        return cls(middle, directions[:kept] / deviations[:kept, None])

    def apply(self, flat: ArrayLike) -> Array:
        """Features (..., P) of flat magnitudes (..., C) [ohm]; bad channels (NaN) say nothing."""
        departure = _without_common(np.log(np.asarray(flat, dtype=float)) - self.middle)
        return np.where(np.isfinite(departure), departure, 0.0) @ self.directions.T

    def arrays(self) -> dict[str, Array]:
        """What `from_arrays` needs to make this again."""
        return {"middle": self.middle, "directions": self.directions}


def _without_common(logs: Array) -> Array:
    departure: Array = logs - np.nanmean(logs, axis=-1, keepdims=True)
    return departure
