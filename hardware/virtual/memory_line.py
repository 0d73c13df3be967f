"""Line in memory to a virtual board, which measures the frames that are due when the host reads."""

import errno
import threading
import time
from collections.abc import Callable

from eitskin.closeable import Closeable
from eitskin.errors import DeviceError
from eitskin.hardware.boards.port import remedy
from eitskin.hardware.virtual.fault import UnpluggedError
from eitskin.hardware.virtual.virtual_firmware import VirtualFirmware

_POLL = 0.05  # s, longest wait of a read, as of a real port
_BACKLOG = 16384  # bytes that wait for a slow host, beyond which a paced board skips frames


class MemoryLine(Closeable):
    """Line to a board of the same process, without a thread.

    Without a period a frame is measured for each read that finds none: which frames are read
    depends on the requests alone, not on how fast the host or the machine is. With a period frames
    are due at that pace, and those without room are skipped. Delays of faults pass in real time.

    Attributes:
        firmware: firmware of the board.
        period: time from frame to frame [s]; 0 for as fast as they are read.
        cable: number of times that the cable was plugged in; ports of earlier times have gone.
        plugged: whether the cable is plugged in.
    """

    def __init__(
        self,
        firmware: VirtualFirmware,
        period: float = 0.0,
        clock: Callable[[], float] = time.monotonic,
        wait: Callable[[float], None] = time.sleep,
    ) -> None:
        """Make a line whose cable is not plugged in yet."""
        self.firmware, self.period, self.cable, self.plugged = firmware, period, 0, False
        self._clock, self._wait = clock, wait
        self._outgoing = bytearray()
        self._due = self._back_at = 0.0  # s: of the next frame, and of the cable's return
        self._measuring = 0.0  # s, for all frames so far
        self._lock = threading.RLock()

    def start(self) -> None:
        """Plug the cable in; the board boots."""
        with self._lock:
            self._outgoing[:] = self.firmware.boot()
            self.cable, self.plugged = self.cable + 1, True
            self._restart_pace()

    def now(self) -> float:
        """Time [s] by the clock, without that which measuring takes.

        However long a simulated frame takes, the stream of a board that measures it is not stale.
        """
        return self._clock() - self._measuring

    def remaining(self) -> float:
        """Time until a frame is due, or the cable may be put back [s]."""
        if self.plugged:
            return max(0.0, self._due - self.now())
        return max(0.0, self._back_at - self._clock())

    def connect(self, uri: str) -> "MemoryPort":
        """Port at the host's end; raises DeviceError while the cable is pulled or the port held."""
        if not self.plugged:
            if self.remaining() or not self.firmware.can_reconnect:
                raise unplugged_error(uri)
            self.start()
        if self.firmware.holds_port:
            raise DeviceError(f"{uri}: cannot open the port: {remedy(OSError(errno.EBUSY, ''))}")
        return MemoryPort(self)

    def close(self) -> None:
        self.plugged = False

    def waiting(self) -> int:
        """Number of bytes that can be read at once."""
        with self._lock:
            if self.period:
                self._measure()
            return len(self._outgoing)

    def clear(self) -> None:
        """Discard the bytes that were not read."""
        with self._lock:
            self._outgoing.clear()

    def send(self, data: bytes) -> None:
        """Give the board a request; raises OSError while the cable is pulled."""
        with self._lock:
            if not self.plugged:
                raise OSError(errno.EIO, "the cable was pulled")
            was_streaming = self.firmware.streaming
            self._outgoing += self.firmware.receive(data)
            if self.firmware.streaming and not was_streaming:
                self._restart_pace()

    def receive(self, size: int) -> bytes:
        """Up to `size` bytes, of the next frame where none wait; none after a short while.

        Raises OSError once the cable is pulled and all bytes are read.
        """
        data = self.take(size)
        if not data and not self.plugged:
            raise OSError(errno.EIO, "the cable was pulled")
        if not data and (pause := self.remaining() if self.firmware.streaming else _POLL) > 0.0:
            self._wait(min(pause, _POLL))
        return data

    def take(self, size: int) -> bytes:
        """Up to `size` bytes, of the next frame where none wait, at once."""
        with self._lock:
            self._measure()
            data = bytes(self._outgoing[:size])
            del self._outgoing[:size]
        return data

    def _restart_pace(self) -> None:
        self._due = self.now() + self.period

    def _measure(self) -> None:
        """Measure the frames that are due, and skip those that find no room."""
        while self.plugged and self.firmware.streaming and not self.remaining():
            if self._outgoing and not self.period:
                return
            if len(self._outgoing) < _BACKLOG:
                self._add_frame()
            else:
                self.firmware.skip()
                self._due += self.period

    def _add_frame(self) -> None:
        began = self._clock()
        try:
            self._outgoing += self.firmware.frame()
        except UnpluggedError as pulled:
            self._outgoing += pulled.sent
            self.plugged = False
            self._back_at = self._clock() + (pulled.back_after or 0.0)
        duration = self._clock() - began
        self._measuring += duration
        start = self._due if self.period else self.now()
        self._due = start + self.period + self.firmware.delay
        if self.period:  # the board's clock goes on while a frame is simulated
            self.firmware.delay_clock(max(0.0, duration - self.period))


class MemoryPort:
    """Host's end of a `MemoryLine`, as a `SerialPort`."""

    def __init__(self, line: MemoryLine) -> None:
        """Take the line with its cable as it is plugged in now."""
        self._line, self._cable, self._closed = line, line.cable, False

    @property
    def in_waiting(self) -> int:
        """Number of bytes that can be read at once."""
        return self._open().waiting()

    def read(self, size: int = 1) -> bytes:
        """Up to `size` bytes; none after a short while."""
        return self._open().receive(size)

    def write(self, data: bytes) -> int:
        """Send `data`."""
        self._open().send(data)
        return len(data)

    def reset_input_buffer(self) -> None:
        """Discard received bytes that were not read."""
        self._open().clear()

    def close(self) -> None:
        """Close the port; the line stays."""
        self._closed = True

    def _open(self) -> MemoryLine:
        if self._closed or self._cable != self._line.cable:
            raise OSError(errno.EBADF, "the port is closed, or its cable was pulled")
        return self._line


def unplugged_error(uri: str) -> DeviceError:
    """Error of a virtual board whose cable is out."""
    return DeviceError(f"{uri}: the virtual board is unplugged; clear its faults")
