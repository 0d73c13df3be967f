"""Serves a virtual board on a pseudo-terminal, at a real board's pace or as fast as it is read."""

import os
import selectors
import threading
import time
import typing
from collections.abc import Callable
from types import TracebackType
from typing import Self

from eitskin.geometry import ConfigurationError
from eitskin.hardware.faults import Unplugged

_CHUNK = 4096  # bytes
_BACKLOG = 16384  # bytes; more than this waiting to be sent, and requests wait too


class Firmware(typing.Protocol):
    """What is served: bytes in, bytes out."""

    @property
    def streaming(self) -> bool:
        """Whether frames are due."""

    def boot(self) -> bytes:
        """Start afresh."""

    def receive(self, data: bytes) -> bytes:
        """Take bytes from the host and answer them."""

    def frame(self) -> bytes:
        """Measure the next frame and send it; may raise `Unplugged`."""

    def skip(self) -> None:
        """Let a frame pass."""


class Pace:
    """When the next frame is due.

    Attributes:
        period: from frame to frame [s]; 0 is as fast as they are read.
    """

    def __init__(self, period: float, clock: Callable[[], float] = time.monotonic) -> None:
        """Start one period before the first frame is due."""
        self.period = period
        self._clock = clock
        self.restart()

    def restart(self) -> None:
        """Have the next frame due one period from now."""
        self._due = self._clock() + self.period

    def advance(self) -> None:
        """Have the next frame due one period after the last; at once, where that has passed."""
        self._due = max(self._due + self.period, self._clock())

    def remaining(self) -> float:
        """Time until the next frame is due, 0 when it is [s]."""
        return max(0.0, self._due - self._clock())


class PseudoTerminal:
    """A pseudo-terminal with a board at its other end.

    It keeps the host's end open too, so that hosts can come and go as on a plugged-in cable.

    Attributes:
        path: what a host opens.
    """

    def __init__(self, firmware: Firmware, pace: Pace) -> None:
        """Make the terminal, raw, so that every byte passes; raises ConfigurationError."""
        try:
            import tty
        except ImportError as error:
            raise ConfigurationError(
                "a virtual board needs pseudo-terminals, which this system lacks; use Linux, "
                "macOS or WSL, or replay a recording"
            ) from error
        self._firmware, self._pace = firmware, pace
        self._board_end, host_end = os.openpty()
        self._ends: tuple[int, ...] = (self._board_end, host_end)
        tty.setraw(host_end)
        os.set_blocking(self._board_end, False)
        self.path = os.ttyname(host_end)
        self._wake_read, self._wake_write = os.pipe()
        self._outgoing = bytearray()
        self._stopped = False
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        """Serve in a thread until closed."""
        self._thread = threading.Thread(target=self.serve, name="virtual board", daemon=True)
        self._thread.start()

    def serve(self) -> None:
        """Serve until closed or unplugged; then the terminal is gone."""
        selector = selectors.DefaultSelector()
        selector.register(self._wake_read, selectors.EVENT_READ)
        selector.register(self._board_end, selectors.EVENT_READ)
        self._outgoing += self._firmware.boot()
        try:
            while not self._stopped:
                self._measure()
                self._exchange(selector)
        except Unplugged:
            pass
        finally:
            selector.close()
            self._hang_up()

    def close(self) -> None:
        """Pull the cable; a second time does nothing."""
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

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Close."""
        self.close()

    def _hang_up(self) -> None:
        for end in self._ends:
            os.close(end)
        self._ends = ()

    def _measure(self) -> None:
        """Send a frame if one is due; skip it, as a board must, where the last is still unread."""
        if not self._firmware.streaming or self._pace.remaining() > 0:
            return
        if not self._outgoing:
            self._outgoing += self._firmware.frame()
        elif self._pace.period:
            self._firmware.skip()
        else:
            return
        self._pace.advance()

    def _exchange(self, selector: selectors.BaseSelector) -> None:
        """Wait until there is something to do, and pass bytes both ways."""
        interest = selectors.EVENT_WRITE if self._outgoing else 0
        if len(self._outgoing) < _BACKLOG or not interest:
            interest |= selectors.EVENT_READ
        selector.modify(self._board_end, interest)
        for key, events in selector.select(self._patience()):
            if key.fd != self._board_end:
                continue
            if events & selectors.EVENT_READ:
                self._answer()
            if events & selectors.EVENT_WRITE:
                sent = os.write(self._board_end, self._outgoing)
                del self._outgoing[:sent]

    def _patience(self) -> float | None:
        """How long nothing needs doing unless bytes come or go [s]; None for ever."""
        if not self._firmware.streaming:
            return None
        if not self._pace.period:
            return None if self._outgoing else 0.0
        return self._pace.remaining()

    def _answer(self) -> None:
        was_streaming = self._firmware.streaming
        self._outgoing += self._firmware.receive(os.read(self._board_end, _CHUNK))
        if self._firmware.streaming and not was_streaming:
            self._pace.restart()
