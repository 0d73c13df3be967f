"""Touch positions of a recording without geometry: its touches, their split, and saving them."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from eitskin.datasets.store.dataset import Dataset
from eitskin.errors import DataError
from eitskin.training.method.observations import fingerprint
from eitskin.training.pipeline.model_card import position_card
from eitskin.training.pipeline.saved_form import (
    SavedPipeline,
    read_pipeline,
    require_kind,
    write_pipeline,
)
from eitskin.training.positions.touch_position import TouchPosition

TRAINING_SHARE = 0.8  # the first part in time; neighbours in time are too alike to test on
GOLDEN = 5


@dataclass(frozen=True, slots=True)
class PositionScore:
    """Places against the truth.

    Attributes:
        frames: how many.
        mean_error_mm, median_error_mm: of the distance.
        guess_error_mm: mean distance when the middle of the training places is said every time.
    """

    frames: int
    mean_error_mm: float
    median_error_mm: float
    guess_error_mm: float

    def as_dict(self) -> dict[str, Any]:
        """Plain data, as JSON takes it."""
        return asdict(self)


@dataclass(frozen=True, eq=False)
class RecordedTouches:
    """Touch positions learned from a recording of one sensor.

    Attributes:
        position: from ratios to places.
        examples: ratios that a saved one is checked with (k, channels).
        trained_on: fingerprint of the recording and what part of it was used.
        metrics: how good it was found to be; whoever evaluates it writes them here.
    """

    KIND: ClassVar[str] = "touch position"

    position: TouchPosition
    examples: NDArray[np.float64]
    trained_on: Mapping[str, Any]
    metrics: dict[str, Any] = field(default_factory=dict)

    @classmethod
    def fit(cls, dataset: Dataset) -> "RecordedTouches":
        """Learn from the first 80 % in time of the frames that have exactly one touch.

        Raises DataError where there are too few.
        """
        touches = _touches(dataset)
        train = touches[: round(TRAINING_SHARE * len(touches))]
        ratios = _ratios(dataset, train)
        return cls(
            TouchPosition.fit(ratios, _places(dataset, train)),
            ratios[:GOLDEN],
            {
                "sha256": fingerprint(dataset),
                "frames": len(train),
                "source": dataset.source,
            },
        )

    def held_out(self, dataset: Dataset) -> NDArray[np.int64]:
        """Frames (n,) that training never saw: the last of its own recording, all of another."""
        touches = _touches(dataset)
        own = fingerprint(dataset) == self.trained_on["sha256"]
        return touches[self.trained_on["frames"] :] if own else touches

    def found(self, dataset: Dataset) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """True and found places of the held-out frames of `dataset` (k, 2) [m].

        Raises DataError where there are none.
        """
        frames = self.held_out(dataset)
        if len(frames) == 0:
            raise DataError("there is no frame with exactly one touch to evaluate on")
        return _places(dataset, frames), self.position.apply(_ratios(dataset, frames))

    def evaluate(self, dataset: Dataset) -> PositionScore:
        """Distances of the held-out frames of `dataset`; raises DataError where there are none."""
        truth, found = self.found(dataset)
        error = np.linalg.norm(found - truth, axis=1)
        guess = np.linalg.norm(self.position.centre - truth, axis=1)
        return PositionScore(
            len(truth),
            float(error.mean()) * 1e3,
            float(np.median(error)) * 1e3,
            float(guess.mean()) * 1e3,
        )

    def save(self, path: str | Path) -> Path:
        """Write it as the folder NAME.eitmodel; what is there is replaced."""
        document = {
            "channels": self.examples.shape[1],
            "units": {"ratio": "1", "place": "m"},
            "trained_on": dict(self.trained_on),
            "metrics": self.metrics,
        }
        golden = {
            "input.ratio": self.examples,
            "output.place": self.position.apply(self.examples),
        }
        weights = self.position.arrays()
        return write_pipeline(
            path, SavedPipeline(self.KIND, document, weights, golden, position_card(document))
        )

    @classmethod
    def load(cls, path: str | Path) -> "RecordedTouches":
        """Read what `save` wrote, checked in the same way as a pipeline; raises DataError."""
        saved = read_pipeline(path)
        require_kind(saved, cls.KIND, path)
        try:
            position = TouchPosition.from_arrays(dict(saved.weights))
            document, examples = saved.document, saved.golden["input.ratio"]
            loaded = cls(position, examples, document["trained_on"], dict(document["metrics"]))
            saved.require_golden({"place": position.apply(examples)})
        except DataError:
            raise
        except (KeyError, TypeError, ValueError) as error:
            raise DataError(f"{path} is not whole: {error}; save it again") from error
        return loaded


def _touches(dataset: Dataset) -> NDArray[np.int64]:
    """Frames with exactly one touch, in the order of time."""
    one = np.flatnonzero(dataset.touch_count == 1)
    order = np.lexsort((one, dataset.time[one], dataset.episode[one]))
    return one[order]


def _places(dataset: Dataset, frames: NDArray[np.int64]) -> NDArray[np.float64]:
    """x and y of the one touch of each of `frames` (k, 2) [m]."""
    x, y = (np.nansum(values[frames], axis=1) for values in (dataset.touch_x, dataset.touch_y))
    return np.stack([x, y], axis=1).astype(float)


def _ratios(dataset: Dataset, frames: NDArray[np.int64]) -> NDArray[np.float64]:
    """|V / ref| of `frames`; the flat reference where the untouched sensor was not recorded."""
    free = dataset.touch_reference[frames]
    known = np.isfinite(free).all(axis=1, keepdims=True)
    reference = np.where(known, free, dataset.reference[dataset.specimen[frames]])
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.abs(dataset.impedance[frames] / reference).astype(float)
