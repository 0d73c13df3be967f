"""Division of a stream of lines into frames, by marks or pauses."""

import math
from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from statistics import median

from eitskin.hardware.boards.text_lines import Line, Mark, Measurement

PAUSE = 3.0
"""Shortest pause, in usual intervals between lines."""
RUNS = 4  # frames' worth of runs of intervals, whose median tells the usual one


class FrameDrop(StrEnum):
    """Reasons for dropping a whole measurement."""

    FIRST = "measurement before the first whole frame"
    INCOMPLETE = "measurement of an incomplete frame"


@dataclass(frozen=True, slots=True, eq=False)
class FrameLines:
    """Lines of one frame.

    Attributes:
        number: count of frames, lost ones included.
        time: arrival of the first line, on the host's clock [s].
        measurements: one for each measurement of the protocol.
    """

    number: int
    time: float
    measurements: tuple[Measurement, ...]


class FrameFinder:
    """Divider of lines into frames: groups of the right length between marks or pauses.

    Attributes:
        lost: frames lost in groups of another length, at least one for each group.
        drops: count of dropped measurements, by reason.
        frequency: excitation frequency in the newest line that had one [Hz]; NaN before.
    """

    def __init__(self, size: int, marked: bool, pause: float = math.nan) -> None:
        """Divide into frames of `size` lines by marks or by a `pause` [s]; NaN finds the pause."""
        self.lost = 0
        self.drops: Counter[FrameDrop] = Counter()
        self.frequency = math.nan
        self._size, self._marked, self._pause = size, marked, pause
        self._number = 0
        self._counts: deque[int] = deque(maxlen=3)
        self.forget()

    @property
    def period(self) -> float:
        """Median time from one frame to the next [s]; NaN while unknown."""
        return float(median(self._periods)) if self._periods else math.nan

    def forget(self) -> None:
        """Begin with another stream: forget intervals and periods."""
        self._usual = math.nan
        self._means: deque[float] = deque(maxlen=RUNS * self._size)
        self._periods: deque[float] = deque(maxlen=9)
        self._counts.clear()
        self.restart()

    def restart(self) -> None:
        """Discard the frame that has begun and wait for the next beginning."""
        self._latest = math.nan
        self._distances: deque[float] = deque(maxlen=self._size)
        self._group: list[Measurement] = []
        self._count = 0
        self._whole = False
        self._began = self._last = math.nan

    def feed(self, now: float, lines: Sequence[Line]) -> list[FrameLines]:
        """Frames that have ended by `now` [s], the arrival of `lines`."""
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
        """Description of the lines that came instead of a frame, with a remedy."""
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
        """Longest interval between lines of one frame [s]; infinite while unknown."""
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
            # Any run of as many intervals as a frame has lines holds one pause. The mean of the
            # others is their usual value, although many lines may come at once, by way of USB.
            others = sum(self._distances) - max(self._distances)
            self._means.append(others / max(self._size - 1, 1))
            # Lines that are lost put several pauses into a run, for as long as it is.
            self._usual = float(median(self._means))

    def _end(self) -> FrameLines | None:
        """Frame that has ended, None for an incomplete one; the next begins."""
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
