"""State of the sensor: the three classes of the pipeline's classifier."""

from enum import IntEnum
from typing import Final

UNKNOWN_STATE: Final = 255
"""Value for an unknown state in arrays; no class, and so no member of `State`."""


class State(IntEnum):
    """State of the sensor in one frame; `TOUCH` for a sensor both bent and touched."""

    IDLE = 0
    TOUCH = 1
    BEND = 2
