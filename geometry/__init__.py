"""Shapes: what a sensor is, how it is meshed and how it deforms. Knows no physics."""

from eitskin.lazy import offered

__all__, __getattr__, __dir__ = offered(__name__, __file__)
