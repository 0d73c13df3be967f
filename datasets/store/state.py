"""What the sensor is doing, in the three classes that the pipeline tells apart."""

from enum import IntEnum
from typing import Final

UNKNOWN_STATE: Final = 255
"""Stands in state arrays where a recording does not say; not a class, so not a `State`."""


class State(IntEnum):
    """State of the sensor in one frame; a sensor that is bent and touched is in `TOUCH`."""

    IDLE = 0
    TOUCH = 1
    BEND = 2
