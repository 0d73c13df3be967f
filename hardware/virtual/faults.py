"""All faults of a virtual board by name.

A fault is written `name@frame:index`, such as `bit_flip@5:12`. From that frame on it stays where
that is the nature of the fault (a channel that is NaN), else it strikes once (a lost frame). Faults
of answers count requests instead of frames: `no_reply@0:2` leaves the first two unanswered.
"""

import difflib
import re

from eitskin.errors import ConfigurationError
from eitskin.hardware.virtual.board_faults import BOARD_FAULTS
from eitskin.hardware.virtual.fault import Fault, Unplugged
from eitskin.hardware.virtual.sensor_faults import SENSOR_FAULTS
from eitskin.hardware.virtual.wire_faults import WIRE_FAULTS

__all__ = ["FAULTS", "Fault", "Unplugged", "fault_name", "read_faults"]

FAULTS: dict[str, type[Fault]] = {**WIRE_FAULTS, **BOARD_FAULTS, **SENSOR_FAULTS}
_NAMES = {kind: name for name, kind in FAULTS.items()}


def read_faults(text: str) -> tuple[Fault, ...]:
    """The faults in "name@frame:index,..."; raises ConfigurationError where one cannot be."""
    return tuple(_read_fault(part.strip()) for part in text.split(",") if part.strip())


def fault_name(fault: Fault) -> str:
    """`fault` as it is written, without its frame; the class's name for one of none here."""
    name = _NAMES.get(type(fault), type(fault).__name__)
    return f"{name}:{fault.index}" if fault.index else name


def _read_fault(text: str) -> Fault:
    match = re.fullmatch(r"(\w+)(?:@(\d{1,10}))?(?::(\d{1,6}))?", text)
    if match is None or match[1] not in FAULTS:
        near = difflib.get_close_matches(re.split("[@:]", text)[0], FAULTS, n=1)
        hint = f"; did you mean {near[0]}?" if near else ""
        raise ConfigurationError(
            f"expected a fault as name@frame:index with a name among {', '.join(FAULTS)}, got "
            f"{text!r}{hint}"
        )
    given = {"frame": match[2], "index": match[3]}
    return FAULTS[match[1]](**{name: int(value) for name, value in given.items() if value})
