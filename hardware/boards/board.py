"""The interface of every board: its frames, its identity, and what has come through."""

import math
import typing
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from types import TracebackType
from typing import Any, Self

from eitskin.frame import Frame
from eitskin.hardware.protocol.messages import Info
from eitskin.protocol import Protocol


@dataclass(frozen=True, slots=True)
class Counts:
    """What has come through and what has not.

    Attributes:
        frames: given out.
        lost: missing by their numbers; never made up.
        skipped: good, but older than the newest when the newest was asked for.
        dropped: byte strings and messages thrown away, by reason.
        reconnections: how often it has gone away and come back.
    """

    frames: int = 0
    lost: int = 0
    skipped: int = 0
    dropped: Mapping[str, int] = field(default_factory=dict)
    reconnections: int = 0


SILENT_PERIODS = 3
SHORTEST_SILENCE = 0.5  # s; a host that is busy for a moment is no silent board


def longest_silence(period: float, least: float = SHORTEST_SILENCE) -> float:
    """How long no frame may come from a board with that period [s]; NaN or 0 is unknown."""
    return max(SILENT_PERIODS * period, least) if period > 0.0 else math.inf


class Board(typing.Protocol):
    """A source of frames: a board on a port, a virtual one, or a recording of one."""

    @property
    def uri(self) -> str:
        """What it was opened as."""

    @property
    def info(self) -> Info:
        """Who it is."""

    @property
    def protocol(self) -> Protocol:
        """What it measures."""

    @property
    def counts(self) -> Counts:
        """What has come through so far."""

    @property
    def stage(self) -> Any:
        """Scene and faults of a virtual board, a `Stage`; None for every other board."""

    @property
    def lost(self) -> int:
        """Frames lost so far."""

    def frames(self, newest: bool = False) -> Iterator[Frame]:
        """The frames, as they come; with `newest`, those that another has overtaken are left out.

        Raises DeviceError where the board falls silent or goes away.
        """

    def calibrate(self) -> None:
        """Have it measure its calibration resistor again; raises where it cannot."""

    def reconnect(self) -> None:
        """Connect again, after which `frames` goes on; raises DeviceError where that fails."""

    def close(self) -> None:
        """Stop and let go of the port; a second time does nothing."""

    def __enter__(self) -> Self:
        """Give the board itself."""

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Close the board."""
