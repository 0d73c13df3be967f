"""A board that prints lines of text: an evaluation board of the AD5940 behind multiplexers.

Nothing in such a stream says where a frame begins, nor numbers the lines. A frame begins at a line
that is agreed on, the mark, or after a pause that is longer than the usual distance of lines. What
then has not as many lines as the protocol has measurements is lost and counted: no value is ever
taken for that of another measurement.
"""

import math
import time
from collections import deque
from collections.abc import Callable, Iterator

import numpy as np

from eitskin.closeable import Closeable
from eitskin.datasets.recordings import parse_protocol
from eitskin.errors import ConfigurationError, DeviceError
from eitskin.frame import Frame, Status
from eitskin.hardware.boards.board import Counts, longest_silence
from eitskin.hardware.boards.port import SerialPort, connector
from eitskin.hardware.boards.reopenable_port import BACKLOG, CHUNK, ReopenablePort
from eitskin.hardware.boards.text_frames import FrameFinder, FrameLines
from eitskin.hardware.boards.text_lines import LineDecoder
from eitskin.hardware.protocol.messages import Info, Table
from eitskin.protocol import Protocol

BAUD = 230400
"""Believed to be that of the evaluation boards' example programs; no board was there to ask."""
SHORTEST = 1.0
"""Silence that is borne from boards of any rate [s]."""
FIRST_WITHIN = 10.0
"""A frame must come within, while its period is not known [s]; two pass before the first."""


class TextBoard(Closeable):
    """A board that prints lines; see `eitskin.hardware.Board`.

    It has no numbers, no sessions and no clock: frames are counted and timed as they come, and one
    that restarts cannot be told from one that paused.

    Attributes:
        uri: what it was opened as.
        protocol: what is measured, in the order of the lines.
        stage: None, it is no virtual board.
    """

    stage = None

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
            connect: gives an open port, which reads what there is after a short while; called again
                by `reconnect`.
            uri: to name it in messages.
            protocol: one measurement for each line.
            mark: how the line before each frame begins; frames are found by pauses when empty.
            pause: that ends a frame [s]; three times the usual distance of lines when NaN.
            frequency: of the excitation where the lines do not say it [Hz].
            clock: seconds, to tell pauses and silence.
        """
        self.uri, self.protocol = uri, protocol
        self._clock, self._frequency = clock, frequency
        self._decoder = LineDecoder(mark)
        self._finder = FrameFinder(len(protocol), bool(mark.strip()), pause)
        self._found: deque[FrameLines] = deque()
        self._frames = self._skipped = self._reconnections = self._session = 0
        self._begun = math.nan
        self._port = ReopenablePort(connect, uri)

    @property
    def info(self) -> Info:
        """Who it is, of which it says nothing; what it measures as far as known, else NaN."""
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
        """Frames lost so far: what came between two beginnings and had not all lines."""
        return self._finder.lost

    @property
    def counts(self) -> Counts:
        """What has come through so far."""
        dropped = {reason.value: n for reason, n in sorted(self._decoder.drops.items())}
        dropped |= {reason.value: n for reason, n in sorted(self._finder.drops.items())}
        return Counts(self._frames, self.lost, self._skipped, dropped, self._reconnections)

    def frames(self, newest: bool = False) -> Iterator[Frame]:
        """Give the frames as they come, from the next beginning on.

        Args:
            newest: give only the newest of the frames that are waiting; the others are counted
                as skipped.

        Raises DeviceError where three periods pass without a frame, or the board goes away.
        """
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
        """Raises ConfigurationError."""
        raise ConfigurationError(
            "a board that prints text takes no requests; restart it, and it calibrates itself"
        )

    def reconnect(self) -> None:
        """Let go of the port and open it again, wherever it is now; a new session begins.

        Raises DeviceError where it is not there; try again later.
        """
        self._port.reopen()
        self._finder.forget()
        self._reconnections += 1
        self._session += 1
        self._begun = math.nan

    def close(self) -> None:
        self._port.close()

    def _restart(self) -> None:
        """Throw away what waits, and wait for the next beginning of a frame."""
        self._port.clear()
        self._decoder.restart()
        self._finder.restart()
        self._found.clear()

    def _overflows(self) -> bool:
        """Whether the port is full: lines from within two frames may then follow each other."""
        return self._port.waiting() >= CHUNK - 1

    def _next(self) -> FrameLines:
        period = self._finder.period
        patience = min(longest_silence(period, SHORTEST), FIRST_WITHIN)
        deadline = self._clock() + patience
        # Look before giving up: this process may have slept past the deadline itself.
        while not self._found:
            self._receive()
            if not self._found and self._clock() >= deadline:
                raise DeviceError(
                    f"{self.uri}: the stream is stale, no frame came within {patience:.1f} s; "
                    f"{self._finder.received_instead()}{self._damage()}"
                )
        return self._found.popleft()

    def _overtaken_by(self, lines: FrameLines) -> FrameLines:
        """The newest frame among those that have arrived by now, `lines` if there is none."""
        # A board that never pauses is not followed for ever.
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
        """Read once; waits a short while at most."""
        data = self._port.read()
        self._found.extend(self._finder.feed(self._clock(), self._decoder.feed(data)))

    def _frame(self, lines: FrameLines) -> Frame:
        # In single precision, as packets are and recordings keep it; what it cannot hold is inf.
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
    """Open the board that prints lines at the serial port `path`, or of the USB device `usb`.

    Raises:
        ConfigurationError: where no port or protocol is named, or an option cannot be.
        DeviceError: where the port cannot be opened.
    """
    if not protocol:
        raise ConfigurationError(
            f"{uri}: a board of text does not say what it measures; add protocol=, such as "
            "text:/dev/ttyACM0?protocol=pairwise:8"
        )
    if pause <= 0.0 or frequency <= 0.0:
        raise ConfigurationError(f"{uri}: pause and frequency must be positive")
    measured = parse_protocol(protocol)
    return TextBoard(connector(path, uri, baud, usb), uri, measured, mark, pause, frequency)
