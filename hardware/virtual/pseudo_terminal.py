"""Pseudo-terminal by which other programs reach a virtual board: an adapter of its line."""

import contextlib
import os
import selectors
import threading
from pathlib import Path
from typing import Self

from eitskin.closeable import Closeable
from eitskin.errors import ConfigurationError
from eitskin.hardware.boards.port import SerialPort, open_port
from eitskin.hardware.virtual.memory_line import MemoryLine, unplugged_error
from eitskin.hardware.virtual.virtual_firmware import VirtualFirmware

_CHUNK = 4096  # bytes
_LOCK_AGAIN = 0.01  # s, from a lock refused to the next try


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
