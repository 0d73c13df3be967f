"""Board that prints lines of text: an evaluation board of the AD5940 behind multiplexers.

The lines carry no number and no sign of a frame's beginning. A frame begins at an agreed line, the
mark, or after a pause longer than the usual interval of lines. A frame with more or fewer lines
than the protocol has measurements is lost and counted: no value is ever taken for that of another
measurement.
"""

import math
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from eitskin.errors import ConfigurationError, DeviceError
from eitskin.frame import Frame, Status
from eitskin.hardware.boards.board import Board, longest_silence
from eitskin.hardware.boards.port import BACKLOG, CHUNK, ReopenablePort, SerialPort, connector
from eitskin.hardware.boards.text_lines import FrameFinder, FrameLines, LineDecoder
from eitskin.hardware.protocol.messages import Info, Table
from eitskin.protocol import Protocol

BAUD = 230400
"""Presumed baud rate of the evaluation boards' example programs; not tried on a board."""
SHORTEST = 1.0
"""Shortest silence that counts as a stale stream, at any frame rate [s]."""
FIRST_WITHIN = 10.0
"""Longest silence while the period is unknown [s]; two frames pass before the first is given."""


class TextBoard(Board):
    """Board that prints lines; a `Board`.

    Such a board sends no frame numbers, sessions or times: frames are counted and timed as they
    come, and a restart cannot be told from a pause.
    """

    def __init__(
        self,
        connect: Callable[[], SerialPort],
        uri: str,
        protocol: Protocol,
        mark: str = "",
        pause: float = math.nan,
        frequency: float = 40e3,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Open the port.

        Args:
            connect: opens a port whose reads return after a short while; called again by
                `reconnect`.
            uri: name of the board in messages.
            protocol: one measurement for each line.
            mark: beginning of the line before each frame; pauses divide frames when empty.
            pause: shortest pause between frames [s]; three times the usual interval of lines when
                NaN.
            frequency: excitation frequency where the lines do not give it [Hz].
            clock: time that pauses and silence are measured by [s].
        """
        self.uri, self.protocol = uri, protocol
        self._clock, self._frequency = clock, frequency
        self._decoder = LineDecoder(mark)
        self._finder = FrameFinder(len(protocol), bool(mark.strip()), pause)
        self._found: deque[FrameLines] = deque()
        self._session = 0
        self._begun = math.nan
        self._port = ReopenablePort(connect, uri)

    @property
    def info(self) -> Info:
        """Settings as far as known, else NaN; the board gives no identity."""
        return Info(
            firmware="text lines",
            uid=bytes(12),
            boot_count=self._session,
            n_electrodes=self.protocol.n_electrodes,
            n_measurements=len(self.protocol),
            table_crc32=Table.of(self.protocol).crc32,
            frequency=self._finder.frequency,
            amplitude=math.nan,
            rtia=math.nan,
            rcal=math.nan,
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
            if self._overflows():
                self._restart()
            lines = self._next()
            if newest:
                lines = self._overtaken_by(lines)
            self._frames += 1
            yield self._frame(lines)

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
        self._found.clear()

    def _overflows(self) -> bool:
        """Whether the port's queue is full, so that lines may be missing between two others."""
        return self._port.waiting() >= CHUNK - 1

    def _next(self) -> FrameLines:
        period = self._finder.period
        patience = min(longest_silence(period, SHORTEST), FIRST_WITHIN)
        deadline = self._clock() + patience
        # Read before giving up: this process itself may have slept past the deadline.
        while not self._found:
            self._receive()
            if not self._found and self._clock() >= deadline:
                raise DeviceError(
                    f"{self.uri}: the stream is stale, no frame came within {patience:.1f} s; "
                    f"{self._finder.received_instead()}{self._damage()}"
                )
        return self._found.popleft()

    def _overtaken_by(self, lines: FrameLines) -> FrameLines:
        """Newest of `lines` and the frames that have arrived since."""
        # Bounded, since a board may never pause.
        for _ in range(BACKLOG // CHUNK):
            while self._found:
                lines = self._found.popleft()
                self._skipped += 1
            if not self._port.waiting():
                break
            self._receive()
        return lines

    def _damage(self) -> str:
        drops = {reason.value: n for reason, n in sorted(self._decoder.drops.items())}
        return f" (dropped: {drops}; a wrong baud rate looks like this)" if drops else ""

    def _receive(self) -> None:
        """Read the port once; waits a short while at most."""
        data = self._port.read()
        self._found.extend(self._finder.feed(self._clock(), self._decoder.feed(data)))

    def _frame(self, lines: FrameLines) -> Frame:
        # Single precision, as in packets and recordings; larger values become infinite.
        with np.errstate(over="ignore"):
            impedance = np.array([line.impedance for line in lines.measurements], np.complex64)
        status = np.where(np.isfinite(impedance), 0, np.uint8(Status.NOT_FINITE))
        if math.isnan(self._begun):
            self._begun = lines.time
        said = lines.measurements[-1].frequency
        return Frame(
            impedance=impedance.astype(np.complex128),
            protocol=self.protocol,
            time=lines.time - self._begun,
            number=lines.number,
            session=self._session,
            frequency=self._frequency if math.isnan(said) else said,
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
    if pause <= 0.0 or frequency <= 0.0:
        raise ConfigurationError(f"{uri}: pause and frequency must be positive")
    measured = Protocol.named(protocol)
    return TextBoard(connector(path, uri, baud, usb), uri, measured, mark, pause, frequency)
