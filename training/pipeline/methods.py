"""The methods by which a pipeline perceives, behind one interface."""

from collections.abc import Mapping
from typing import Any, Protocol

from numpy.typing import NDArray

from eitskin.datasets.store.dataset import Dataset
from eitskin.errors import DataError
from eitskin.training.joint.method import JointMethod
from eitskin.training.joint.training import fit_joint
from eitskin.training.method.calibration import Calibration, KnownBends
from eitskin.training.method.input_spec import Layout
from eitskin.training.method.learning_curve import History
from eitskin.training.method.observations import Observed
from eitskin.training.method.predictions import Perceived
from eitskin.training.method.settings import Progress, TrainingSettings
from eitskin.training.paper.method import PaperMethod

Arrays = Mapping[str, NDArray[Any]]


class Method(Protocol):
    """Says what frames show, each by itself, and remembers nothing."""

    @property
    def KIND(self) -> str:  # noqa: N802  a constant of the class
        """Name of the method in settings and saved pipelines."""
        ...

    @property
    def AVERAGES(self) -> bool:  # noqa: N802  a constant of the class
        """Whether it may be given means of frames of a held touch."""
        ...

    @property
    def histories(self) -> Mapping[str, History]:
        """How the losses of its networks fell while they were trained, by their names."""
        ...

    def perceive(self, observed: Observed) -> Perceived:
        """What n frames show."""
        ...

    def adapted(self, known: KnownBends) -> "tuple[Method, Calibration]":
        """The method for one sensor, of which some angles are known."""
        ...

    def outputs(self, observed: Observed) -> Arrays:
        """What every part makes of n frames, for checking copies."""
        ...

    def arrays(self) -> Arrays:
        """What `method_from_arrays` needs to make it again."""
        ...


def fit_method(
    dataset: Dataset,
    layout: Layout,
    settings: TrainingSettings,
    progress: Progress,
    validation: Dataset | None = None,
) -> Method:
    """Train the method that `settings` names on all frames of `dataset`.

    Losses on `validation` are looked at and change nothing.
    """
    if settings.method == JointMethod.KIND:
        return fit_joint(dataset, layout, settings.joint, settings.seed, progress)
    return PaperMethod.fit(dataset, layout, settings, progress, validation)


def method_from_arrays(kind: str, arrays: Arrays, layout: Layout) -> Method:
    """The method that `arrays` came from; raises DataError for one that is not known."""
    if kind == JointMethod.KIND:
        return JointMethod.from_arrays(arrays, layout)
    if kind == PaperMethod.KIND:
        return PaperMethod.from_arrays(arrays, layout)
    raise DataError(
        f"expected the method 'joint' or 'paper', got '{kind}'; install a newer eitskin"
    )
