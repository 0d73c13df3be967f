"""Interface of a perception method: observations in, predictions out, without memory."""

from collections.abc import Mapping
from typing import Any, Protocol

from numpy.typing import NDArray

from eitskin.training.method.calibration import Calibration, KnownBends
from eitskin.training.method.learning_curve import LearningCurve
from eitskin.training.method.observations import Observations
from eitskin.training.method.predictions import Predictions
from eitskin.training.method.targets import Targets

Arrays = Mapping[str, NDArray[Any]]


class Method(Protocol):
    """Interface of a perception method, which keeps no state between frames."""

    @property
    def KIND(self) -> str:  # noqa: N802  a constant of the class
        """Name of the method in settings and saved pipelines."""
        ...

    @property
    def AVERAGES(self) -> bool:  # noqa: N802  a constant of the class
        """Whether frames of a held touch are averaged for this method."""
        ...

    @property
    def targets(self) -> Targets:
        """Quantities that the method estimates."""
        ...

    @property
    def learning_curves(self) -> Mapping[str, LearningCurve]:
        """Losses of the networks during training, by name of the network."""
        ...

    def perceive(self, observations: Observations) -> Predictions:
        """Predictions for n frames, each independent of the others."""
        ...

    def adapted(self, known: KnownBends) -> "tuple[Method, Calibration]":
        """The method calibrated to one sensor, and the errors before and after.

        Raises ConfigurationError for a method that does not estimate the angle.
        """
        ...

    def outputs(self, observations: Observations) -> Arrays:
        """Outputs for n frames, by which a saved copy is checked."""
        ...

    def arrays(self) -> Arrays:
        """Arrays from which `method_from_arrays` restores the method, by name."""
        ...
