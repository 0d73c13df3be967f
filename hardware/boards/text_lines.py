"""Lines of text printed by the example programs of the AD5940's evaluation boards.

Impedance and body impedance: `Freq:40000.00 RzMag: 612.5 Ohm , RzPhase: -1.25`, magnitude in ohm
and phase in degrees; "Freq:" comes once for several lines, in each line, or not at all. Two-wire
bioimpedance: `Freq:40000.00 Impedance:(Real,Imaginary) = (612.3,-13.4)`, in ohm. Lines carry no
checksum: a digit that is damaged into another digit goes unseen.
"""

import math
import re
from collections import Counter
from dataclasses import dataclass
from enum import StrEnum

LONGEST = 256
"""Longest line [bytes]; the programs print less than half as many."""

_NUMBER = rb"([+-]?(?:\d{1,64}(?:\.\d{0,32})?(?:e[+-]?\d{1,4})?|nan(?:\([^)\s]*\))?|inf(?:inity)?))"
_FREQUENCY = rb"(?:freq\s*:\s*" + _NUMBER + rb"\s*(?:\(?hz\)?)?\s*,?\s*)?"
_POLAR = re.compile(
    _FREQUENCY
    + rb"(?:rzmag\s*:\s*" + _NUMBER + rb"\s*ohm\s*,\s*rzphase\s*:\s*" + _NUMBER + rb"\s*(?:deg)?)",
    re.IGNORECASE,
)  # fmt: skip
_CARTESIAN = re.compile(
    _FREQUENCY
    + rb"impedance\s*:\s*\(real\s*,\s*imag\w*\)\s*=\s*"
    + rb"\(" + _NUMBER + rb"\s*,\s*" + _NUMBER + rb"\)",
    re.IGNORECASE,
)  # fmt: skip
_FREQUENCY_ALONE = re.compile(_FREQUENCY, re.IGNORECASE)


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


Line = Measurement | Mark


class LineDecoder:
    """Decoder of a byte stream, in chunks of any size, into lines; no byte raises an error.

    Attributes:
        drops: count of dropped lines, by reason; empty lines do not count.
    """

    def __init__(self, mark: str = "") -> None:
        """Take lines that begin with `mark` as beginnings of frames; no line when empty."""
        self.drops: Counter[LineDrop] = Counter()
        self._mark = b" ".join(mark.encode().split())
        self._frequency = math.nan
        self._begun = bytearray()
        self._overflown = False

    def restart(self) -> None:
        """Discard the unfinished line, and the frequency."""
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
        self._overflown |= len(self._begun) > LONGEST
        del self._begun[LONGEST:]

    def _end(self) -> Line | None:
        """Content of the line that has ended; None for one empty, dropped, or without impedance."""
        text, overflown = b" ".join(self._begun.strip(b"\0").split()), self._overflown
        self._begun.clear()
        self._overflown = False
        if overflown:
            self.drops[LineDrop.TOO_LONG] += 1
        elif self._mark and text.startswith(self._mark):
            return Mark()
        elif text:
            return self._read(text)
        return None

    def _read(self, text: bytes) -> Measurement | None:
        if found := _POLAR.fullmatch(text):
            frequency, magnitude, phase = map(_number, found.groups())
            impedance = _from_polar(magnitude, phase)
        elif found := _CARTESIAN.fullmatch(text):
            frequency, *parts = map(_number, found.groups())
            impedance = complex(*parts)
        elif found := _FREQUENCY_ALONE.fullmatch(text):
            self._frequency = _number(found[1])
            return None
        else:
            self.drops[LineDrop.UNKNOWN] += 1
            return None
        if found[1] is not None:
            self._frequency = frequency
        known = math.isfinite(impedance.real) and math.isfinite(impedance.imag)
        return Measurement(impedance if known else complex(math.nan, math.nan), self._frequency)


def _number(text: bytes | None) -> float:
    """Number in `text`; NaN where it is not finite."""
    value = float(text.partition(b"(")[0]) if text is not None else math.nan
    return value if math.isfinite(value) else math.nan


def _from_polar(magnitude: float, phase_deg: float) -> complex:
    """Impedance of a magnitude [ohm] and a phase, which may be off by whole turns."""
    if magnitude < 0.0:
        return complex(math.nan, math.nan)
    phase = math.radians(math.remainder(phase_deg, 360.0))
    return complex(magnitude * math.cos(phase), magnitude * math.sin(phase))
