"""Perception: from frames to state, bend angle and touches; training, saving and measuring it."""

from eitskin.lazy import lazy_exports

__all__, __getattr__, __dir__ = lazy_exports(__name__, __file__)
