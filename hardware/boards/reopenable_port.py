"""Serial port that may go away and be opened again."""

import contextlib
from collections.abc import Callable
from typing import TypeVar

from eitskin.errors import DeviceError
from eitskin.hardware.boards.port import GONE, SerialPort

CHUNK = 4096  # bytes, size of a terminal's input queue
BACKLOG = 2**17  # bytes; Linux keeps 64 KiB behind that queue, other systems less

Result = TypeVar("Result")


class UnrecoverableError(DeviceError):
    """Failure of a connection that connecting again cannot mend."""


class ReopenablePort:
    """Serial port that is open, has gone away, or is closed for good.

    All methods raise DeviceError where the port has gone away, UnrecoverableError once closed.

    Attributes:
        uri: name of the board in messages.
        closed: whether the port was closed for good.
    """

    def __init__(self, connect: Callable[[], SerialPort], uri: str) -> None:
        """Open the port.

        Args:
            connect: opens a port whose reads return after a short while; called again by `reopen`.
            uri: name of the board in messages.
        """
        self.uri, self.closed = uri, False
        self._connect = connect
        self._port = connect()

    def read(self) -> bytes:
        """Bytes received, at least one if one comes within a short while."""
        return self._use(lambda port: port.read(max(1, min(port.in_waiting, CHUNK))))

    def write(self, data: bytes) -> None:
        """Send `data`."""
        self._use(lambda port: port.write(data))

    def waiting(self) -> int:
        """Number of bytes that can be read at once."""
        return self._use(lambda port: port.in_waiting)

    def clear(self) -> None:
        """Discard received bytes that were not read."""
        self._use(lambda port: port.reset_input_buffer())

    def reopen(self) -> None:
        """Close the port and open it again, at another path if it has moved."""
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
        """Close the port for good; a second call does nothing."""
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
