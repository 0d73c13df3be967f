"""Opening of saved pipelines, whatever their kind."""

from pathlib import Path

from eitskin.training.method.interface import Method
from eitskin.training.pipeline.pipeline import Pipeline
from eitskin.training.pipeline.saved_form import OtherKindError
from eitskin.training.positions.recorded_touches import RecordedTouches


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
        return RecordedTouches.load(path)
