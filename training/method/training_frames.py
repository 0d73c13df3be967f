"""Training frames of a method: observations and the labels beside them."""

from dataclasses import dataclass

from eitskin.datasets.store.dataset import Dataset
from eitskin.training.method.input_spec import InputSpec
from eitskin.training.method.observations import Observations, frame_noise
from eitskin.training.method.targets import Targets, require_targets


@dataclass(frozen=True, slots=True, eq=False)
class TrainingFrames:
    """Labelled frames that a method is fitted to.

    Attributes:
        observations: of the n frames: input, as `Method.predict` gets it.
        dataset: the same n frames with their labels; unknown ones are `UNKNOWN_STATE` or NaN.
        spec: sensor, measurements and units.
        noise: rms relative difference of two frames of a still sensor, dimensionless.
        validation: other frames, to watch losses on, not to fit to; None without.
    """

    observations: Observations
    dataset: Dataset
    spec: InputSpec
    noise: float
    validation: Dataset | None = None

    @classmethod
    def of(
        cls, dataset: Dataset, spec: InputSpec, validation: Dataset | None = None
    ) -> "TrainingFrames":
        """All frames of a dataset; raises DataError without labels or without idle frames."""
        require_targets(dataset)
        observations = Observations.of(dataset)
        return cls(observations, dataset, spec, frame_noise(dataset, observations), validation)

    def __len__(self) -> int:
        """Number of frames."""
        return len(self.dataset)

    @property
    def targets(self) -> Targets:
        """Quantities that the frames have labels for."""
        return Targets.of(self.dataset)
