"""Perception: from frames to state, bend angle and touches; training, saving and measuring it."""

from eitskin.training.evaluate import Report, evaluate
from eitskin.training.perceived import FoundTouches, Perceived
from eitskin.training.pipeline import Estimate, Pipeline
from eitskin.training.recorded_touches import PositionScore, RecordedTouches
from eitskin.training.settings import NetworkSettings, TrainingSettings

__all__ = [
    "Estimate",
    "FoundTouches",
    "NetworkSettings",
    "Perceived",
    "Pipeline",
    "PositionScore",
    "RecordedTouches",
    "Report",
    "TrainingSettings",
    "evaluate",
]
