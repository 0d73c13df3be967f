"""Touch positions learned from a recording without geometry: training, scoring and saving."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from eitskin.config import from_dict
from eitskin.datasets.store.dataset import Dataset
from eitskin.errors import DataError
from eitskin.protocol import Protocol
from eitskin.training.method.observations import fingerprint
from eitskin.training.pipeline.model_card import position_card
from eitskin.training.pipeline.saved_form import (
    SavedPipeline,
    read_pipeline,
    require_kind,
    write_pipeline,
)
from eitskin.training.positions.position_regressor import PositionRegressor

TRAINING_SHARE = 0.8  # the first part in time; neighbours in time are too similar to test on
GOLDEN = 5


@dataclass(frozen=True, slots=True)
class PositionScore:
    """Errors of estimated positions.

    Attributes:
        frames: number of frames.
        mean_error_mm, median_error_mm: mean and median distance from the true position [mm].
        guess_error_mm: mean distance of the mean training position from the true one [mm].
    """

    frames: int
    mean_error_mm: float
    median_error_mm: float
    guess_error_mm: float

    def as_dict(self) -> dict[str, Any]:
        """Plain data for JSON."""
        return asdict(self)


@dataclass(frozen=True, eq=False)
class RecordedTouches:
    """Touch positions learned from a recording of one sensor.

    Attributes:
        position: regressor from ratios |V / ref| to positions.
        examples: ratios by which a saved copy is checked (k, channels).
        trained_on: fingerprint of the recording and number of frames trained with.
        protocol: of the recording's frames; None where unknown.
        metrics: results of an evaluation, written by the evaluating code.
    """

    KIND: ClassVar[str] = "touch position"

    position: PositionRegressor
    examples: NDArray[np.float64]
    trained_on: Mapping[str, Any]
    protocol: Protocol | None = None
    metrics: dict[str, Any] = field(default_factory=dict)

    @classmethod
    def fit(cls, dataset: Dataset) -> "RecordedTouches":
        """Learn from the first 80 % in time of the frames that have exactly one touch.

        Raises DataError for fewer than 20 such frames.
        """
        touches = _touches(dataset)
        train = touches[: round(TRAINING_SHARE * len(touches))]
        ratios = _ratios(dataset, train)
        return cls(
            PositionRegressor.fit(ratios, _places(dataset, train)),
            ratios[:GOLDEN],
            {
                "sha256": fingerprint(dataset),
                "frames": len(train),
                "source": dataset.source,
            },
            dataset.protocol,
        )

    def held_out(self, dataset: Dataset) -> NDArray[np.int64]:
        """Frames (n,) not trained with: the last of the own recording, all of another.

        Raises FrameError for a dataset of another protocol, where both are known.
        """
        if self.protocol is not None and dataset.protocol is not None:
            self.protocol.require_same(
                dataset.protocol,
                "these touch positions were learned from frames of",
                "the dataset has",
                "train on recordings of this protocol",
            )
        touches = _touches(dataset)
        own = fingerprint(dataset) == self.trained_on["sha256"]
        return touches[self.trained_on["frames"] :] if own else touches

    def found(self, dataset: Dataset) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """True and estimated positions in the held-out frames of `dataset`, (k, 2) [m] each.

        Raises DataError where no frame is held out.
        """
        frames = self.held_out(dataset)
        if len(frames) == 0:
            raise DataError(
                "expected frames with exactly one touch to evaluate on, got none; record more"
            )
        return _places(dataset, frames), self.position.apply(_ratios(dataset, frames))

    def evaluate(self, dataset: Dataset) -> PositionScore:
        """Score on the held-out frames of `dataset`; raises DataError where there are none."""
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
        """Write the folder NAME.eitmodel, replacing an existing one; returns its path."""
        document = {
            "channels": self.examples.shape[1],
            "units": {"ratio": "1", "place": "m"},
            "trained_on": dict(self.trained_on),
            "metrics": self.metrics,
        }
        if self.protocol is not None:
            document["protocol"] = asdict(self.protocol)
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
        """Read a saved folder; raises DataError where it is damaged or computes otherwise."""
        saved = read_pipeline(path)
        require_kind(saved, cls.KIND, path)
        try:
            position = PositionRegressor.from_arrays(dict(saved.weights))
            document, examples = saved.document, saved.golden["input.ratio"]
            told = document.get("protocol")
            protocol = None if told is None else from_dict(Protocol, told, "protocol")
            metrics = dict(document["metrics"])
            loaded = cls(position, examples, document["trained_on"], protocol, metrics)
            saved.require_golden({"place": position.apply(examples)})
        except DataError:
            raise
        except (KeyError, TypeError, ValueError) as error:
            raise DataError(f"{path} is not whole: {error}; save it again") from error
        return loaded


def _touches(dataset: Dataset) -> NDArray[np.int64]:
    """Numbers of the frames with exactly one touch, in the order of time (n,)."""
    one = np.flatnonzero(dataset.touch_count == 1)
    order = np.lexsort((one, dataset.time[one], dataset.episode[one]))
    return one[order]


def _places(dataset: Dataset, frames: NDArray[np.int64]) -> NDArray[np.float64]:
    """Positions (k, 2) [m] of the one touch in each of `frames`."""
    x, y = (np.nansum(values[frames], axis=1) for values in (dataset.touch_x, dataset.touch_y))
    return np.stack([x, y], axis=1).astype(float)


def _ratios(dataset: Dataset, frames: NDArray[np.int64]) -> NDArray[np.float64]:
    """|V / ref| (k, C) of `frames`; ref is flat where the untouched sensor was not recorded."""
    free = dataset.touch_reference[frames]
    known = np.isfinite(free).all(axis=1, keepdims=True)
    reference = np.where(known, free, dataset.reference[dataset.specimen[frames]])
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.abs(dataset.impedance[frames] / reference).astype(float)
