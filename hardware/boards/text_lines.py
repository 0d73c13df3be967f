"""The lines of text that the example programs of the AD5940's evaluation boards print.

Impedance and body impedance: `Freq:40000.00 RzMag: 612.5 Ohm , RzPhase: -1.25`, magnitude in ohm
and phase in degrees; "Freq:" comes once for several lines, or with each, or not at all. Two-wire
bioimpedance: `Freq:40000.00 Impedance:(Real,Imaginary) = (612.3,-13.4)`, in ohm. Lines carry no
checksum: a digit that is damaged into another digit goes unseen.
"""

import math
import re
from collections import Counter
from dataclasses import dataclass
from enum import StrEnum

LONGEST = 256
"""Bytes of a line; the programs print less than half of that."""

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
    """Why a line was thrown away."""

    TOO_LONG = "line too long"
    UNKNOWN = "line that is no measurement"


@dataclass(frozen=True, slots=True)
class Measurement:
    """One line of one measurement.

    Attributes:
        impedance: [ohm]; NaN where the board printed no number, as it does without a current.
        frequency: [Hz]; NaN where no line said it.
    """

    impedance: complex
    frequency: float = math.nan


@dataclass(frozen=True, slots=True)
class Mark:
    """The line that begins a frame."""


Line = Measurement | Mark


class LineDecoder:
    """Bytes in, lines out. Bytes of any kind, cut anywhere, never raise.

    Attributes:
        drops: lines thrown away, by reason; empty lines are none.
    """

    def __init__(self, mark: str = "") -> None:
        """Take the lines that begin with `mark` for the beginnings of frames; none when empty."""
        self.drops: Counter[LineDrop] = Counter()
        self._mark = b" ".join(mark.encode().split())
        self._frequency = math.nan
        self._begun = bytearray()
        self._overflown = False

    def restart(self) -> None:
        """Forget the line that has begun, and the frequency."""
        self._begun.clear()
        self._overflown = False
        self._frequency = math.nan

    def feed(self, data: bytes) -> list[Line]:
        """The lines that end in `data`."""
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
        """What the line says that has ended; None where it is empty, dropped or only informs."""
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
    """NaN for what is no finite number, or too large for one."""
    value = float(text.partition(b"(")[0]) if text is not None else math.nan
    return value if math.isfinite(value) else math.nan


def _from_polar(magnitude: float, phase_deg: float) -> complex:
    """The phase is the difference of two, so it may be off by a turn; a magnitude is positive."""
    if magnitude < 0.0:
        return complex(math.nan, math.nan)
    phase = math.radians(math.remainder(phase_deg, 360.0))
    return complex(magnitude * math.cos(phase), magnitude * math.sin(phase))
