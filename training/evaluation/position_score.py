"""Score of touch positions, learned from a recording, on its held-out presses."""

import warnings
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eitskin.datasets.store.dataset import Dataset
from eitskin.errors import DataError
from eitskin.training.adaptation.press_fit import LabelledPresses
from eitskin.training.adaptation.touch_positions import TouchPositions
from eitskin.training.method.interface import Method
from eitskin.training.method.settings import POSITION_SHARE, POSITIONS, TrainingSettings
from eitskin.training.pipeline.pipeline import Pipeline

Array = NDArray[np.float64]


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

    @classmethod
    def of(cls, pipeline: Pipeline, dataset: Dataset) -> "PositionScore":
        """Score on the held-out frames of `dataset`; raises DataError where there are none."""
        true, found = held_out_positions(pipeline, dataset)
        error = np.linalg.norm(found - true, axis=1)
        guess = np.linalg.norm(_method(pipeline).locator.centre - true, axis=1)
        means = (1e3 * float(value) for value in (error.mean(), np.median(error), guess.mean()))
        return cls(len(true), *means)

    @property
    def warnings(self) -> tuple[str, ...]:
        """Reasons not to believe in the estimates, a sentence each."""
        few = []
        if self.frames < 10:
            few.append(f"too few presses were held out ({self.frames}) to know the error")
        if self.mean_error_mm > 0.8 * self.guess_error_mm:
            few.append(
                f"the mean error of {self.mean_error_mm:.0f} mm is not clearly below the "
                f"{self.guess_error_mm:.0f} mm of always guessing the mean place"
            )
        remedy = "record presses at 50 places or more, all over the sensor"
        return tuple(f"{each}; {remedy}" for each in few)

    def as_dict(self) -> dict[str, Any]:
        """Plain data for JSON."""
        return asdict(self)


def held_out_positions(pipeline: Pipeline, dataset: Dataset) -> tuple[Array, Array]:
    """True and estimated positions in the held-out frames of `dataset`, (k, 2) [m] each.

    Raises DataError where no frame is held out, or for a pipeline of another method, and FrameError
    for a dataset of another protocol, where both are known.
    """
    locator, protocol = _method(pipeline).locator, dataset.protocol
    if pipeline.layout.known_protocol is not None and protocol is not None:
        pipeline.layout.require_same_measurements(protocol, pipeline.layout.frequency)
    frames = pipeline.held_out(dataset)
    if len(frames) == 0:
        raise DataError(
            "expected frames with exactly one touch to evaluate on, got none; record more"
        )
    presses = LabelledPresses.of(dataset, frames)
    return presses.places, locator.apply(presses.ratios)


def _method(pipeline: Pipeline) -> TouchPositions:
    if not isinstance(pipeline.method, TouchPositions):
        raise DataError(
            f"expected a pipeline of touch positions, got one of the method "
            f"'{pipeline.method.KIND}'; evaluate it with eitskin.training.evaluate"
        )
    return pipeline.method


_RENAMED = (
    "RecordedTouches is deprecated; use Pipeline, with TrainingSettings('touch position') to fit"
)

_FORMER: dict[str, Callable[[Pipeline], Any]] = {
    "protocol": lambda pipeline: pipeline.layout.known_protocol,
    "design": lambda pipeline: pipeline.layout.known_design,
    "frequency": lambda pipeline: pipeline.layout.frequency,
    "extent": lambda pipeline: pipeline.layout.extent,
    "described": lambda pipeline: pipeline.layout.described,
    "require_same_measurements": lambda pipeline: pipeline.layout.require_same_measurements,
    "position": lambda pipeline: _method(pipeline).locator,
    "still": lambda pipeline: pipeline.noise,
}


class RecordedTouches(Pipeline):
    """Deprecated name of a `Pipeline` of the method "touch position"."""

    KIND = POSITIONS

    @classmethod
    def fit(cls, dataset: Dataset, share: float = POSITION_SHARE) -> "RecordedTouches":  # type: ignore[override]
        """`Pipeline.fit` with `TrainingSettings("touch position", options={"share": share})`."""
        warnings.warn(_RENAMED, DeprecationWarning, stacklevel=2)
        return super().fit(dataset, TrainingSettings(POSITIONS, options={"share": share}))

    @classmethod
    def load(cls, path: str | Path, method: type[Method] | None = None) -> "RecordedTouches":
        """`Pipeline.load`."""
        warnings.warn(_RENAMED, DeprecationWarning, stacklevel=2)
        return super().load(path, method)

    def __getattr__(self, name: str) -> Any:
        """Attributes that the class had before it was a `Pipeline`."""
        if name not in _FORMER:
            raise AttributeError(f"'{type(self).__name__}' has no attribute '{name}'")
        return _FORMER[name](self)

    def found(self, dataset: Dataset) -> tuple[Array, Array]:
        """`held_out_positions`, (k, 2) [m] each."""
        return held_out_positions(self, dataset)

    def evaluate(self, dataset: Dataset) -> PositionScore:
        """`PositionScore.of`."""
        return PositionScore.of(self, dataset)
