"""Shapes: what a sensor is, how it is meshed and how it deforms. Knows no physics."""

from eitskin.geometry.bend import Bend, Hinge
from eitskin.geometry.electrode import Electrode
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
from eitskin.geometry.outline import Disc, Outline, PlaneOutline, Polygon, Rectangle
from eitskin.geometry.sensor import Layer, SensorDesign
from eitskin.geometry.structured import structured_mesh
from eitskin.geometry.surface import Surface

__all__ = [
    "Bend",
    "ConfigurationError",
    "Contacts",
    "DataError",
    "DeviceError",
    "Disc",
    "EitskinError",
    "Electrode",
    "FrameError",
    "Hinge",
    "Layer",
    "Mesh",
    "Outline",
    "PartialError",
    "PlaneOutline",
    "Polygon",
    "Rectangle",
    "SensorDesign",
    "Surface",
    "UnusableFrameError",
    "structured_mesh",
]
