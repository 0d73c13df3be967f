"""Serial ports: what is used of one, opening one, and what to do where it cannot be opened."""

import errno
import importlib
import importlib.util
import typing

from eitskin.geometry import DeviceError
from eitskin.geometry.optional import require

BAUD = 921600
GONE: tuple[type[Exception], ...] = (OSError, TypeError)
"""What pyserial raises where the port has gone: SerialException (an OSError) from read and write,
OSError from in_waiting, termios.error from reset_input_buffer, TypeError where another thread
has closed it."""
if importlib.util.find_spec("termios"):
    GONE += (importlib.import_module("termios").error,)

_POLL = 0.05  # s, how long one read waits at most
_SEND_WITHIN = 0.5  # s


class Port(typing.Protocol):
    """What is used of a pyserial port."""

    @property
    def in_waiting(self) -> int:
        """Bytes that can be read at once."""

    def read(self, size: int = 1) -> bytes:
        """At most `size` bytes; fewer, or none, after a short while."""

    def write(self, data: bytes) -> int | None:
        """Send `data`."""

    def reset_input_buffer(self) -> None:
        """Throw away what came and was not read."""

    def close(self) -> None:
        """Let go of the port."""


def open_port(path: str, uri: str, baud: int = BAUD) -> Port:
    """A pyserial port, 8N1 without flow control, locked for this process."""
    serial = require("serial", "hardware")
    try:
        port: Port = serial.Serial(
            path, baud, timeout=_POLL, write_timeout=_SEND_WITHIN, exclusive=True
        )
    except (OSError, ValueError) as error:
        raise DeviceError(f"{uri}: cannot open the port: {_remedy(error)}") from error
    return port


def _remedy(error: Exception) -> str:
    """What went wrong on opening a port and what to do."""
    number = getattr(error, "errno", None)
    if number == errno.ENOENT:
        return f"there is none of this name; check the cable. {ports_here()}"
    if number in (errno.EACCES, errno.EPERM):
        return "no permission; on Linux add yourself to the group that owns it, often dialout"
    if number in (errno.EBUSY, errno.EAGAIN) or "lock" in str(error):
        return "another program uses it; close that program, then try again"
    return f"{error}; check that it is a serial port. {ports_here()}"


def ports_here() -> str:
    """The serial ports of this machine, in words."""
    found = [port.device for port in require("serial.tools.list_ports", "hardware").comports()]
    return f"Ports here: {', '.join(found)}" if found else "No serial port was found here"
