"""Specimen features: principal components of the flat resistances over specimens of a design."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eitskin.training.method.input_spec import Mirror

Array = NDArray[np.float64]

COUNT = 8  # features of responses and curves; each costs weights that the specimens must determine
MOST = 20  # features that networks of the angle are told
FARTHEST = 5.0  # standard deviations of the training specimens


@dataclass(frozen=True, slots=True, eq=False)
class SpecimenFeatures:
    """Linear features of the logarithms of the flat resistances, without their common factor.

    The common factor holds conductivity, thickness and the board's gain, none of which alters
    relative changes. The features describe contacts and positions of the electrodes and the errors
    of signal paths.

    Attributes:
        middle: mean logarithms of the flat magnitudes, less their common factor (C,).
        directions: principal directions of the specimens' departures, each divided by the standard
            deviation along it, so that features have unit variance (P, C).
    """

    middle: Array
    directions: Array

    @classmethod
    def fit(
        cls, flat: ArrayLike, mirrors: Sequence[Mirror], count: int = MOST
    ) -> "SpecimenFeatures":
        """Principal component analysis of specimens and their mirror images.

        Args:
            flat: magnitudes of S specimens, flat and untouched (S, C) [ohm].
            mirrors: symmetries of the sensor.
            count: most features; there is at most one for five specimens.
        """
        logs = _without_common(np.log(np.asarray(flat, dtype=float)))
        images = np.concatenate([logs[:, mirror.order] for mirror in mirrors])
        middle = images.mean(axis=0)
        _, sizes, directions = np.linalg.svd(images - middle, full_matrices=False)
        deviations = sizes / np.sqrt(max(len(images), 1))
        kept = min(count, len(logs) // 5, int(np.sum(deviations > 1e-9)))
        return cls(middle, directions[:kept] / deviations[:kept, None])

    def first(self, count: int = COUNT) -> "SpecimenFeatures":
        """The features along which specimens differ most, `count` of them."""
        return SpecimenFeatures(self.middle, self.directions[:count])

    def apply(self, flat: ArrayLike) -> Array:
        """Features (..., P) of flat magnitudes (..., C) [ohm]; bad channels (NaN) are ignored."""
        departure = _without_common(np.log(np.asarray(flat, dtype=float)) - self.middle)
        return np.where(np.isfinite(departure), departure, 0.0) @ self.directions.T

    def bounded(self, flat: ArrayLike) -> Array:
        """Features (..., P), each at most `FARTHEST` standard deviations from the middle.

        Bend curves are linear in the features and networks smooth, so far outside of the training
        specimens both are wrong without a sign of it; at the bound they are merely of another
        specimen, as their standard errors tell.
        """
        return np.clip(self.apply(flat), -FARTHEST, FARTHEST)

    def arrays(self) -> dict[str, Array]:
        """Attributes by name."""
        return {"middle": self.middle, "directions": self.directions}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[np.generic]]) -> "SpecimenFeatures":
        """Restore the features that `arrays` came from."""
        return cls(arrays["middle"].astype(float), arrays["directions"].astype(float))


def _without_common(logs: Array) -> Array:
    """Logarithms (..., C) minus their mean over the channels."""
    departure: Array = logs - np.nanmean(logs, axis=-1, keepdims=True)
    return departure
