"""A port that is held by a board and may go away."""

import contextlib
from collections.abc import Callable
from typing import TypeVar

from eitskin.errors import DeviceError
from eitskin.hardware.boards.port import GONE, SerialPort

CHUNK = 4096  # bytes, what a terminal's input queue holds
BACKLOG = 2**17  # bytes; Linux keeps 64 KiB behind that queue, other systems less

Result = TypeVar("Result")


class UnrecoverableError(DeviceError):
    """Connecting again does not help."""


class ReopenablePort:
    """A port that is open, went away, or is closed for good.

    All methods raise DeviceError where it went away, UnrecoverableError once it is closed.

    Attributes:
        uri: to name it in messages.
        closed: whether it was closed for good.
    """

    def __init__(self, connect: Callable[[], SerialPort], uri: str) -> None:
        """Open it.

        Args:
            connect: gives an open port, which reads what there is after a short while; called again
                by `reopen`.
            uri: to name it in messages.
        """
        self.uri, self.closed = uri, False
        self._connect = connect
        self._port = connect()

    def read(self) -> bytes:
        """What there is, at least one byte if one comes within a short while."""
        return self._use(lambda port: port.read(max(1, min(port.in_waiting, CHUNK))))

    def write(self, data: bytes) -> None:
        """Send `data`."""
        self._use(lambda port: port.write(data))

    def waiting(self) -> int:
        """Bytes that can be read at once."""
        return self._use(lambda port: port.in_waiting)

    def clear(self) -> None:
        """Throw away what came and was not read."""
        self._use(lambda port: port.reset_input_buffer())

    def reopen(self) -> None:
        """Let go of the port and open it again, wherever it is now."""
        self._require_open()
        with contextlib.suppress(*GONE):
            self._port.close()
        port = self._connect()
        try:
            self._require_open()
        except UnrecoverableError:  # closed meanwhile, by another thread
            port.close()
            raise
        self._port = port

    def close(self) -> None:
        """Let go of the port for good; a second time does nothing."""
        if not self.closed:
            self.closed = True
            with contextlib.suppress(*GONE):
                self._port.close()

    def _use(self, use: Callable[[SerialPort], Result]) -> Result:
        self._require_open()
        try:
            return use(self._port)
        except GONE as error:
            raise DeviceError(
                f"{self.uri}: the board went away ({error}); check power and cable, then connect "
                "again"
            ) from error

    def _require_open(self) -> None:
        if self.closed:
            raise UnrecoverableError(f"{self.uri} is closed; open it again")
