"""All faults of a virtual board by name.

A fault is written `name@frame:index`, such as `bit_flip@5:12`. From that frame on it stays where
that is the nature of the fault (a channel that is NaN), else it strikes once (a lost frame). Faults
of answers count requests instead of frames: `no_reply@0:2` leaves the first two unanswered.
"""

import difflib
import re

from eitskin.geometry import ConfigurationError
from eitskin.hardware.board_faults import BOARD_FAULTS, AnswerFault
from eitskin.hardware.fault import Fault, Unplugged
from eitskin.hardware.sensor_faults import SENSOR_FAULTS
from eitskin.hardware.wire_faults import WIRE_FAULTS

__all__ = ["FAULTS", "Fault", "Unplugged", "fault_name", "read_faults"]

FAULTS: dict[str, type[Fault]] = {**WIRE_FAULTS, **BOARD_FAULTS, **SENSOR_FAULTS}
_NAMES = {kind: name for name, kind in FAULTS.items()}


def read_faults(
    text: str, frame: int | None = None, request: int | None = None
) -> tuple[Fault, ...]:
    """The faults in "name@frame:index,...".

    Args:
        text: as written.
        frame: that is struck where the text names none; each fault's own default when omitted.
        request: the same for faults of answers.

    Raises ConfigurationError where one cannot be.
    """
    parts = (part.strip() for part in text.split(","))
    return tuple(_read_fault(part, frame, request) for part in parts if part)


def fault_name(fault: Fault) -> str:
    """`fault` as it is written, without its frame; the class's name for one of none here."""
    name = _NAMES.get(type(fault), type(fault).__name__)
    return f"{name}:{fault.index}" if fault.index else name


def _read_fault(text: str, frame: int | None, request: int | None) -> Fault:
    match = re.fullmatch(r"(\w+)(?:@(\d{1,10}))?(?::(\d{1,6}))?", text)
    if match is None or match[1] not in FAULTS:
        near = difflib.get_close_matches(re.split("[@:]", text)[0], FAULTS, n=1)
        hint = f"; did you mean {near[0]}?" if near else ""
        raise ConfigurationError(
            f"expected a fault as name@frame:index with a name among {', '.join(FAULTS)}, got "
            f"{text!r}{hint}"
        )
    fault = FAULTS[match[1]](index=int(match[3] or 0))
    first = int(match[2]) if match[2] else request if isinstance(fault, AnswerFault) else frame
    if first is not None:
        fault.frame = first
    return fault
