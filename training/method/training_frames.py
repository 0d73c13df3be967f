"""Training frames of a method: observations and the labels beside them."""

from dataclasses import dataclass

from eitskin.datasets.store.dataset import Dataset
from eitskin.errors import DataError
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.protocol import Protocol
from eitskin.training.method.input_spec import InputSpec
from eitskin.training.method.observations import Observations, frame_noise
from eitskin.training.method.targets import (
    Targets,
    require_targets,
    with_implied_labels,
    with_usual_radius,
)


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


def learnable(dataset: Dataset) -> tuple[Dataset, SensorDesign, Protocol]:
    """The dataset with labels that follow from others, its sensor and its table of measurements.

    Raises DataError for a dataset without design, protocol or labels, or with positions of touches
    alone.
    """
    if dataset.design is None or dataset.protocol is None:
        raise DataError(
            "expected a dataset that names its sensor's design and table of measurements, got "
            "one without; learn touch positions from it, or save it with a design"
        )
    complete = with_usual_radius(with_implied_labels(dataset))
    if require_targets(complete).positions_only:
        raise DataError(
            "expected untouched frames beside the touched ones, got positions of touches alone;"
            " learn these with RecordedTouches.fit, as eitskin train does"
        )
    return complete, dataset.design, dataset.protocol
