"""Lines of text printed by the example programs of the AD5940's evaluation boards, and frames.

Impedance and body impedance: `Freq:40000.00 RzMag: 612.5 Ohm , RzPhase: -1.25`, magnitude in ohm
and phase in degrees; "Freq:" comes once for several lines, in each line, or not at all. Two-wire
bioimpedance: `Freq:40000.00 Impedance:(Real,Imaginary) = (612.3,-13.4)`, in ohm. Others print one
number a line, those of a drive pair, or all of a frame: `magnitudes : 612.5 , 598.1 ,`,
`612.5, 598.1` or JSON. Lines carry no checksum: a digit damaged into another goes unseen.
"""

import cmath
import json
import math
import re
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from enum import StrEnum
from statistics import median
from typing import Any

MAX_LINE = 256
"""Longest line with one measurement [bytes]; the programs print less than half as many."""
BYTES_PER_VALUE = 64
"""Most bytes of a value in a line of many."""

_NUMBER = (
    rb"([+-]?(?:\d{1,64}(?:\.\d{0,32}|,\d{1,32})?(?:e[+-]?\d{1,4})?"
    rb"|nan(?:\([^)\s]*\))?|inf(?:inity)?))"
)
_FREQUENCY = rb"(?:freq\s*:\s*" + _NUMBER + rb"\s*(?:\(?hz\)?)?\s*,?\s*)?"
_OHM, _BETWEEN = rb"\s*(k?)(?:ohms?)?", rb"[\s,;/]*"
_POLAR = re.compile(
    rb"(?:[a-z]+ ?\d+ ?[-:] ?)?" + _FREQUENCY
    + rb"(?:rzmag|magnitude|mag|impedance|\|?z\|?)\s*[:=]\s*" + _NUMBER + _OHM + _BETWEEN
    + rb"(?:rzphase|phase|phi|theta)\s*[:=]\s*" + _NUMBER + rb"\s*(rad)?(?:deg(?:rees)?)?",
    re.IGNORECASE,
)  # fmt: skip
_CARTESIAN = re.compile(
    _FREQUENCY
    + rb"(?:impedance\s*:\s*\(real\s*,\s*imag\w*\)\s*=\s*\(|(?:real|re|r)\s*[:=]\s*)"
    + _NUMBER + _OHM + _BETWEEN + rb"(?:(?:imag\w*|im|x|i)\s*[:=]\s*)?" + _NUMBER
    + rb"\s*(?:ohms?|\))?",
    re.IGNORECASE,
)  # fmt: skip
_FREQUENCY_ALONE = re.compile(_FREQUENCY, re.IGNORECASE)


_TIME = re.compile(rb"\[[^\]]*\d:\d\d[^\]]*\]\s*|[\dT:., -]+ ->\s*")
"""Time that a terminal puts before a line."""
_PREFIX = re.compile(
    rb"(?:[a-z_|$][\w |.-]*(?:[(\[][^)\]]*[)\]]\s*)?[:=]|"
    rb"[$<]?(?!nan|inf)[a-z_]+[,;]|\d{1,4}(?:-\d{1,4})?:)?",
    re.IGNORECASE,
)
"""Label of a line, or the number of a measurement."""
_SUFFIX = re.compile(rb"(?:[,;]\s*(?:[a-z]|end|stop)|\*[\da-f]{2})$", re.IGNORECASE)
"""Word or checksum behind the numbers."""
_NAMES = re.compile(rb"(?<![\w.])(?:[a-z_]+\d+\s*[=:]|\d{1,4}:)", re.IGNORECASE)
_UNITS = re.compile(rb"(?<=[\d. ])(k?)ohms?\b", re.IGNORECASE)
_NOT_FINITE = re.compile(rb"(?<![\w\"])[+-]?(?:nan|inf(?:inity)?)\b", re.IGNORECASE)
_PARTS = (("real", "imag"), ("re", "im"), ("magnitude", "phase"), ("mag", "phase"))


class LineDrop(StrEnum):
    """Reasons for dropping a line."""

    TOO_LONG = "line too long"
    UNKNOWN = "line that is no measurement"


@dataclass(frozen=True, slots=True)
class Measurement:
    """Line with one measurement.

    Attributes:
        impedance: impedance [ohm]; NaN for no finite number, printed by a board without current.
        frequency: excitation frequency [Hz]; NaN where no line gave it.
    """

    impedance: complex
    frequency: float = math.nan


@dataclass(frozen=True, slots=True)
class Mark:
    """Line that begins a frame."""


@dataclass(frozen=True, slots=True)
class FrameLine:
    """Line with all measurements of a frame, or with those of a part of it."""

    measurements: tuple[Measurement, ...]


Line = Measurement | Mark | FrameLine


class LineDecoder:
    """Decoder of a byte stream, in chunks of any size, into lines; no byte raises an error.

    Attributes:
        drops: count of dropped lines, by reason; empty lines do not count.
        newest: newest line of all, and `unread` where it is no measurement.
    """

    def __init__(self, mark: str = "", size: int = 0, skip: int = 0, pairs: str = "") -> None:
        """Take lines that begin with `mark` as beginnings of frames; no line when empty.

        Lines of `size` numbers are whole frames, and lines of one number, or of numbers that
        divide `size`, parts of one. No part counts after a line with more: it would be a rest.
        The first `skip` numbers of a line, such as a time, are left out. Each two of the others are
        one measurement where `pairs` is one of `PAIRS`.
        """
        self._skip, self._pairs = skip, pairs
        self._size, self._longest = size, max(MAX_LINE, BYTES_PER_VALUE * size)
        self._most = 1
        self.unread = self.newest = b""
        self._cut = False
        self.drops: Counter[LineDrop] = Counter()
        self._mark = b" ".join(mark.encode().split())
        self._frequency = math.nan
        self._begun = bytearray()
        self._overflown = False

    def restart(self) -> None:
        """Discard the unfinished line, whose rest may come, and the frequency."""
        self._cut = True
        self._begun.clear()
        self._overflown = False
        self._frequency = math.nan

    def feed(self, data: bytes) -> list[Line]:
        """Lines completed by `data`."""
        *ended, begun = re.split(rb"[\r\n]", data)
        lines = []
        for part in ended:
            self._append(part)
            line = self._end()
            if line is not None:
                lines.append(line)
        self._append(begun)
        return lines

    def _append(self, part: bytes) -> None:
        self._begun += part
        self._overflown |= len(self._begun) > self._longest
        del self._begun[self._longest :]

    def _end(self) -> Line | None:
        """Content of the line that has ended; None for one empty, dropped, or without impedance."""
        text, overflown = b" ".join(self._begun.strip(b"\0").split()), self._overflown
        cut, self._cut = self._cut, False
        self._begun.clear()
        self._overflown = False
        self.newest = text or self.newest
        if overflown:
            self.drops[LineDrop.TOO_LONG] += 1
            self.unread = text
        elif self._mark and text.startswith(self._mark):
            return Mark()
        elif text:
            return self._read(text, cut)
        return None

    def _read(self, text: bytes, cut: bool) -> Measurement | FrameLine | None:
        if polar := _POLAR.fullmatch(text):
            frequency, magnitude, phase = (_number(polar[group]) for group in (1, 2, 4))
            degrees = math.degrees(phase) if polar[5] else phase
            impedance = _from_polar(magnitude * (1e3 if polar[3] else 1.0), degrees)
        elif polar := _CARTESIAN.fullmatch(text):
            frequency, *parts = (_number(polar[group]) for group in (1, 2, 4))
            impedance = complex(*parts) * (1e3 if polar[3] else 1.0)
        elif polar := _FREQUENCY_ALONE.fullmatch(text):
            self._frequency = _number(polar[1])
            return None
        else:
            return self._read_values(text, cut)
        self._most, self.unread = max(self._size, 1), b""
        if polar[1] is not None:
            self._frequency = frequency
        return Measurement(_finite(impedance), self._frequency)

    def _read_values(self, text: bytes, cut: bool) -> FrameLine | None:
        """Frame, or part of one, in a line of numbers; None for another line, which is dropped."""
        values = [] if cut or not self._size else parse_values(text, self._size)
        values = values[self._skip :]
        if self._pairs:
            first, second = values[::2], values[1::2]
            join, even = PAIRS[self._pairs], len(first) == len(second)
            values = [join(*each) for each in zip(first, second, strict=True)] if even else []
        count = len(values)
        alone = count == 1 and b"," in text and not self._pairs
        if count < self._most or self._size % count or alone:
            self.drops[LineDrop.UNKNOWN] += 1
            self.unread = text
            return None
        self._most, self.unread = count, b""
        return FrameLine(tuple(Measurement(_finite(v), self._frequency) for v in values))


def parse_values(text: bytes, size: int = 0) -> list[complex]:
    """Numbers of a line that has nothing else but labels, as "magnitudes : 1 , 2 ," or in JSON.

    None where there are other words. JSON has one list, lists of two parts of `size` complex
    numbers, or a number for each of `size` names that end in digits.
    """
    if time := _TIME.match(text):
        text = text[time.end() :]
    for mark in (b'"', b"'"):  # as Python prints it
        with suppress(ValueError, RecursionError):
            read = json.loads(_NOT_FINITE.sub(b"null", text).replace(mark, b'"'))
            if isinstance(read, list | dict):
                return _row_values(read, size)
    label = _PREFIX.match(text)
    body = _SUFFIX.sub(b"", text[label.end() if label else 0 :].strip(b" ,;|[](){}<>"))
    units = _UNITS.findall(body) or [b"k" * (label is not None and b"kohm" in label[0].lower())]
    factor = 1e3 if all(units) else 1.0
    body = _NAMES.sub(b"", _UNITS.sub(b"", body))
    if re.search(rb"\d,\d+(?:[;|]| (?!,))", body) and b"." not in body:
        body = body.replace(b",", b".")
    try:
        cells = re.split(r"\s*[;,|]\s*|\s+", body.decode("ascii").strip(" ,;|"))
        return [factor * complex(cell.replace("i", "j")) for cell in cells]
    except ValueError:
        return []


def _row_values(read: Any, size: int) -> list[complex]:
    """Numbers in JSON of a line."""
    members = {"": read} if isinstance(read, list) else read
    inner = [value for value in members.values() if isinstance(value, dict)]
    if len(inner) == 1 and not any(isinstance(value, list) for value in members.values()):
        return _row_values(inner[0], size)
    named = [_cell(v) for key, v in members.items() if key[-1:].isdigit()]
    lists = {
        key.casefold(): [_cell(v) for v in values]
        for key, values in members.items()
        if isinstance(values, list)
    }
    for first, second in _PARTS:
        if {first, second} <= set(lists):
            pairs = zip(lists[first], lists[second], strict=True)
            parts = [(one.real, other.real) for one, other in pairs]
            return [_from_polar(*p) if second == "phase" else complex(*p) for p in parts]
    chosen = [each for each in lists.values() if len(each) == size] or list(lists.values())
    return list(map(complex, chosen[0] if len(chosen) == 1 else named))


def _cell(value: Any) -> complex:
    """Number in JSON, also as text or as a list of real and imaginary part; NaN for another."""
    if isinstance(value, list) and len(value) == 2:
        return complex(_cell(value[0]).real, _cell(value[1]).real)
    with suppress(ValueError, TypeError, OverflowError):
        return complex(value)
    return complex(math.nan)


def _finite(value: complex) -> complex:
    """The value, or NaN where it is not finite."""
    return value if cmath.isfinite(value) else complex(math.nan, math.nan)


def _number(text: bytes | None) -> float:
    """Number in `text`; NaN where it is not finite."""
    value = float(text.partition(b"(")[0].replace(b",", b".")) if text is not None else math.nan
    return value if math.isfinite(value) else math.nan


def _from_polar(magnitude: float, phase_deg: float) -> complex:
    """Impedance of a magnitude [ohm] and a phase, which may be off by whole turns."""
    if magnitude < 0.0 or not math.isfinite(phase_deg):
        return complex(math.nan, math.nan)
    phase = math.radians(math.remainder(phase_deg, 360.0))
    return complex(magnitude * math.cos(phase), magnitude * math.sin(phase))


PAIRS: Mapping[str, Callable[[complex, complex], complex]] = {
    "deg": lambda size, phase: _from_polar(size.real, phase.real),
    "rad": lambda size, phase: _from_polar(size.real, math.degrees(phase.real)),
    "imag": lambda real, imaginary: complex(real.real, imaginary.real),
}
"""Measurements of two numbers: magnitude and phase, or real and imaginary part."""

PAUSE = 3.0
"""Shortest pause, in usual intervals between lines."""
RUNS = 4  # frames' worth of runs of intervals, whose median shows the usual one


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
            elif isinstance(line, FrameLine) and len(line.measurements) < self._size:
                self._take(now, line.measurements)
            elif isinstance(line, FrameLine):
                self._began, self._whole = now, True
                self._group, self._count = list(line.measurements), self._size
                self.frequency = line.measurements[-1].frequency
                ended.append(self._end())
            else:
                self._take(now, (line,))
        return [frame for frame in ended if frame is not None]

    def received_instead(self) -> str:
        """Description of the lines that came instead of a frame, with a remedy."""
        if self._counts:
            found = ", ".join(map(str, self._counts))
            twice = ", or join the two numbers of each by pairs="
            return (
                f"its last frames had {found} measurements where {self._size} were expected; check "
                "the protocol, or separate frames by mark= or pause="
                f"{twice if 2 * self._size in self._counts else ''}"
            )
        if self._count:
            what = "no line with the mark" if self._marked else "no pause"
            return f"lines come, but {what}; separate frames by mark= or pause="
        return "no measurement came; check power, cable and baud rate"

    @property
    def _longest(self) -> float:
        """Longest interval between lines of one frame [s]; infinite while unknown."""
        if not math.isnan(self._pause):
            return self._pause
        return math.inf if math.isnan(self._usual) else PAUSE * self._usual

    def _take(self, now: float, measurements: Sequence[Measurement]) -> None:
        """Add the measurements of one line."""
        if not self._count:
            self._began = now
        self._count += len(measurements)
        if self._count <= self._size:
            self._group += measurements
        if not math.isnan(measurements[-1].frequency):
            self.frequency = measurements[-1].frequency
        if not math.isnan(self._latest):
            self._distances.append(now - self._latest)
        self._latest = now
        lines = self._size // len(measurements)
        if len(self._distances) >= lines:
            # Any run of as many intervals as a frame has lines holds one pause. The mean of the
            # others is their usual value, although many lines may come at once, by way of USB.
            run = list(self._distances)[-lines:]
            self._means.append((sum(run) - max(run)) / max(lines - 1, 1))
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
