"""Line in memory to a virtual board, which measures a frame when the host reads it."""

import errno
import threading
import time
from collections.abc import Callable

from eitskin.closeable import Closeable
from eitskin.errors import DeviceError
from eitskin.hardware.boards.port import remedy
from eitskin.hardware.virtual.fault import Unplugged
from eitskin.hardware.virtual.virtual_firmware import VirtualFirmware

_POLL = 0.05  # s, longest wait of a read, as of a real port


class MemoryLine(Closeable):
    """Line to a board of the same process, without thread or pace.

    The board is never ahead of its host: which frames are read depends on the requests alone, not
    on how fast the host or the machine is. Delays of faults pass in real time.

    Attributes:
        firmware: firmware of the board.
        cable: number of times that the cable was plugged in; ports of earlier times have gone.
    """

    def __init__(
        self,
        firmware: VirtualFirmware,
        clock: Callable[[], float] = time.monotonic,
        wait: Callable[[float], None] = time.sleep,
    ) -> None:
        """Make a line whose cable is not plugged in yet."""
        self.firmware, self.cable = firmware, 0
        self._clock, self._wait = clock, wait
        self._plugged = False
        self._outgoing = bytearray()
        self._due = self._back_at = 0.0  # s: of the next frame, and of the cable's return
        self._measuring = 0.0  # s, for all frames so far
        self._lock = threading.Lock()

    def start(self) -> None:
        """Plug the cable in; the board boots."""
        self._outgoing[:] = self.firmware.boot()
        self.cable, self._plugged, self._due = self.cable + 1, True, 0.0

    def now(self) -> float:
        """Time [s] by the clock, without that which measuring takes.

        However long a simulated frame takes, the stream of a board that measures it is not stale.
        """
        return self._clock() - self._measuring

    def connect(self, uri: str) -> "MemoryPort":
        """Port at the host's end; raises DeviceError while the cable is pulled or the port held."""
        if not self._plugged:
            if self._clock() < self._back_at or not self.firmware.plugged_in:
                raise unplugged(uri)
            self.start()
        if self.firmware.holds_port:
            raise DeviceError(f"{uri}: cannot open the port: {remedy(OSError(errno.EBUSY, ''))}")
        return MemoryPort(self)

    def close(self) -> None:
        self._plugged = False

    def waiting(self) -> int:
        """Number of bytes that can be read at once."""
        return len(self._outgoing)

    def clear(self) -> None:
        """Discard the bytes that were not read."""
        self._outgoing.clear()

    def send(self, data: bytes) -> None:
        """Give the board a request; raises OSError while the cable is pulled."""
        with self._lock:
            if not self._plugged:
                raise OSError(errno.EIO, "the cable was pulled")
            was_streaming = self.firmware.streaming
            self._outgoing += self.firmware.receive(data)
            if self.firmware.streaming and not was_streaming:
                self._due = 0.0

    def receive(self, size: int) -> bytes:
        """Up to `size` bytes, of the next frame where none wait; none after a short while.

        Raises OSError once the cable is pulled and all bytes are read.
        """
        with self._lock:
            left = self._measure()
            data = bytes(self._outgoing[:size])
            del self._outgoing[:size]
            if not data and not self._plugged:
                raise OSError(errno.EIO, "the cable was pulled")
        if not data and left > 0.0:
            self._wait(left)
        return data

    def _measure(self) -> float:
        """Measure a frame if one is due and nothing waits; the time to wait otherwise [s]."""
        if self._outgoing or not self._plugged:
            return 0.0
        if not self.firmware.streaming:
            return _POLL
        left = self._due - self._clock()
        if left > 0.0:
            return min(left, _POLL)
        began = self._clock()
        try:
            self._outgoing += self.firmware.frame()
        except Unplugged as pulled:
            self._outgoing += pulled.sent
            self._plugged = False
            self._back_at = self._clock() + (pulled.back_after or 0.0)
        else:
            self._due = self._clock() + self.firmware.delay
        finally:
            self._measuring += self._clock() - began
        return 0.0


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


def unplugged(uri: str) -> DeviceError:
    """Error of a virtual board whose cable is out."""
    return DeviceError(f"{uri}: the virtual board is unplugged; clear its faults")
