"""Shapes: what a sensor is, how it is meshed and how it deforms. Knows no physics."""

from eitskin.geometry.bend import Bend, Hinge
from eitskin.geometry.errors import (
    ConfigurationError,
    DataError,
    DeviceError,
    EitskinError,
    FrameError,
    PartialError,
    UnusableFrameError,
)
from eitskin.geometry.mesh import Contacts, Mesh
from eitskin.geometry.sensor import Electrode, Rectangle, SensorDesign
from eitskin.geometry.structured import structured_mesh

__all__ = [
    "Bend",
    "ConfigurationError",
    "Contacts",
    "DataError",
    "DeviceError",
    "EitskinError",
    "Electrode",
    "FrameError",
    "Hinge",
    "Mesh",
    "PartialError",
    "Rectangle",
    "SensorDesign",
    "UnusableFrameError",
    "structured_mesh",
]
