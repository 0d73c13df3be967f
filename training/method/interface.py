"""Interface of a perception method, and what its adaptation to one sensor gives."""

import json
import warnings
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from eitskin.geometry import ConfigurationError, DataError
from eitskin.training.method.input_spec import InputSpec
from eitskin.training.method.known_frames import KnownFrames
from eitskin.training.method.observations import Observations
from eitskin.training.method.predictions import Predictions
from eitskin.training.method.settings import Progress, TrainingSettings
from eitskin.training.method.stored_fields import Arrays, StoredFields
from eitskin.training.method.targets import Targets, TrainingFrames

Array = NDArray[np.float64]
MAX_RESIDUAL = 0.25  # relative to the root mean square of the known angles
MIN_ALLOWED_DEG = 1.0  # residual that is allowed however small the angles
FILE_MODULE = "eitskin_method_file_"
"""Prefix of the module name of a file that a user names as the code of a method."""


@dataclass(frozen=True, slots=True)
class LearningCurve(StoredFields):
    """Mean loss per frame, one value per epoch.

    Attributes:
        training: mean over the epoch's batches, while the weights change, with the noise and batch
            statistics of training.
        validation: loss after the epoch, in evaluation mode, on frames that no weight is fitted to;
            empty without such frames.
    """

    training: tuple[float, ...] = ()
    validation: tuple[float, ...] = ()


@dataclass(frozen=True, slots=True)
class Calibration:
    """Result of a calibration: errors of the angle before and after.

    Attributes:
        angles_deg: angles at which standard errors are stated [deg].
        error_before_deg: standard error of one frame's angle before calibration [deg].
        error_after_deg: standard error of one frame's angle after calibration [deg].
        residual_deg: root mean square of estimated minus known angles of the calibration frames,
            after calibration [deg].
    """

    angles_deg: tuple[float, ...]
    error_before_deg: tuple[float, ...]
    error_after_deg: tuple[float, ...]
    residual_deg: float

    def require_fit(self, known_deg: Array) -> None:
        """Refuse known angles (n,) [deg] that contradict the frames; raises DataError.

        With the shipped pipeline and a simulated sensor, at -20 to 50 deg, the residual is 0.2 deg;
        with angles of the other sign 12 deg, in another order 21 deg, with a sensor that
        stayed flat 28 deg.
        """
        size = float(np.sqrt(np.mean(known_deg**2)))
        allowed = max(MIN_ALLOWED_DEG, MAX_RESIDUAL * size)
        if self.residual_deg > allowed:
            raise DataError(
                f"the frames do not fit their angles: {self.residual_deg:.3g} deg off, root mean "
                f"square, after calibration, expected up to {allowed:.3g} deg for angles of "
                f"{known_deg.min():g} to {known_deg.max():g} deg; check that they are "
                "in degrees, of the right sign and order, and that the sensor was bent by them, "
                "still and untouched"
            )

    def as_dict(self) -> dict[str, Any]:
        """Plain data for JSON."""
        return dict(json.loads(json.dumps(asdict(self))))


@dataclass(frozen=True, slots=True)
class TwinTrial:
    """Response to touches without and with a twin, in known touches that the twin is tested by.

    Attributes:
        touches: number of frames with known touches.
        without: residual of their changes by the response as trained, relative to the changes; None
            without such frames.
        with_twin: the same by the twin's response.
    """

    touches: int
    without: float | None = None
    with_twin: float | None = None

    @property
    def accepts_twin(self) -> bool:
        """Whether the twin's response is taken: unless known touches contradict it."""
        if self.without is None or self.with_twin is None:
            return True
        return self.with_twin < self.without


@dataclass(frozen=True, slots=True)
class Adaptation:
    """Result of an adaptation to one sensor by known frames.

    Attributes:
        flat: number of frames of the flat, untouched sensor.
        bends: number of untouched frames at known angles that were used.
        touches: number of frames with touches at known places that were used.
        left_out: number of frames that were not used: not enough is known of them, or the method
            has no use for it.
        calibration: errors of the angle; None without known angles.
        error_scale: factor by which known touches changed the standard errors of places; 1 without.
        twin: residuals of known touches without and with a twin; None without one.
        noise_scale: noise of a frame relative to that in training, as far as the known frames show.
    """

    flat: int
    bends: int = 0
    touches: int = 0
    left_out: int = 0
    calibration: Calibration | None = None
    error_scale: float = 1.0
    twin: TwinTrial | None = None
    noise_scale: float = 1.0

    def require_fit(self, known: KnownFrames) -> None:
        """Refuse frames of which nothing is known, or known angles that contradict the frames.

        Also a twin that nothing was done with. Raises DataError, as `Calibration.require_fit`, and
        ConfigurationError.
        """
        if known.twin is None and not (self.flat or self.bends or self.touches):
            raise DataError(
                "expected frames known to be untouched, or of a known angle or known touches, to "
                f"adapt to, got none among {self.left_out}; label or record some"
            )
        if self.calibration is not None:
            self.calibration.require_fit(known.angle_deg[known.is_bent])
        if known.twin is not None and self.twin is None:
            raise ConfigurationError(
                "expected a pipeline that knows the forces of touches to take a twin's response "
                "(`--preset joint`), got another one; adapt it without a twin"
            )

    def as_dict(self) -> dict[str, Any]:
        """Plain data for JSON."""
        return dict(json.loads(json.dumps(asdict(self))))


class Method(ABC):
    """Base of perception methods, which keep no state between frames.

    A method of your own defines `fit`, `predict`, `targets`, `arrays` and `from_arrays`; the rest
    is optional. docs/how-to/own-method.md shows one.

    Example:
        >>> from eitskin.training import Method, Targets
        >>> class Mine(Method):
        ...     targets = Targets(force=False)
        >>> Mine.targets.force
        False
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

    @property
    def noise_scale(self) -> float:
        """Noise that the method weighs a frame by, relative to that in training."""
        return 1.0

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
        """Predictions for n independent frames; see `Predictions.from_arrays`."""

    def motions(
        self,
        observations: Observations,
        predictions: Predictions,  # noqa: ARG002  of use to methods that know a response
    ) -> Array:
        """Changes of dV (3 k + b, C) by motions of the first frame's k touches, and by bends.

        By a motion of each touch along x and along y, of any sizes, and by its whole force; then by
        a bend of any size in b directions, 0 to 2. Frames of a touch that moves so are not
        averaged, and one that only a bend hides is not lost. None by default.
        """
        return np.zeros((0, observations.static.shape[1]))

    @abstractmethod
    def arrays(self) -> Arrays:
        """Arrays of numbers, of any shape (...,), from which `from_arrays` restores the method."""

    @classmethod
    @abstractmethod
    def from_arrays(cls, arrays: Arrays, spec: InputSpec, settings: TrainingSettings) -> Self:
        """Restore the method that `arrays` came from.

        Args:
            arrays: arrays as `arrays` gave them.
            spec: sensor, measurements and units.
            settings: settings of the training, with the same `options`.

        Raises KeyError where an array is missing.
        """

    @property
    def adapts(self) -> bool:
        """Whether the method defines `adapt`."""
        return type(self).adapt is not Method.adapt

    def require_adaptable(self) -> None:
        """Refuse a method that cannot be adapted; raises ConfigurationError."""
        if not self.adapts:
            raise ConfigurationError(
                f"expected a method that can be adapted, got '{self.KIND}', which has no `adapt`; "
                "use the pipeline as it is, or train the joint or the paper's method"
            )

    def adapt(self, known: KnownFrames) -> "tuple[Method, Adaptation]":
        """The method adapted to one sensor by known frames, and what they changed.

        This one entry serves all that may be known: bend angles, touches with or without forces,
        and a twin. A method without it cannot be adapted. It was called `adapted` before.
        """
        raise NotImplementedError

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
