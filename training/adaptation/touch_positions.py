"""Method of touch positions: learned from labelled presses of one sensor, whatever its geometry."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from eitskin.datasets import Dataset, State
from eitskin.training.adaptation.locator import UNKNOWN_SCALE, PositionRegressor, PressLocator
from eitskin.training.adaptation.press_fit import LabelledPresses, learn_places
from eitskin.training.method.input_spec import InputSpec
from eitskin.training.method.interface import Method
from eitskin.training.method.observations import Observations
from eitskin.training.method.predictions import FoundTouches, Predictions
from eitskin.training.method.settings import POSITIONS, Progress, TrainingSettings
from eitskin.training.method.stored_fields import Arrays, prefix_arrays
from eitskin.training.method.targets import Targets, TrainingFrames

MIN_STRENGTH = 0.2  # of the usual touch; the direction of a smaller change is mostly noise
STILL = 0.1  # rms change of a still sensor, relative to that of the usual touch
EXAMPLES = 5


@dataclass(frozen=True, eq=False)
class TouchPositions(Method):
    """Positions of single touches on one sensor; neither state nor bend angle nor force.

    Attributes:
        locator: locator from ratios V / reference to positions; a regressor in pipelines of version
            0.1.
        labels: labels of the measurements.
        learned: law of strength, model of the maps and errors in presses that were left out.
    """

    KIND: ClassVar[str] = POSITIONS
    targets: ClassVar[Targets] = Targets((), angle=False, force=False)

    locator: PressLocator | PositionRegressor
    labels: tuple[str, ...]
    learned: Mapping[str, Any] = field(default_factory=dict)

    @classmethod
    def fit(cls, frames: TrainingFrames, settings: TrainingSettings, progress: Progress) -> Self:  # noqa: ARG003
        """Learn from all frames with exactly one touch.

        Depths or forces are used where all of these frames have them; design and protocol where the
        dataset has them. Raises DataError for fewer than 5 presses.
        """
        learned = learn_places(LabelledPresses.from_dataset(frames.dataset))
        facts = {
            "law": learned.law and asdict(learned.law),
            "choice": asdict(learned.choice),
            "validated": learned.validated,
        }
        return cls(learned.locator, frames.spec.labels, facts)

    @property
    def noise(self) -> float:
        """Largest rms relative difference of two frames of a still, untouched sensor."""
        return _still_noise(self.locator.channel_scale)

    def predict(self, observations: Observations) -> Predictions:
        """A touch in each frame that differs enough from the untouched sensor."""
        count = len(observations)
        ratio = 1.0 + observations.dynamic
        strength = self.locator.strength(ratio)
        touched = np.flatnonzero(strength >= MIN_STRENGTH)
        touches = [FoundTouches.from_arrays((), ())] * count
        problems: list[tuple[str, ...]] = [()] * count
        if len(touched):
            places, left_out = self.locator.locate(ratio[touched])
            good_channels = self.locator.channel_scale < UNKNOWN_SCALE
            misfits = left_out & np.isfinite(ratio[touched]) & good_channels
            for at, row in enumerate(touched):
                size, deviation = min(float(strength[row]), 1.0), places.deviation[at]
                touches[row] = FoundTouches.from_arrays(places.place[at], size, deviation=deviation)
                problems[row] = tuple(
                    f"channel {self.labels[i]} contradicts all others and is left out"
                    for i in np.flatnonzero(misfits[at])
                )
        unknown = np.full(count, np.nan)
        return Predictions(
            np.full((count, len(State)), np.nan),
            unknown,
            unknown,
            np.zeros((count, 0, 0), np.float32),
            tuple(touches),
            tuple(problems),
        )

    def outputs(self, observations: Observations) -> Arrays:
        """Position (n, 2) [m] of one touch in each frame, however weak."""
        return {"place": self.locator.apply(1.0 + observations.dynamic)}

    def examples(self, train: Dataset) -> Observations:
        """A few of the touches in `train`, by which a saved copy is checked."""
        return _observations(LabelledPresses.from_dataset(train).ratios[:EXAMPLES])

    def arrays(self) -> Arrays:
        """Arrays of the locator."""
        return self.locator.arrays()

    @classmethod
    def from_arrays(cls, arrays: Arrays, spec: InputSpec, settings: TrainingSettings) -> Self:  # noqa: ARG003
        """Restore the method, from arrays of version 0.1, too."""
        kind = PositionRegressor if "directions" in arrays else PressLocator
        return cls(kind.from_arrays(arrays), spec.labels)


def _still_noise(channel_scale: NDArray[Any]) -> float:
    """Largest rms change of a still sensor, by the root mean square log ratios of touches (C,)."""
    return STILL * float(np.sqrt(np.mean(channel_scale[channel_scale < UNKNOWN_SCALE] ** 2)))


def _observations(ratio: NDArray[np.float64]) -> Observations:
    """Observations of ratios V / reference (n, C)."""
    ages = np.ones(len(ratio))
    change, flat = ratio - 1.0, np.full(ratio.shape, np.nan)
    return Observations(change, change, flat, ages, ages, ages, ages - 1.0, ages - 1.0)


def with_common_form(
    document: Mapping[str, Any], weights: Arrays, golden: Arrays
) -> tuple[dict[str, Any], Arrays, Arrays]:
    """Contents of touch positions that a version before 0.3 saved, in the form of all pipelines."""
    ratio = golden["input.ratio"]
    names = ("design", "protocol", "frequency", "extent")
    layout = {name: document.get(name) for name in names} | {"channels": ratio.shape[1]}
    common = {
        "method": POSITIONS,
        "layout": layout,
        "noise": _still_noise(weights["channel_scale"]),
        "settings": {"method": POSITIONS},
    }
    inputs = prefix_arrays("input", _observations(ratio).arrays())
    return {**document, **common}, weights, inputs | {"output.place": golden["output.place"]}
