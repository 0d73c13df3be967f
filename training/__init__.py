"""Perception: from frames to state, bend angle and touches; training, saving and measuring it."""

from eitskin.training.evaluate import Report, evaluate
from eitskin.training.perception import Perceived, Perception
from eitskin.training.pipeline import Estimate, Pipeline
from eitskin.training.recorded_touches import PositionScore, RecordedTouches
from eitskin.training.settings import NetworkSettings, TrainingSettings

__all__ = [
    "Estimate",
    "NetworkSettings",
    "Perceived",
    "Perception",
    "Pipeline",
    "PositionScore",
    "RecordedTouches",
    "Report",
    "TrainingSettings",
    "evaluate",
]
