"""Findings of a sensor check, by electrode or channel."""

from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from eitskin.hardware.diagnosis.checked_frames import Bools, CheckedFrames, electrodes_at_fault


class FindingKind(StrEnum):
    """Kinds of findings."""

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
    NOT_FLAT = "not flat"
    DEAD = "dead"
    RECIPROCITY = "reciprocity"
    DRIVE_SWAP = "swapped drives"
    SENSE_SWAP = "swapped senses"
    LOOP = "loop sum"


@dataclass(frozen=True, slots=True)
class Finding:
    """One fault of a sensor.

    Attributes:
        what: kind of the finding.
        electrodes: numbers of the electrodes at fault; empty where unknown.
        channels: numbers of the measurements that show the fault.
        message: fault and remedy, in words.
    """

    what: FindingKind
    electrodes: tuple[int, ...]
    channels: tuple[int, ...]
    message: str


def findings_by_electrode(
    what: FindingKind, wrong: Bools, checked: CheckedFrames, said: str, remedy: str
) -> Iterator[Finding]:
    """Findings of wrong channels, by electrode where all channels of one are wrong."""
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
    """Wrong channels, in words."""
    labels = [checked.protocol.labels[k] for k in np.flatnonzero(wrong)]
    return "every channel" if wrong.all() else f"channel {', '.join(labels)}"


def channel_numbers(channels: Bools) -> tuple[int, ...]:
    """Numbers of the channels in a mask."""
    return tuple(np.flatnonzero(channels).tolist())
