"""Board that prints lines of text: an evaluation board of the AD5940, or one of a frame a line.

Lines of one measurement carry no number and no sign of a frame's beginning. A frame begins at an
agreed line, the mark, or after a pause longer than the usual interval of lines. A frame with more
or fewer lines than measurements is lost and counted: no value is ever taken for that of another.
"""

import math
import re
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from eitskin.errors import ConfigurationError, DeviceError
from eitskin.files import quote_value, shorten_text
from eitskin.frame import Frame, Status
from eitskin.hardware.boards.board import PortBoard, longest_silence
from eitskin.hardware.boards.port import CHUNK, SerialPort, connector
from eitskin.hardware.boards.text_lines import (
    MAX_LINE,
    PAIRS,
    FrameFinder,
    FrameLines,
    LineDecoder,
    parse_values,
)
from eitskin.hardware.protocol.messages import Info
from eitskin.protocol import Protocol

BAUD = 230400
"""Presumed baud rate of the evaluation boards' example programs; not tried on a board."""
MIN_SILENCE = 1.0
"""Shortest silence that counts as a stale stream, at any frame rate [s]."""
FIRST_LINE_TIMEOUT = 10.0
"""Longest silence while the period is unknown [s]; two frames pass before the first is given."""
_HEXADECIMAL = re.compile(rb"\b(?:0x[\da-f]|(?=[a-f]*\d)(?=\d*[a-f])[\da-f]{4})", re.IGNORECASE)


class TextBoard(PortBoard[FrameLines]):
    """Board that prints lines; a `Board`.

    Such a board sends no frame numbers, sessions or times: frames are counted and timed as they
    come, and a restart cannot be distinguished from a pause.
    """

    def __init__(
        self,
        connect: Callable[[], SerialPort],
        uri: str,
        protocol: Protocol,
        mark: str = "",
        pause: float = math.nan,
        frequency: float = 40e3,
        skip: int = 0,
        pairs: str = "",
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Open the port.

        Args:
            connect: opens a port whose reads return soon; called again by `reconnect`.
            uri: name of the board in messages.
            protocol: one measurement for each line.
            mark: beginning of the line before each frame; pauses divide frames when empty.
            pause: shortest pause between frames [s]; three usual intervals of lines when NaN.
            frequency: excitation frequency where the lines do not give it [Hz].
            skip: numbers before the measurements of a line, such as a time.
            pairs: kind of measurements that are two numbers each: "deg" or "rad" for a magnitude
                and a phase, "imag" for a real and an imaginary part; one number when empty.
            clock: time that pauses and silence are measured by [s].
        """
        self.protocol, self._frequency = protocol, frequency
        self._decoder = LineDecoder(mark, len(protocol), skip, pairs)
        self._finder = FrameFinder(len(protocol), bool(mark.strip()), pause)
        self._session = 0
        self._begun = math.nan
        super().__init__(connect, uri, clock)

    @property
    def info(self) -> Info:
        """Settings as far as known, else NaN; the board gives no identity."""
        return Info.from_protocol(
            self.protocol,
            firmware="text lines",
            boot_count=self._session,
            frequency=self._finder.frequency,
            period=self._finder.period,
        )

    @property
    def lost(self) -> int:
        """Number of frames lost so far, by a wrong number of lines."""
        return self._finder.lost

    def _drops(self) -> Sequence[Mapping[Any, int]]:
        return (self._decoder.drops, self._finder.drops)

    def frames(self, newest: bool = False) -> Iterator[Frame]:
        self._restart()
        while True:
            # A full queue may lack lines between two others.
            if self._port.waiting() >= CHUNK - 1:
                self._restart()
            frame = self._next_frame()
            if newest:
                frame = self._newest_pending(frame)
            self._frames += 1
            yield frame

    def calibrate(self) -> None:
        raise ConfigurationError(
            "a board that prints text takes no requests; restart it, and it calibrates itself"
        )

    def reconnect(self) -> None:
        """Close the port and open it again, at another path if it has moved; begin a new session.

        Raises DeviceError where the port is absent; try again later.
        """
        self._port.reopen()
        self._finder.forget()
        self._reconnections += 1
        self._session += 1
        self._begun = math.nan

    def close(self) -> None:
        self._port.close()

    def _restart(self) -> None:
        """Discard waiting data, up to the next beginning of a frame."""
        self._port.clear()
        self._decoder.restart()
        self._finder.restart()
        self._inbox.clear()

    def _next_frame(self) -> Frame:
        patience = min(longest_silence(self._finder.period, MIN_SILENCE), FIRST_LINE_TIMEOUT)
        for lines in self._receive_items(patience):
            return self._frame(lines)
        drops = {reason.value: n for reason, n in sorted(self._decoder.drops.items())}
        received, unread = self._finder.received_instead(), self._decoder.unread
        numbers = parse_values(unread) or re.findall(rb"\d+(?:[.,]\d+)?", unread)
        if unread.isascii() and (count := len(numbers)):
            remedy = "correct protocol=, or leave numbers before them out by skip="
            if count in (2, 2 * len(self.protocol)):
                remedy += "; where two are one measurement, join them by pairs=deg, rad or imag"
            if _HEXADECIMAL.search(unread):
                remedy = "hexadecimal numbers are not read, let the board print decimal ones"
            received = (
                f"the last line that was not read has {count} numbers where the protocol has "
                f"{len(self.protocol)} measurements: '{shorten_text(unread.decode())}'; text: "
                f"reads one measurement a line, or all of a frame: {remedy}"
            )
        elif newest := self._decoder.newest[:MAX_LINE]:
            received += f"; the last line was {quote_value(newest.decode(errors='replace'))}"
            received += f" (dropped: {drops}; a wrong baud rate looks like this)" if drops else ""
        raise DeviceError(
            f"{self.uri}: the stream is stale, no frame came within {patience:.1f} s; {received}"
        )

    def _receive(self) -> None:
        data = self._port.read()
        self._inbox.extend(self._finder.feed(self._clock(), self._decoder.feed(data)))

    def _frame(self, item: FrameLines) -> Frame:
        # Single precision, as in packets and recordings; larger values become infinite.
        with np.errstate(over="ignore"):
            impedance = np.array([line.impedance for line in item.measurements], np.complex64)
        status = np.where(np.isfinite(impedance), 0, np.uint8(Status.NOT_FINITE))
        if math.isnan(self._begun):
            self._begun = item.time
        frequency = item.measurements[-1].frequency
        return Frame(
            impedance=impedance.astype(np.complex128),
            protocol=self.protocol,
            time=item.time - self._begun,
            number=item.number,
            session=self._session,
            frequency=self._frequency if math.isnan(frequency) else frequency,
            status=status.astype(np.uint8),
        )


def open_text(
    path: str,
    uri: str,
    protocol: str = "",
    baud: int = BAUD,
    usb: str = "",
    mark: str = "",
    pause: float = math.nan,
    frequency: float = 40e3,
    skip: int = 0,
    pairs: str = "",
) -> TextBoard:
    """Open a board that prints lines, at the serial port `path` or the USB device `usb`.

    Raises:
        ConfigurationError: for no port, no protocol, or an option out of range.
        DeviceError: where the port cannot be opened.
    """
    if not protocol:
        raise ConfigurationError(
            f"{uri}: a board of text does not say what it measures; add protocol=, such as "
            "text:/dev/ttyACM0?protocol=pairwise:8"
        )
    if pause <= 0.0 or frequency <= 0.0 or skip < 0:
        raise ConfigurationError(
            f"{uri}: pause and frequency must be positive, and skip not negative"
        )
    if pairs not in ("", *PAIRS):
        raise ConfigurationError(f"{uri}: pairs must be one of {', '.join(PAIRS)}, got '{pairs}'")
    measured, connect = Protocol.from_name(protocol), connector(path, uri, baud, usb)
    return TextBoard(connect, uri, measured, mark, pause, frequency, skip, pairs)
