"""Training of a method by its settings, and its reconstruction from saved arrays."""

from collections.abc import Mapping
from typing import Any

from numpy.typing import NDArray

from eitskin.datasets.store.dataset import Dataset
from eitskin.errors import DataError
from eitskin.training.joint.method import JointMethod
from eitskin.training.joint.training import fit_joint
from eitskin.training.method.input_spec import InputSpec
from eitskin.training.method.interface import Method
from eitskin.training.method.settings import Progress, TrainingSettings
from eitskin.training.paper.method import PaperMethod

Arrays = Mapping[str, NDArray[Any]]


def fit_method(
    dataset: Dataset,
    layout: InputSpec,
    settings: TrainingSettings,
    progress: Progress,
    validation: Dataset | None = None,
) -> Method:
    """The method that `settings` names, trained on all frames of `dataset`.

    Losses on `validation` are recorded and change nothing.
    """
    if settings.method == JointMethod.KIND:
        return fit_joint(dataset, layout, settings.joint, settings.seed, progress)
    return PaperMethod.fit(dataset, layout, settings, progress, validation)


def method_from_arrays(kind: str, arrays: Arrays, layout: InputSpec) -> Method:
    """The method with the trained `arrays`; raises DataError for an unknown kind."""
    if kind == JointMethod.KIND:
        return JointMethod.from_arrays(arrays, layout)
    if kind == PaperMethod.KIND:
        return PaperMethod.from_arrays(arrays, layout)
    raise DataError(
        f"expected the method 'joint' or 'paper', got '{kind}'; install a newer eitskin"
    )
