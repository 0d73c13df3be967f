"""Training of a pipeline: its method, and what a session of it is tested by."""

import math
from dataclasses import replace
from typing import Any

import numpy as np

from eitskin.datasets.store.dataset import Dataset
from eitskin.datasets.store.schema import State
from eitskin.training.adaptation.press_fit import touch_places
from eitskin.training.adaptation.touch_positions import TouchPositions
from eitskin.training.method.input_spec import InputSpec
from eitskin.training.method.interface import Method
from eitskin.training.method.observations import Observations, fingerprint
from eitskin.training.method.sensor_health import ReadingRange, follow_recording
from eitskin.training.method.settings import POSITIONS, Progress, TrainingSettings
from eitskin.training.method.targets import TrainingFrames, learnable
from eitskin.training.pipeline.flat_sensors import FlatSensors
from eitskin.training.pipeline.methods import method_class, require_sound

FLAT_SENSORS = "flat_sensors"
USUAL = "healthy"
# Beginnings of names of arrays that are not the method's.
FOREIGN = ("layout.", f"{FLAT_SENSORS}.", f"{USUAL}.")
GOLDEN_PER_STATE = 2


def trained_parts(
    dataset: Dataset, settings: TrainingSettings, progress: Progress, method: type[Method] | None
) -> dict[str, Any]:
    """Attributes of the pipeline that `Pipeline.fit` gives, by their names."""
    if method is not None:
        settings = replace(settings, method=method.KIND)
    if settings.method == POSITIONS:
        return _positions_parts(dataset, settings, progress)
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
        require_sound(fitted, examples, layout, settings, FOREIGN)
    return {
        "layout": layout,
        "method": fitted,
        "noise": frames.noise,
        "settings": settings,
        "trained_on": {
            "sha256": fingerprint(dataset),
            "frames": len(train),
            "specimens": len(np.unique(train.specimen)),
            "source": dataset.source,
        },
        "examples": examples,
        "flat_sensors": FlatSensors.from_dataset(train),
        "usual": ReadingRange.fit(1.0 + frames.observations.static, reference=True),
    }


def _positions_parts(
    dataset: Dataset, settings: TrainingSettings, progress: Progress
) -> dict[str, Any]:
    """Attributes of one for positions of touches alone, of the recorded sensor alone."""
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
    trained_on = {
        "sha256": fingerprint(dataset),
        "frames": len(train),
        "source": dataset.source,
        **method.learned,
    }
    usual = ReadingRange.from_recording(train) if train.has_touch_reference.any() else None
    examples = method.examples(train)
    return {
        "layout": layout,
        "method": method,
        "noise": method.noise,
        "settings": settings,
        "trained_on": trained_on,
        "examples": examples,
        "usual": usual,
    }
