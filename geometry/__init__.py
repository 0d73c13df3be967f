"""Shapes: what a sensor is, how it is meshed and how it deforms. Knows no physics."""

from eitskin.lazy import lazy_exports

__all__, __getattr__, __dir__ = lazy_exports(__name__, __file__)
