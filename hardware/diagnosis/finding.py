"""What a sensor check can find, and how it says where."""

from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from eitskin.hardware.diagnosis.checked_frames import Bools, CheckedFrames, electrodes_at_fault


class FindingKind(StrEnum):
    """The kinds of finding."""

    NOT_FINITE = "not finite"
    CLIPPED = "clipped"
    BOARD = "reported by the board"
    FROZEN = "frozen"
    STUCK = "stuck"
    NOISY = "noisy"
    MOVED = "moved"
    OPEN = "open"
    SHORT = "short"
    FACTOR = "factor"
    PHASE = "phase"
    SWAPPED = "swapped"
    BAD_CONTACT = "bad contact"
    MISFIT = "misfit"


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that is wrong.

    Attributes:
        what: its kind.
        electrodes: that it lies at, as the protocol numbers them; empty where that is unknown.
        channels: the measurements that show it.
        message: what it is, and what to do.
    """

    what: FindingKind
    electrodes: tuple[int, ...]
    channels: tuple[int, ...]
    message: str


def findings_by_electrode(
    what: FindingKind, wrong: Bools, checked: CheckedFrames, said: str, remedy: str
) -> Iterator[Finding]:
    """Findings of channels at fault, by electrode where it has no other channels."""
    if wrong.all():
        yield Finding(what, (), channel_numbers(wrong), f"every channel {said}: {remedy}")
        return
    electrodes, channels = electrodes_at_fault(wrong, checked.protocol)
    for e in electrodes:
        at = checked.with_electrode(e)
        yield Finding(
            what, (e,), channel_numbers(at), f"every pair of electrode {e} {said}: {remedy}"
        )
    for k in channels:
        yield Finding(what, (), (k,), f"channel {checked.protocol.labels[k]} {said}: {remedy}")


def channel_names(wrong: Bools, checked: CheckedFrames) -> str:
    """The channels that are wrong, in words."""
    labels = [checked.protocol.labels[k] for k in np.flatnonzero(wrong)]
    return "every channel" if wrong.all() else f"channel {', '.join(labels)}"


def channel_numbers(channels: Bools) -> tuple[int, ...]:
    """The numbers of channels."""
    return tuple(np.flatnonzero(channels).tolist())
