"""Opening of saved pipelines, whatever their kind."""

from pathlib import Path

from eitskin.errors import ConfigurationError
from eitskin.training.adaptation.recorded_touches import RecordedTouches
from eitskin.training.method.interface import Method
from eitskin.training.pipeline.pipeline import Pipeline
from eitskin.training.pipeline.saved_form import OtherKindError


def open_pipeline(
    path: str | Path, method: type[Method] | None = None
) -> Pipeline | RecordedTouches:
    """A saved pipeline of either kind: `targets` tells what its `process(frame)` estimates.

    "reference.eitmodel", unless a folder of that name exists, is the pipeline that comes with
    eitskin.

    Args:
        path: of the folder.
        method: as `Pipeline.load` takes it.

    Raises DataError for a pipeline that is damaged, changed, or newer than this eitskin, and
    ConfigurationError where the code of somebody's own method is missing, or another one.
    """
    try:
        return Pipeline.load(path, method)
    except OtherKindError:
        if method is not None:
            raise ConfigurationError(
                f"expected no code for {path}, which has learned touch positions as eitskin does, "
                f"got {method.KIND}; leave --method out"
            ) from None
        return RecordedTouches.load(path)


def open_perception(path: str | Path, wanted: str, method: type[Method] | None = None) -> Pipeline:
    """A saved pipeline of states, bends or touches, for what touch positions alone cannot do.

    Args:
        path: of the folder.
        wanted: in words, what the pipeline is needed for, as "a calibration needs ...".
        method: as `Pipeline.load` takes it.

    Raises ConfigurationError for a pipeline of touch positions, and the errors of `open_pipeline`.
    """
    opened = open_pipeline(path, method)
    if isinstance(opened, RecordedTouches):
        raise ConfigurationError(f"{wanted}, got {path}, which estimates touch positions only")
    return opened
