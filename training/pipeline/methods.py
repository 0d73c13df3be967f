"""Methods: shipped ones, and custom ones, whose code is named, run and checked; their training."""

import importlib.metadata
import inspect
import math
import re
import shlex
import sys
import traceback
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from eitskin.datasets.store.dataset import Dataset
from eitskin.datasets.store.schema import State
from eitskin.errors import ConfigurationError, DataError
from eitskin.files import quote_value
from eitskin.training.adaptation.press_fit import touch_places
from eitskin.training.adaptation.touch_positions import TouchPositions
from eitskin.training.baselines.greit_centroid import GreitMethod
from eitskin.training.baselines.regressions import ExtraTreesMethod, MlpMethod, RidgeMethod
from eitskin.training.joint.method import JointMethod
from eitskin.training.method.input_spec import InputSpec
from eitskin.training.method.interface import FILE_MODULE, Method
from eitskin.training.method.observations import Observations, fingerprint
from eitskin.training.method.sensor_health import ReadingRange, follow_recording
from eitskin.training.method.settings import POSITIONS, Progress, TrainingSettings
from eitskin.training.method.targets import TrainingFrames, learnable
from eitskin.training.paper.method import PaperMethod
from eitskin.training.pipeline.flat_sensors import FlatSensors

GROUP = "eitskin.methods"
"""Group of the entry points by which installed packages offer methods."""

OUTPUT_TOLERANCE = 1e-4  # relative difference of outputs of a method and of its restored copy


SHIPPED_METHODS: dict[str, type[Method]] = {
    method.KIND: method
    for method in (
        JointMethod,
        PaperMethod,
        RidgeMethod,
        MlpMethod,
        ExtraTreesMethod,
        GreitMethod,
        TouchPositions,
    )
}


_CLASS = re.compile(r"[^\W\d]\w*(\.(<locals>|[^\W\d]\w*))*")  # a class's qualified name
FLAT_SENSORS = "flat_sensors"
USUAL = "healthy"
# Beginnings of names of arrays that are not the method's.
FOREIGN = ("layout.", f"{FLAT_SENSORS}.", f"{USUAL}.")
GOLDEN_PER_STATE = 2


class MethodCodeError(ConfigurationError):
    """Code of a method that is missing, not the one expected, or wrong."""


def method_class(kind: str, own: type[Method] | None = None) -> type[Method]:
    """Class of the method that is named `kind`.

    Args:
        kind: `Method.KIND` of a shipped method, or MODULE:CLASS of one of the user's own.
        own: class that the user has named the code of; None without.

    Raises:
        DataError: for a method that neither eitskin nor the user has.
        MethodCodeError: for a method of the user's whose code is not named or is another one,
            or a named code where a shipped method needs none.
    """
    if kind in SHIPPED_METHODS:
        if own is None:
            return SHIPPED_METHODS[kind]
        raise MethodCodeError(
            f"expected no code for the method '{kind}', which ships with eitskin, got {own.KIND}; "
            "leave --method out"
        )
    module, colon, name = kind.rpartition(":")
    if not colon:
        raise DataError(
            f"expected a method of {', '.join(SHIPPED_METHODS)}, got {quote_value(kind)}; install "
            "a newer eitskin"
        )
    if not (module and module.isprintable() and _CLASS.fullmatch(name)):
        raise DataError(f"expected a method's name MODULE:CLASS, got {quote_value(kind)}")
    if own is None:
        raise MethodCodeError(
            f"this pipeline was trained by {kind}, which does not come with eitskin, and opening a "
            "pipeline runs no code on its own: name its code with --method "
            f"{shlex.quote(f'{module}.py:{name}')} (in Python: Pipeline.load(path, method={name}))"
        )
    if own.KIND.rpartition(":")[2] != name:
        raise MethodCodeError(
            f"this pipeline was trained by {kind}, got the code of {own.KIND}; name that of {name}"
        )
    return own


def named_method(name: str) -> type[Method]:
    """Class of a method of the user's own. The code that is named is run.

    Args:
        name: FILE.py:CLASS, or the name of an installed entry point of the group
            `eitskin.methods`.

    Raises MethodCodeError for code that is not there, cannot be run, or is no method.
    """
    path, _, class_name = name.rpartition(":")
    found = _in_file(Path(path), class_name) if path.endswith(".py") else _load_entry_point(name)
    if not (isinstance(found, type) and issubclass(found, Method)):
        raise MethodCodeError(
            f"expected {name} to be a class derived from eitskin.training.Method, got {found!r}"
        )
    if inspect.isabstract(found):
        missing = ", ".join(sorted(found.__abstractmethods__))
        raise MethodCodeError(f"{name} lacks {missing}; docs/how-to/own-method.md has an example")
    return found


def _in_file(path: Path, class_name: str) -> object:
    """The class in a file, which is run with its folder first on the path, as Python runs one."""
    if not path.is_file():
        raise MethodCodeError(f"there is no file {path}; name the code as FILE.py:CLASS")
    module = ModuleType(f"{FILE_MODULE}{path.stem}")
    module.__file__ = str(path)
    sys.modules[module.__name__] = module  # dataclasses look up type hints there
    folder = str(path.resolve().parent)
    sys.path.insert(0, folder)
    try:
        with told_errors(str(path)):
            # No import: that would keep byte code next to the file, and run it after a quick
            # change.
            exec(compile(path.read_bytes(), path, "exec"), vars(module))  # noqa: S102
    finally:
        sys.path.remove(folder)
    if class_name not in vars(module):
        classes = [
            each
            for each, value in vars(module).items()
            if isinstance(value, type) and value.__module__ == module.__name__
        ]
        raise MethodCodeError(
            f"{path} has no class '{class_name}'; it has {', '.join(classes) or 'none'}"
        )
    return vars(module)[class_name]


def _load_entry_point(name: str) -> object:
    """The object of an installed entry point; only the one that is named is imported."""
    offered = {point.name: point for point in importlib.metadata.entry_points(group=GROUP)}
    if name not in offered:
        raise MethodCodeError(
            f"expected FILE.py:CLASS or an installed method ({', '.join(sorted(offered)) or 'none'}"
            f" here), got '{name}'"
        )
    with told_errors(name):
        return offered[name].load()


@contextmanager
def told_errors(name: str) -> Iterator[None]:
    """Context in which code of the user's runs: its errors become MethodCodeError, with a place."""
    try:
        yield
    except ConfigurationError:
        raise
    except Exception as error:
        last = traceback.extract_tb(error.__traceback__)[-1]
        where = f"{Path(last.filename).name}, line {last.lineno}"
        if isinstance(error, SyntaxError):
            where = f"{Path(error.filename or name).name}, line {error.lineno}"
        raise MethodCodeError(
            f"{name} cannot be run: {type(error).__name__}: {error} ({where}); correct it"
        ) from error


def require_sound(
    method: Method, examples: Observations, spec: InputSpec, settings: TrainingSettings
) -> None:
    """Check what a newly fitted method of the user's gives, so that it can be used and opened.

    Args:
        method: fitted.
        examples: some frames.
        spec: sensor, measurements and units.
        settings: settings of the training.

    Raises MethodCodeError for predictions that are not what `targets` says, for arrays that cannot
    be saved, or for a restored copy that predicts something else.
    """
    predictions = method.predict(examples)
    for wrong in predictions.faults(method.targets, len(examples), spec.pixels):
        raise MethodCodeError(f"{method.KIND}: predict gives {wrong}")
    arrays = method.arrays()
    for name, array in arrays.items():
        if np.asarray(array).dtype.kind not in "biuf":
            raise MethodCodeError(
                f"{method.KIND}: expected arrays of numbers, got '{name}' of type "
                f"{np.asarray(array).dtype}; keep names and choices in settings.options"
            )
        if name.startswith(FOREIGN):
            raise MethodCodeError(
                f"{method.KIND}: the array '{name}' has a name that eitskin uses; call it otherwise"
            )
    copies = {name: np.array(array) for name, array in arrays.items()}
    with told_errors(f"{method.KIND}.from_arrays"):
        restored = type(method).from_arrays(copies, spec, settings)
        again = restored.outputs(examples)
    for name, value in method.outputs(examples).items():
        size = float(np.nanmax(np.abs(value), initial=0.0))
        if value.shape != again[name].shape or not np.allclose(
            value, again[name], rtol=0.0, atol=OUTPUT_TOLERANCE * size, equal_nan=True
        ):
            raise MethodCodeError(
                f"{method.KIND}: expected from_arrays to restore what was fitted, got other values "
                f"of '{name}'; arrays has to give everything that predict uses"
            )


def trained_parts(
    dataset: Dataset, settings: TrainingSettings, progress: Progress, method: type[Method] | None
) -> dict[str, Any]:
    """Attributes of the pipeline that `Pipeline.fit` gives, by their names."""
    if method is not None:
        settings = replace(settings, method=method.KIND)
    if settings.method == POSITIONS:
        train, facts, parts = _positions_parts(dataset, settings, progress)
    else:
        dataset, design, protocol = learnable(dataset)
        seen, unseen, _ = settings.split(dataset)
        train, validation = dataset.select(seen), dataset.select(unseen)
        layout = InputSpec.from_dataset(train, design, protocol)
        frames = TrainingFrames.from_dataset(train, layout, validation)
        chosen = np.concatenate(
            [np.flatnonzero(train.state == state)[:GOLDEN_PER_STATE] for state in State]
        )
        examples = frames.observations[chosen]
        fitted = method_class(settings.method, method).fit(frames, settings, progress)
        if method is not None:
            require_sound(fitted, examples, layout, settings)
        facts = {"specimens": len(np.unique(train.specimen))}
        parts = {
            "layout": layout,
            "method": fitted,
            "noise": frames.noise,
            "examples": examples,
            "flat_sensors": FlatSensors.from_dataset(train),
            "usual": ReadingRange.fit(1.0 + frames.observations.static, reference=True),
        }
    own = {"sha256": fingerprint(dataset), "frames": len(train), "source": dataset.source}
    return {**parts, "settings": settings, "trained_on": {**own, **facts}}


def _positions_parts(
    dataset: Dataset, settings: TrainingSettings, progress: Progress
) -> tuple[Dataset, Mapping[str, Any], dict[str, Any]]:
    """Training frames, facts and attributes of one for positions of touches of one sensor alone."""
    train = follow_recording(dataset.select(settings.split(dataset)[0]))[0]
    places = touch_places(train)
    layout = InputSpec(
        dataset.design,
        dataset.protocol,
        dataset.frequency if dataset.protocol else math.nan,
        np.full(dataset.impedance.shape[1], np.nan),
        extent=np.array([places.min(axis=0), places.max(axis=0)]) if len(places) else None,
    )
    frames = TrainingFrames(Observations.from_dataset(train), train, layout, math.nan)
    method = TouchPositions.fit(frames, settings, progress)
    usual = ReadingRange.from_recording(train) if train.has_touch_reference.any() else None
    parts = {
        "layout": layout,
        "method": method,
        "noise": method.noise,
        "examples": method.examples(train),
        "usual": usual,
    }
    return train, method.learned, parts
