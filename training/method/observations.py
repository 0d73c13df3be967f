"""What a method is told of frames: their relative differences to both references."""

import hashlib
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from eitskin.datasets.store.dataset import Dataset
from eitskin.datasets.store.state import State
from eitskin.errors import DataError
from eitskin.training.method.references import relative_difference

Array = NDArray[np.float64]

UNKNOWN_AGE = 5.0
"""Of the static references of a dataset, which does not say when they were taken [s]."""


@dataclass(frozen=True, slots=True, eq=False)
class Observed:
    """n frames of C measurements beside their references; NaN where a measurement is bad.

    Attributes:
        static: dV from the flat untouched sensor (n, C), dimensionless.
        dynamic: dV from the untouched sensor at the same bend, or what a session takes for it.
        flat: magnitudes of the flat untouched sensor (n, C) [ohm].
        frames: how many frames of a held touch were averaged for each (n,).
        static_frames, dynamic_frames: how many frames were averaged for the references (n,).
        age, dynamic_age: since the static and the dynamic reference were last renewed (n,) [s].
    """

    static: Array
    dynamic: Array
    flat: Array
    frames: Array
    static_frames: Array
    dynamic_frames: Array
    age: Array
    dynamic_age: Array

    @classmethod
    def of(cls, dataset: Dataset) -> "Observed":
        """All frames, each by itself; the static reference stands in where no other is known.

        Static references of simulated sets are free of noise.
        """
        flat = dataset.reference[dataset.specimen]
        known = np.isfinite(dataset.touch_reference).all(axis=1, keepdims=True)
        free = np.where(known, dataset.touch_reference, flat)
        bad = dataset.status != 0
        return cls(
            np.where(bad, np.nan, relative_difference(dataset.impedance, flat)),
            np.where(bad, np.nan, relative_difference(dataset.impedance, free)),
            np.abs(flat).astype(float),
            np.ones(len(dataset)),
            np.full(len(dataset), np.inf if dataset.source == "simulated" else 1.0),
            np.full(len(dataset), float(dataset.reference_frames)),
            np.full(len(dataset), UNKNOWN_AGE),
            np.zeros(len(dataset)),
        )

    def __len__(self) -> int:
        """Number of frames."""
        return len(self.static)

    def __getitem__(self, rows: slice | NDArray[np.generic]) -> "Observed":
        """The frames of `rows` (slice, integers or mask)."""
        return Observed(*(getattr(self, field.name)[rows] for field in fields(self)))

    def arrays(self) -> dict[str, Array]:
        """By name."""
        return {field.name: getattr(self, field.name) for field in fields(self)}


def noise_of(dataset: Dataset, observed: Observed) -> float:
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
    return float(np.sqrt(np.nanmean(observed.dynamic[quiet] ** 2)))


def fingerprint(dataset: Dataset) -> str:
    """SHA-256 of all frames in their order: whether two datasets are the same."""
    return hashlib.sha256(np.ascontiguousarray(dataset.impedance).tobytes()).hexdigest()
