"""Line in memory to a virtual board, which measures the frames that are due when the host reads.

Other programs reach it by a pseudo-terminal.
"""

import contextlib
import errno
import os
import selectors
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Self

from eitskin.closeable import Closeable
from eitskin.errors import ConfigurationError, DeviceError
from eitskin.hardware.boards.port import SerialPort, open_port, remedy
from eitskin.hardware.virtual.fault import UnpluggedError
from eitskin.hardware.virtual.virtual_firmware import VirtualFirmware

_POLL = 0.05  # s, longest wait of a read, as of a real port
_BACKLOG = 16384  # bytes that wait for a slow host, beyond which a paced board skips frames
_CHUNK = 4096  # bytes
_LOCK_AGAIN = 0.01  # s, from a lock refused to the next try


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


class PseudoTerminal(Closeable):
    """Pseudo-terminal with the line of a board at its other end.

    The host's end is kept open too, so that hosts can come and go as on a plugged-in cable. When
    the cable is pulled and put back, the board starts again behind another terminal, as a USB port
    may come back under another name.

    Attributes:
        line: line to the board.
        path: path for the host to open; empty while the cable is pulled.
    """

    def __init__(self, line: MemoryLine, link: str | Path | None = None) -> None:
        """Make a raw terminal, which passes every byte.

        Args:
            line: line to the board, whose faults wake the terminal when they change.
            link: path of a symbolic link to the terminal, kept as long as there is one.

        Raises ConfigurationError on systems without pseudo-terminals, or for an impossible link.
        """
        self.line = line
        self._link = None if link is None else Path(link)
        self._ends: tuple[int, ...] = ()
        self._stopped = False
        self._outgoing = b""
        self._locked = self._refused = False
        self._closing = threading.Lock()
        self._thread: threading.Thread | None = None
        self._create_terminal()
        self._wake_read, self._wake_write = os.pipe()

    @property
    def firmware(self) -> VirtualFirmware:
        """Firmware of the board."""
        return self.line.firmware

    def start(self) -> None:
        """Serve in a thread until closed."""
        self._thread = threading.Thread(target=self.serve, name="virtual board", daemon=True)
        self._thread.start()

    def serve(self) -> None:
        """Serve until closed."""
        try:
            while not self._stopped:
                if not self.path:
                    self._create_terminal()
                self._serve_cable()
                self._close_terminal()
                self._wait_for_cable()
        finally:
            self._close_terminal()

    def connect(self, uri: str) -> SerialPort:
        """Port at the host's end; raises DeviceError while the cable is pulled."""
        if not self.path:
            raise unplugged_error(uri)
        return open_port(self.path, uri)

    def wake(self) -> None:
        """Wake the serving thread, to look at its firmware again."""
        with self._closing:
            if not self._stopped:
                os.write(self._wake_write, b"x")

    def close(self) -> None:
        with self._closing:
            if self._stopped:
                return
            self._stopped = True
            os.write(self._wake_write, b"x")
        if self._thread is not None:
            self._thread.join()
        self._close_terminal()
        os.close(self._wake_read)
        os.close(self._wake_write)

    def __enter__(self) -> Self:
        """Serve in a thread."""
        self.start()
        return self

    def _create_terminal(self) -> None:
        """Make a terminal, and point the link to it."""
        try:
            import tty
        except ImportError as error:
            raise ConfigurationError(
                "a virtual board needs pseudo-terminals, which this system lacks, to be reached "
                "by other programs; use Linux, macOS or WSL, or open virtual: in the same program"
            ) from error
        self._board_end, self._host_end = self._ends = os.openpty()
        tty.setraw(self._host_end)
        os.set_blocking(self._board_end, False)
        self.path = os.ttyname(self._host_end)
        self._locked, self._outgoing = False, b""
        self._lock(self.firmware.holds_port)
        if self._link is not None:
            try:
                _point(self._link, self.path)
            except OSError as error:
                self._close_terminal()
                raise ConfigurationError(
                    f"cannot make {self._link} lead to the virtual board: "
                    f"{error.strerror or error}; choose a path that is free, in a folder that can "
                    "be written"
                ) from error

    def _close_terminal(self) -> None:
        link = self._link
        if self._ends and link and link.is_symlink() and link.readlink() == Path(self.path):
            link.unlink()  # unless another board has taken over the link
        for end in self._ends:
            os.close(end)
        self._ends, self.path = (), ""

    def _serve_cable(self) -> None:
        """Start the board and pass bytes until its cable is pulled or the terminal closed."""
        self.line.start()
        with selectors.DefaultSelector() as selector:
            selector.register(self._wake_read, selectors.EVENT_READ)
            selector.register(self._board_end, selectors.EVENT_READ)
            while not self._stopped:
                self._lock(self.firmware.holds_port)
                self._outgoing = self._outgoing or self.line.take(_CHUNK)
                if not self.line.plugged:
                    break
                self._exchange(selector)
        with contextlib.suppress(BlockingIOError):  # the last bytes, where the host has room
            os.write(self._board_end, self._outgoing + self.line.take(_CHUNK))

    def _exchange(self, selector: selectors.BaseSelector) -> None:
        """Wait for something to do, and pass bytes both ways."""
        sending = selectors.EVENT_WRITE if self._outgoing else 0
        selector.modify(self._board_end, selectors.EVENT_READ | sending)
        for key, events in selector.select(self._patience()):
            if key.fd == self._wake_read:
                os.read(self._wake_read, _CHUNK)
                continue
            if events & selectors.EVENT_READ:
                self.line.send(os.read(self._board_end, _CHUNK))
            if events & selectors.EVENT_WRITE:
                self._outgoing = self._outgoing[os.write(self._board_end, self._outgoing) :]

    def _patience(self) -> float | None:
        """Longest wait for bytes [s]; None for without end."""
        waits = [_LOCK_AGAIN] if self._refused else []
        if self.firmware.streaming and not self._outgoing:
            waits.append(self.line.remaining())
        return min(waits, default=None)

    def _wait_for_cable(self) -> None:
        """Wait until the cable may be put back, or the terminal is closed."""
        with selectors.DefaultSelector() as selector:
            selector.register(self._wake_read, selectors.EVENT_READ)
            while not self._stopped:
                remaining = self.line.remaining()
                if self.firmware.can_reconnect and not remaining:
                    return
                if selector.select(remaining or None):
                    os.read(self._wake_read, _CHUNK)

    def _lock(self, wanted: bool) -> None:
        """Lock the port as another program would, or unlock it."""
        self._refused = wanted and not self._locked
        if wanted != self._locked:
            import fcntl

            # A lock belongs to an open file: a host's lock is another than this one. While a host
            # has the port it cannot be locked here, and nothing shows when it lets go.
            with contextlib.suppress(BlockingIOError):
                fcntl.flock(
                    self._host_end, (fcntl.LOCK_EX | fcntl.LOCK_NB) if wanted else fcntl.LOCK_UN
                )
                self._locked, self._refused = wanted, False


def _point(link: Path, target: str) -> None:
    """Point the symbolic link to `target`, in one step; nothing but a link is replaced."""
    if link.exists() and not link.is_symlink():
        raise FileExistsError(f"{link} is no link")
    fresh = link.with_name(f".{link.name}.new")
    fresh.unlink(missing_ok=True)
    fresh.symlink_to(target)
    fresh.replace(link)
