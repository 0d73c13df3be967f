"""The relative differences of a dataset's frames to both references, and their noise."""

import hashlib
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eitskin.datasets import Dataset, State
from eitskin.geometry import DataError
from eitskin.training.references import relative_difference


@dataclass(frozen=True, slots=True, eq=False)
class Differences:
    """dV of n frames, dimensionless.

    Attributes:
        static: from the flat untouched sensor (n, measurements).
        dynamic: from the untouched sensor at the same bend, what the dynamic reference of a live
            pipeline would hold (n, measurements).
    """

    static: NDArray[np.float64]
    dynamic: NDArray[np.float64]

    @classmethod
    def of(cls, dataset: Dataset) -> "Differences":
        """The differences of all frames; the static reference stands in where no other is known."""
        flat = dataset.reference[dataset.specimen]
        known = np.isfinite(dataset.touch_reference).all(axis=1, keepdims=True)
        free = np.where(known, dataset.touch_reference, flat)
        return cls(
            relative_difference(dataset.impedance, flat),
            relative_difference(dataset.impedance, free),
        )


def noise_of(dataset: Dataset, differences: Differences) -> float:
    """Rms of the difference of two frames of an untouched sensor at one bend.

    Idle and bent frames against their own dynamic reference are all noise; where that is unknown,
    idle frames against the flat sensor. Raises DataError where there are none of these.
    """
    known = np.isfinite(dataset.touch_reference).all(axis=1)
    idle = dataset.state == State.IDLE
    quiet = idle | ((dataset.state == State.BEND) & known)
    if not quiet.any():
        raise DataError(
            "a pipeline learns the noise from idle frames, and this dataset has none; record or "
            "generate some"
        )
    return float(np.sqrt(np.mean(differences.dynamic[quiet] ** 2)))


def fingerprint(dataset: Dataset) -> str:
    """SHA-256 of all frames in their order: whether two datasets are the same."""
    return hashlib.sha256(np.ascontiguousarray(dataset.impedance).tobytes()).hexdigest()
