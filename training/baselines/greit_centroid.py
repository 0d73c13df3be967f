"""Centroids of GREIT pictures, without learning but two thresholds and a sign."""

from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np
from numpy.linalg import norm
from numpy.typing import NDArray

from eitskin.datasets import State
from eitskin.geometry import ConfigurationError, DataError
from eitskin.training.method.input_spec import InputSpec
from eitskin.training.method.interface import Method
from eitskin.training.method.observations import MissingChannels, Observations
from eitskin.training.method.predictions import Predictions
from eitskin.training.method.settings import Progress, TrainingSettings
from eitskin.training.method.stored_fields import GIVEN_FIELD, Arrays, field_arrays, restored_fields
from eitskin.training.method.targets import STATE_NAMES, Targets, TrainingFrames
from eitskin.training.paper.stages import find_touches

Array = NDArray[np.float64]

HALF = 0.5  # of a picture's largest value, above which it shows touches


@dataclass(frozen=True, slots=True, eq=False)
class GreitMethod(Method):
    """Touches as the regions above half the maximum of a GREIT picture, at their centroids.

    The picture is that of dV from the dynamic reference. The sizes of dV from both references,
    against thresholds, show the state. Neither angles nor forces are estimated.

    Attributes:
        matrix: picture of each channel's dV (C, rows, columns); 0 outside the outline.
        static, dynamic: imputation of bad channels.
        thresholds: thresholds of the sizes of dV from the dynamic reference, above which a frame is
            touched, and from the static one, above which another is bent (2,); infinite for states
            that are not distinguished.
        spec: sensor.
        radius: radius of the indenters [m].
        states: states that are distinguished.
    """

    KIND: ClassVar[str] = "greit"

    matrix: Array
    static: MissingChannels
    dynamic: MissingChannels
    thresholds: Array
    spec: Annotated[InputSpec, GIVEN_FIELD]
    radius: float
    states: tuple[int, ...]

    @classmethod
    def fit(
        cls, frames: TrainingFrames, settings: TrainingSettings, progress: Progress
    ) -> "GreitMethod":
        """Pictures of the design, and thresholds from labelled frames."""
        if settings.options:
            raise ConfigurationError(
                f"the method greit has no options, got {', '.join(settings.options)}"
            )
        data, observations, spec = frames.dataset, frames.observations, frames.spec
        if "touch" not in frames.targets.states or not frames.targets.touches:
            raise DataError(
                "the method greit finds touches, got no touched frames with places besides "
                "untouched ones; record or generate some"
            )
        progress(cls.KIND, 0, 1)
        # Finite elements, which an estimate does without.
        from eitskin.training.reconstruction.reconstructor import Reconstructor

        pictures = Reconstructor(spec.design, spec.protocol, "greit").images(
            np.eye(len(spec.protocol))
        )
        matrix = np.nan_to_num(pictures)
        still = MissingChannels.fit(observations.static, frames.noise)
        moving = MissingChannels.fit(observations.dynamic, frames.noise)
        static, dynamic = still.fill(observations.static), moving.fill(observations.dynamic)
        touched, bent = data.state == State.TOUCH, data.state == State.BEND
        states = tuple(STATE_NAMES.index(name) for name in frames.targets.states)
        bent_above = np.inf if State.BEND not in states else 0.0
        if State.BEND in states and State.IDLE in states:
            bent_above = best_threshold(norm(static[~touched], axis=1), bent[~touched])
        thresholds = np.array([best_threshold(norm(dynamic, axis=1), touched), bent_above])
        progress(cls.KIND, 1, 1)
        radius = float(np.nanmedian(data.touch_radius))
        shown = np.tensordot(dynamic[touched], matrix, 1).reshape(int(touched.sum()), -1)
        largest = np.take_along_axis(shown, np.abs(shown).argmax(axis=1)[:, None], axis=1)
        sign = 1.0 if np.mean(largest > 0) >= 0.5 else -1.0  # of most pictures' largest value
        return cls(sign * matrix, still, moving, thresholds, spec, radius, states)

    @property
    def targets(self) -> Targets:
        """States, and places of touches."""
        return Targets(tuple(STATE_NAMES[s] for s in self.states), angle=False, force=False)

    def predict(self, observations: Observations) -> Predictions:
        """Predictions for n frames; probabilities are 0 or 1."""
        dynamic = self.dynamic.fill(observations.dynamic)
        touched = norm(dynamic, axis=1) > self.thresholds[0]
        bent = norm(self.static.fill(observations.static), axis=1) > self.thresholds[1]
        state = np.where(touched, State.TOUCH, np.where(bent, State.BEND, State.IDLE))
        probabilities = np.full((len(state), len(State)), np.nan)
        probabilities[:, self.states] = state[:, None] == self.states
        centroids = {}
        for row in np.flatnonzero(touched).tolist():
            picture = np.tensordot(dynamic[row], self.matrix, 1)
            scaled = picture / max(float(picture.max()), 1e-300)
            centroids[row] = find_touches(scaled, self.spec.outline, HALF)
        placed = np.full((len(state), max(map(len, centroids.values()), default=0), 3), np.nan)
        for row, touches in centroids.items():
            placed[row, : len(touches)] = touches
        return Predictions.from_arrays(
            len(state),
            self.spec,
            probabilities=probabilities,
            places=placed[..., :2],
            strength=placed[..., 2],
            radius=self.radius,
        )

    def arrays(self) -> Arrays:
        return field_arrays(self)

    @classmethod
    def from_arrays(
        cls,
        arrays: Arrays,
        spec: InputSpec,
        settings: TrainingSettings,  # noqa: ARG003  the arrays say all
    ) -> "GreitMethod":
        return cls(**restored_fields(cls, arrays, spec=spec))


def best_threshold(sizes: Array, above: NDArray[np.bool_]) -> float:
    """Threshold of the least balanced error rate between sizes (n,) that are `above` and others."""
    order = np.argsort(sizes)
    ranked, hit = sizes[order], above[order]
    missed = np.cumsum(hit) / max(hit.sum(), 1)  # of those above, up to here
    false = 1.0 - np.cumsum(~hit) / max((~hit).sum(), 1)
    best = int(np.argmin(missed + false))
    return float(np.mean(ranked[best : best + 2]))
