"""Pseudo-terminal that serves a virtual board, at a real pace or as fast as it is read."""

import contextlib
import os
import selectors
import threading
import time
import typing
from collections.abc import Callable
from pathlib import Path
from typing import Generic, Self, TypeVar

from eitskin.closeable import Closeable
from eitskin.errors import ConfigurationError
from eitskin.hardware.boards.port import SerialPort, open_port
from eitskin.hardware.virtual.fault import Unplugged
from eitskin.hardware.virtual.memory_line import unplugged

_CHUNK = 4096  # bytes
_BACKLOG = 16384  # bytes waiting to be sent, beyond which requests wait too
_LOCK_AGAIN = 0.01  # s, from a lock refused to the next try


class Firmware(typing.Protocol):
    """Firmware as far as the terminal uses it: bytes in, bytes out."""

    @property
    def streaming(self) -> bool:
        """Whether frames are due."""

    @property
    def delay(self) -> float:
        """Delay of the frame after the newest [s]."""

    @property
    def holds_port(self) -> bool:
        """Whether another program has the port open."""

    @property
    def plugged_in(self) -> bool:
        """Whether the cable, once pulled, may be put back."""

    def boot(self) -> bytes:
        """Boot, and give the bytes sent on boot."""

    def receive(self, data: bytes) -> bytes:
        """Answers to bytes from the host."""

    def frame(self) -> bytes:
        """Bytes of the next frame; may raise `Unplugged`."""

    def skip(self) -> None:
        """Leave out one frame."""

    def fall_behind(self, seconds: float) -> None:
        """Note time that passed without a frame, because the machine was busy [s]."""


FirmwareType = TypeVar("FirmwareType", bound=Firmware)


class Pace:
    """Pace of frames: time at which the next one is due.

    Attributes:
        period: time from frame to frame [s]; 0 for as fast as they are read.
    """

    def __init__(self, period: float, clock: Callable[[], float] = time.monotonic) -> None:
        """Set the first frame due one period from now."""
        self.period = period
        self._clock = clock
        self.restart()

    def restart(self) -> None:
        """Set the next frame due one period from now."""
        self._due = self._clock() + self.period

    def advance(self, late: float = 0.0) -> float:
        """Set the next frame due one period and `late` [s] after the last.

        A time that has passed counts as now; returns the time that was lost by that [s].
        """
        wanted, now = self._due + self.period, self._clock()
        self._due = max(wanted, now) + late
        return max(0.0, now - wanted) if self.period else 0.0

    def remaining(self) -> float:
        """Time until the next frame is due [s], 0 for one that is due."""
        return max(0.0, self._due - self._clock())


class PseudoTerminal(Closeable, Generic[FirmwareType]):
    """Pseudo-terminal with a board at its other end.

    The host's end is kept open too, so that hosts can come and go as on a plugged-in cable. When
    the cable is pulled and put back, the board starts anew behind another terminal, as a USB port
    may come back under another name.

    Attributes:
        firmware: firmware of the board.
        pace: pace of its frames.
        path: path for the host to open; empty while the cable is pulled.
    """

    def __init__(self, firmware: FirmwareType, pace: Pace, link: str | Path | None = None) -> None:
        """Make a raw terminal, which passes every byte.

        Args:
            firmware: firmware of the board.
            pace: pace of its frames.
            link: path of a symbolic link to the terminal, kept as long as there is one.

        Raises ConfigurationError on systems without pseudo-terminals, or for an impossible link.
        """
        self.firmware, self.pace = firmware, pace
        self._link = None if link is None else Path(link)
        self._ends: tuple[int, ...] = ()
        self._stopped = False
        self._outgoing = bytearray()
        self._locked = self._refused = False
        self._closing = threading.Lock()
        self._thread: threading.Thread | None = None
        self._plug_in()
        self._wake_read, self._wake_write = os.pipe()

    def start(self) -> None:
        """Serve in a thread until closed."""
        self._thread = threading.Thread(target=self.serve, name="virtual board", daemon=True)
        self._thread.start()

    def serve(self) -> None:
        """Serve until closed."""
        try:
            while not self._stopped:
                try:
                    self._serve_cable()
                except Unplugged as unplugged:
                    self._flush(unplugged.sent)
                    self._hang_up()
                    self._wait_for_cable(unplugged.back_after)
        finally:
            self._hang_up()

    def connect(self, uri: str) -> SerialPort:
        """Port at the host's end; raises DeviceError while the cable is pulled."""
        if not self.path:
            raise unplugged(uri)
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
        self._hang_up()
        os.close(self._wake_read)
        os.close(self._wake_write)

    def __enter__(self) -> Self:
        """Serve in a thread."""
        self.start()
        return self

    def _plug_in(self) -> None:
        """Make a terminal, and point the link to it."""
        try:
            import tty
        except ImportError as error:
            raise ConfigurationError(
                "a virtual board needs pseudo-terminals, which this system lacks; use Linux, "
                "macOS or WSL, or replay a recording"
            ) from error
        self._board_end, self._host_end = self._ends = os.openpty()
        tty.setraw(self._host_end)
        os.set_blocking(self._board_end, False)
        self.path = os.ttyname(self._host_end)
        self._locked = False
        self._lock(self.firmware.holds_port)
        self._outgoing.clear()
        if self._link is not None:
            try:
                _point(self._link, self.path)
            except OSError as error:
                self._hang_up()
                raise ConfigurationError(
                    f"cannot make {self._link} lead to the virtual board: "
                    f"{error.strerror or error}; choose a path that is free, in a folder that can "
                    "be written"
                ) from error

    def _hang_up(self) -> None:
        link = self._link
        if self._ends and link and link.is_symlink() and link.readlink() == Path(self.path):
            link.unlink()  # unless another board has taken over the link
        for end in self._ends:
            os.close(end)
        self._ends, self.path = (), ""

    def _serve_cable(self) -> None:
        """Start the board and serve it until it is unplugged or closed."""
        with selectors.DefaultSelector() as selector:
            selector.register(self._wake_read, selectors.EVENT_READ)
            selector.register(self._board_end, selectors.EVENT_READ)
            self._outgoing += self.firmware.boot()
            self.pace.restart()
            while not self._stopped:
                self._lock(self.firmware.holds_port)
                self._measure()
                self._exchange(selector)

    def _flush(self, data: bytes) -> None:
        """Send the bytes that the line still takes before the cable is gone."""
        with contextlib.suppress(BlockingIOError):
            os.write(self._board_end, bytes(self._outgoing) + data)

    def _wait_for_cable(self, seconds: float | None) -> None:
        """Wait until the cable is put back, then make another terminal."""
        pause = None if seconds is None else Pace(seconds)
        with selectors.DefaultSelector() as selector:
            selector.register(self._wake_read, selectors.EVENT_READ)
            while not self._stopped:
                left = None if pause is None else pause.remaining()
                if self.firmware.plugged_in and not left:
                    self._plug_in()
                    return
                if selector.select(left):
                    os.read(self._wake_read, _CHUNK)

    def _lock(self, wanted: bool) -> None:
        """Lock the port as another program would, or unlock it."""
        self._refused = wanted and not self._locked
        if wanted != self._locked:
            import fcntl

            # A lock belongs to an open file: a host's lock is another than this one. While a host
            # has the port it cannot be locked here, and nothing tells when it lets go.
            with contextlib.suppress(BlockingIOError):
                fcntl.flock(
                    self._host_end, (fcntl.LOCK_EX | fcntl.LOCK_NB) if wanted else fcntl.LOCK_UN
                )
                self._locked, self._refused = wanted, False

    def _measure(self) -> None:
        """Send a frame if one is due; skip it, as a board must, while the last is unread."""
        if not self.firmware.streaming or self.pace.remaining() > 0:
            return
        late = 0.0
        if not self._outgoing:
            self._outgoing += self.firmware.frame()
            late = self.firmware.delay
        elif self.pace.period:
            self.firmware.skip()
        else:
            return
        self.firmware.fall_behind(self.pace.advance(late))

    def _exchange(self, selector: selectors.BaseSelector) -> None:
        """Wait for something to do, and pass bytes both ways."""
        interest = selectors.EVENT_WRITE if self._outgoing else 0
        if len(self._outgoing) < _BACKLOG or not interest:
            interest |= selectors.EVENT_READ
        selector.modify(self._board_end, interest)
        for key, events in selector.select(self._patience()):
            if key.fd == self._wake_read:
                os.read(self._wake_read, _CHUNK)
                continue
            if events & selectors.EVENT_READ:
                self._answer()
            if events & selectors.EVENT_WRITE:
                sent = os.write(self._board_end, self._outgoing)
                del self._outgoing[:sent]

    def _patience(self) -> float | None:
        """Longest wait for bytes [s]; None for without end."""
        patience = _LOCK_AGAIN if self._refused else None
        if not self.firmware.streaming or (self._outgoing and not self.pace.period):
            return patience
        left = self.pace.remaining()
        return left if patience is None else min(left, patience)

    def _answer(self) -> None:
        was_streaming = self.firmware.streaming
        self._outgoing += self.firmware.receive(os.read(self._board_end, _CHUNK))
        if self.firmware.streaming and not was_streaming:
            self.pace.restart()


def _point(link: Path, target: str) -> None:
    """Point the symbolic link to `target`, in one step; nothing but a link is replaced."""
    if link.exists() and not link.is_symlink():
        raise FileExistsError(f"{link} is no link")
    fresh = link.with_name(f".{link.name}.new")
    fresh.unlink(missing_ok=True)
    fresh.symlink_to(target)
    fresh.replace(link)
