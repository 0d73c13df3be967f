"""Labelled presses of a dataset: frames with exactly one touch, its place, and what is known."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from eitskin.datasets.store.dataset import Dataset
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.protocol import Protocol
from eitskin.training.method.known_frames import held_numbers

Array = NDArray[np.float64]
Rows = NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class LabelledPresses:
    """n frames of presses of one sensor, in the order of time, and what is known of the sensor.

    Attributes:
        ratios: |V / ref| (n, C), ref being untouched.
        places: of the touches (n, 2) [m].
        label: depth [m] or else force [N] of each (n,); None where not all are known.
        design: of the sensor; None where unknown.
        protocol: of the channels; None where unknown.
    """

    ratios: Array
    places: Array
    label: Array | None = None
    design: SensorDesign | None = None
    protocol: Protocol | None = None

    @classmethod
    def of(cls, dataset: Dataset, frames: Rows | None = None) -> "LabelledPresses":
        """Presses of a dataset: all of them, or those of `frames` (n,), of one touch each."""
        rows = single_touches(dataset) if frames is None else frames
        return cls(
            _ratios(dataset, rows),
            places_of(dataset, rows),
            _label(dataset, rows),
            dataset.design,
            dataset.protocol,
        )

    def __len__(self) -> int:
        """Number of frames."""
        return len(self.ratios)

    @property
    def held(self) -> Rows:
        """Number of the press of each frame (n,): frames in succession may see one held touch."""
        known = [self.places] if self.label is None else [self.places, self.label]
        return held_numbers(np.column_stack(known))

    def select(self, rows: Rows) -> "LabelledPresses":
        """Presses at `rows` (k,)."""
        label = None if self.label is None else self.label[rows]
        return replace(self, ratios=self.ratios[rows], places=self.places[rows], label=label)


def single_touches(dataset: Dataset) -> Rows:
    """Numbers of the frames with exactly one touch, in the order of time (n,)."""
    one = np.flatnonzero(dataset.touch_count == 1)
    order = np.lexsort((one, dataset.time[one], dataset.episode[one]))
    return one[order]


def places_of(dataset: Dataset, frames: Rows) -> Array:
    """Positions (k, 2) [m] of the one touch in each of `frames` (k,)."""
    x, y = (np.nansum(values[frames], axis=1) for values in (dataset.touch_x, dataset.touch_y))
    return np.stack([x, y], axis=1).astype(float)


def _label(dataset: Dataset, frames: Rows) -> Array | None:
    """Depth [m] or else force [N] of the one touch in each of `frames` (k,); None where unknown."""
    touched = np.isfinite(dataset.touch_x[frames])
    for values in (dataset.touch_depth, dataset.touch_force):
        label: Array = np.where(touched, values[frames], 0.0).sum(axis=1, dtype=float)
        if len(label) and np.isfinite(label).all() and (label > 0).all():
            return label
    return None


def _ratios(dataset: Dataset, frames: Rows) -> Array:
    """|V / ref| (k, C) of `frames`; ref is flat where the untouched sensor was not recorded."""
    free = dataset.touch_reference[frames]
    known = np.isfinite(free).all(axis=1, keepdims=True)
    reference = np.where(known, free, dataset.reference[dataset.specimen[frames]])
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.abs(dataset.impedance[frames] / reference).astype(float)
