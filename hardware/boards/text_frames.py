"""Frames in a stream of lines that does not number them."""

import math
from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from statistics import median

from eitskin.hardware.boards.text_lines import Line, Mark, Measurement

PAUSE = 3.0
"""Usual distances between lines that make a pause."""


class FrameDrop(StrEnum):
    """Why a measurement was thrown away that came whole."""

    FIRST = "measurement before the first whole frame"
    INCOMPLETE = "measurement of an incomplete frame"


@dataclass(frozen=True, slots=True, eq=False)
class FrameLines:
    """The lines of one frame.

    Attributes:
        number: counts the frames, the lost ones too.
        time: when the first came, on the host's clock [s].
        measurements: as many as the protocol has.
    """

    number: int
    time: float
    measurements: tuple[Measurement, ...]


class FrameFinder:
    """Lines in, frames out: what lies between two marks, or two pauses, if its length is right.

    Attributes:
        lost: frames that had another length, by the number of their lines, each at least once.
        drops: measurements thrown away, by reason.
        frequency: last said, else NaN [Hz].
    """

    def __init__(self, size: int, marked: bool, pause: float = math.nan) -> None:
        """Find frames of `size` lines, `marked` or by a `pause` [s], which NaN leaves open."""
        self.lost = 0
        self.drops: Counter[FrameDrop] = Counter()
        self.frequency = math.nan
        self._size, self._marked, self._pause = size, marked, pause
        self._number = 0
        self._counts: deque[int] = deque(maxlen=3)
        self.forget()

    @property
    def period(self) -> float:
        """From a frame to the next, as far as known, else NaN [s]."""
        return float(median(self._periods)) if self._periods else math.nan

    def forget(self) -> None:
        """Begin with another stream."""
        self._usual = math.nan
        self._periods: deque[float] = deque(maxlen=9)
        self._counts.clear()
        self.restart()

    def restart(self) -> None:
        """Wait for the next beginning; what has come since the last is given up."""
        self._latest = math.nan
        self._distances: deque[float] = deque(maxlen=self._size)
        self._group: list[Measurement] = []
        self._count = 0
        self._whole = False
        self._began = self._last = math.nan

    def feed(self, now: float, lines: Sequence[Line]) -> list[FrameLines]:
        """The frames that are known to have ended by `now` [s], when `lines` had come."""
        ended = []
        if not self._marked and self._count and now - self._latest > self._longest:
            ended.append(self._end())
        for line in lines:
            if isinstance(line, Mark):
                ended.append(self._end())
            else:
                self._take(now, line)
        return [frame for frame in ended if frame is not None]

    def received_instead(self) -> str:
        """What came instead of a frame."""
        if self._counts:
            found = ", ".join(map(str, self._counts))
            return (
                f"its last frames had {found} lines where {self._size} were expected; check the "
                "protocol, or tell frames apart by mark= or pause="
            )
        if self._count:
            what = "no line with the mark" if self._marked else "no pause"
            return f"lines come, but {what}; tell frames apart by mark= or pause="
        return "no measurement came; check power, cable and baud rate"

    @property
    def _longest(self) -> float:
        """Distance of lines that is no pause yet [s]; infinite while the usual one is unknown."""
        if not math.isnan(self._pause):
            return self._pause
        return math.inf if math.isnan(self._usual) else PAUSE * self._usual

    def _take(self, now: float, line: Measurement) -> None:
        if not self._count:
            self._began = now
        self._count += 1
        if self._count <= self._size:
            self._group.append(line)
        if not math.isnan(line.frequency):
            self.frequency = line.frequency
        if not math.isnan(self._latest):
            self._distances.append(now - self._latest)
        self._latest = now
        if len(self._distances) == self._size:
            # As many distances as lines of a frame hold one pause, wherever they begin. The mean of
            # the others stands for them although many lines may come at once, by way of USB.
            others = sum(self._distances) - max(self._distances)
            self._usual = others / max(self._size - 1, 1)

    def _end(self) -> FrameLines | None:
        """The frame that has ended, if it is whole; the next begins."""
        group, count, whole = tuple(self._group), self._count, self._whole
        self._group, self._count, self._whole = [], 0, True
        if not whole:
            self.drops[FrameDrop.FIRST] += count
            return None
        if count != self._size:
            gone = max(1, round(count / self._size))
            self.drops[FrameDrop.INCOMPLETE] += count
            self.lost += gone
            self._number += gone
            self._counts.append(count)
            self._last = math.nan
            return None
        if not math.isnan(self._last):
            self._periods.append(self._began - self._last)
        self._last = self._began
        self._counts.clear()
        self._number += 1
        return FrameLines(self._number - 1, self._began, group)
