"""Interface of a perception method: fitted to frames, it turns observations into predictions."""

import warnings
from abc import ABC, abstractmethod
from collections.abc import Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from eitskin.errors import ConfigurationError
from eitskin.training.method.calibration import Adaptation
from eitskin.training.method.input_spec import InputSpec
from eitskin.training.method.known_frames import KnownFrames
from eitskin.training.method.learning_curve import LearningCurve
from eitskin.training.method.observations import Observations
from eitskin.training.method.predictions import Predictions
from eitskin.training.method.settings import Progress, TrainingSettings
from eitskin.training.method.targets import Targets
from eitskin.training.method.training_frames import TrainingFrames

Arrays = Mapping[str, NDArray[Any]]

FILE_MODULE = "eitskin_method_file_"
"""Prefix of the module name of a file that a user names as the code of a method."""


class Method(ABC):
    """Base of perception methods, which keep no state between frames.

    A method of your own defines `fit`, `predict`, `targets`, `arrays` and `from_arrays`; the rest
    is optional. docs/own-method.md shows one.
    """

    KIND: ClassVar[str]
    """Name of the method in settings and saved pipelines; MODULE:CLASS unless the class has one."""

    AVERAGES: ClassVar[bool] = False
    """Whether frames of a held touch are averaged for this method."""

    FITTED: ClassVar[bool] = False
    """Whether an iterative fit finds the outputs, so that a saved copy may differ by its ends."""

    if TYPE_CHECKING:  # fields, properties or constants of the class, as suits the method

        @property
        def targets(self) -> Targets:
            """Quantities that the method estimates."""

        @property
        def learning_curves(self) -> Mapping[str, LearningCurve]:
            """Losses of the networks during training, by name of the network."""

    else:
        learning_curves = MappingProxyType({})

    def __init_subclass__(cls, **options: Any) -> None:
        """Name a class that has no name of its own by its module and itself."""
        super().__init_subclass__(**options)
        if "adapted" in vars(cls) and "adapt" not in vars(cls):
            warnings.warn(
                f"{cls.__qualname__}: `adapted` is now called `adapt`; rename it",
                DeprecationWarning,
                stacklevel=2,
            )
            cls.adapt = vars(cls)["adapted"]  # type: ignore[method-assign]
        if "KIND" not in vars(cls):
            cls.KIND = f"{cls.__module__.removeprefix(FILE_MODULE)}:{cls.__qualname__}"

    @classmethod
    @abstractmethod
    def fit(cls, frames: TrainingFrames, settings: TrainingSettings, progress: Progress) -> Self:
        """Fit the method to labelled frames.

        Args:
            frames: observations, and the dataset with their labels.
            settings: `settings.options` are the hyper-parameters that the user has set, by name,
                `settings.seed` is the seed of everything random.
            progress: called with a stage, steps done and steps in all.

        Raises DataError for frames that the method cannot learn from.
        """

    @abstractmethod
    def predict(self, observations: Observations) -> Predictions:
        """Predictions for n frames, each independent of the others; see `Predictions.of`."""

    @abstractmethod
    def arrays(self) -> Arrays:
        """Arrays of numbers, of any shape (...,), from which `from_arrays` restores the method."""

    @classmethod
    @abstractmethod
    def from_arrays(cls, arrays: Arrays, spec: InputSpec, settings: TrainingSettings) -> Self:
        """Restore the method that `arrays` came from.

        Args:
            arrays: as `arrays` gave them.
            spec: sensor, measurements and units.
            settings: of the training, with the same `options`.

        Raises KeyError where an array is missing.
        """

    @property
    def adapts(self) -> bool:
        """Whether the method defines `adapt`."""
        return type(self).adapt is not Method.adapt

    def adapt(self, known: KnownFrames) -> "tuple[Method, Adaptation]":  # noqa: ARG002
        """The method adapted to one sensor by known frames, and what they changed.

        This one entry serves all that may be known: bend angles, touches with or without forces,
        and a twin. It was called `adapted` before version 0.3.

        Raises ConfigurationError for a method that cannot be adapted, which is the default.
        """
        raise ConfigurationError(
            f"expected a method that can be adapted, got '{self.KIND}', which has no `adapt`; "
            "use the pipeline as it is, or train the joint or the paper's method"
        )

    def outputs(self, observations: Observations) -> Arrays:
        """Outputs (n, ...) for n frames, by which a saved copy is checked: its predictions."""
        said = self.predict(observations)
        places = np.full((len(said.touches), max(map(len, said.touches), default=0), 2), np.nan)
        for row, touches in enumerate(said.touches):
            places[row, : len(touches)] = touches.place
        return {
            "probabilities": said.probabilities,
            "bend_angle_deg": said.bend_angle_deg,
            "touch_map": said.touch_map,
            "places": places,
        }
