"""Perception: from frames to state, bend angle and touches; training, saving and measuring it."""

from eitskin.lazy import offered

__all__, __getattr__, __dir__ = offered(__name__, __file__)
