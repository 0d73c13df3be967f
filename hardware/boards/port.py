"""Serial ports: listing, finding by USB serial number, opening, and opening again."""

import contextlib
import errno
import importlib
import importlib.util
import typing
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar
from urllib.parse import quote

from eitskin.errors import ConfigurationError, DeviceError
from eitskin.extras import require

BAUD = 921600
PORT_ERRORS: tuple[type[Exception], ...] = (OSError, TypeError)
"""Errors of pyserial for a port that has gone: SerialException (an OSError) from read and write,
OSError from in_waiting, termios.error from reset_input_buffer, TypeError where another thread
has closed the port."""
if importlib.util.find_spec("termios"):
    PORT_ERRORS += (importlib.import_module("termios").error,)

_OPENING_ERRORS: tuple[type[Exception], ...] = (*PORT_ERRORS, ValueError)

_POLL = 0.05  # s, longest wait of one read
_SEND_TIMEOUT = 0.5  # s


class SerialPort(typing.Protocol):
    """A pyserial port, as far as boards use it."""

    @property
    def in_waiting(self) -> int:
        """Number of bytes that can be read at once."""

    def read(self, size: int = 1) -> bytes:
        """Up to `size` received bytes; fewer, or none, after a short while."""

    def write(self, data: bytes) -> int | None:
        """Send `data`."""

    def reset_input_buffer(self) -> None:
        """Discard received bytes that were not read."""

    def close(self) -> None:
        """Close the port."""


def open_port(path: str, uri: str, baud: int = BAUD) -> SerialPort:
    """Open a pyserial port, 8N1 without flow control, locked for this process."""
    serial = require("serial", "hardware")
    try:
        port: SerialPort = serial.Serial(
            path, baud, timeout=_POLL, write_timeout=_SEND_TIMEOUT, exclusive=True
        )
    except _OPENING_ERRORS as error:
        raise DeviceError(f"{uri}: cannot open the port: {remedy(error)}") from error
    return port


def remedy(error: Exception) -> str:
    """Cause of a failure to open a port, and its remedy."""
    number = getattr(error, "errno", None)
    if number == errno.ENOENT:
        return f"there is none of this name; check the cable. {ports_here()}"
    if number in (errno.EACCES, errno.EPERM):
        return "no permission; on Linux add yourself to the group that owns it, often dialout"
    if number in (errno.EBUSY, errno.EAGAIN) or "lock" in str(error):
        return "another program uses it; close that program, then try again"
    return f"{error}; check that it is a serial port. {ports_here()}"


@dataclass(frozen=True, slots=True)
class PortInfo:
    """Serial port of this machine and its USB device.

    Attributes:
        device: path of the port, or its name on Windows.
        description, manufacturer: texts of the device; empty where unknown.
        vid, pid: numbers of USB vendor and product; None for a port without USB.
        serial_number: USB serial number; empty where the device has none.
    """

    device: str
    description: str = ""
    manufacturer: str = ""
    vid: int | None = None
    pid: int | None = None
    serial_number: str = ""

    @property
    def uri(self) -> str:
        """URI of the port, by USB serial number where there is one, since paths change."""
        number = quote(self.serial_number)
        return f"serial:?usb={number}" if number else f"serial:{self.device}"

    def __str__(self) -> str:
        """Path, description, manufacturer, USB numbers and serial number."""
        usb = f"{self.vid:04x}:{self.pid or 0:04x}" if self.vid is not None else "no USB"
        parts = (self.description, self.manufacturer, usb, self.serial_number)
        return f"{self.device} ({', '.join(filter(None, parts))})"


def serial_ports() -> tuple[PortInfo, ...]:
    """Serial ports of this machine, ordered by path."""
    port_list = require("serial.tools.list_ports", "hardware").comports()
    ports = (
        PortInfo(
            port.device,
            # pyserial says "n/a" for unknown.
            "" if port.description in (None, "n/a") else port.description,
            port.manufacturer or "",
            port.vid,
            port.pid,
            port.serial_number or "",
        )
        for port in port_list
    )
    return tuple(sorted(ports, key=lambda port: port.device))


def find_port(usb_serial: str) -> str:
    """Path of the port with the USB serial number `usb_serial`.

    Raises DeviceError where no device, or more than one, has that number.
    """
    ports = [port for port in serial_ports() if port.serial_number == usb_serial]
    if not ports:
        raise DeviceError(
            f"no port has the USB serial number {usb_serial!r}; check the cable. {ports_here()}"
        )
    if len(ports) > 1:
        raise DeviceError(
            f"{len(ports)} ports have the USB serial number {usb_serial!r}; name one of them by "
            f"its path: {'; '.join(map(str, ports))}"
        )
    return ports[0].device


def usb_serial_number(path: str) -> str:
    """USB serial number of the device at `path`, which may be a link; empty without one."""
    here = {Path(port.device): port.serial_number for port in serial_ports()}
    return here.get(Path(path).resolve(), "")


def only_usb_port(scheme: str) -> str:
    """Path of the only USB serial port; raises ConfigurationError for none or several."""
    usb_ports = [port for port in serial_ports() if port.vid is not None]
    if len(usb_ports) != 1:
        raise ConfigurationError(
            f"{len(usb_ports) or 'no'} USB serial ports were found, expected one\n"
            f"plug in the board, or name its port, such as --board {scheme}:/dev/ttyACM0 or "
            f"{scheme}:?usb=SERIAL. {ports_here()}"
        )
    return usb_ports[0].device


def connector(path: str, uri: str, baud: int = BAUD, usb: str = "") -> Callable[[], SerialPort]:
    """Function that opens a port, also when its device has come back at another path.

    Args:
        path: path of the port; empty for that of `usb`, or for the only USB port.
        uri: name of the board in messages.
        baud: baud rate.
        usb: USB serial number of the device, instead of a path.

    Raises ConfigurationError for both path and number, or for neither without exactly one USB port.
    """
    if path and usb:
        raise ConfigurationError(f"{uri}: name the port by path or by usb=, not by both")
    if not usb:
        path = path or only_usb_port(uri.partition(":")[0])
    serial_number = usb or usb_serial_number(path)

    def connect() -> SerialPort:
        current = path
        if usb:
            current = find_port(usb)
        elif serial_number and usb_serial_number(path) != serial_number:
            # The device may be back at another path; if not, the error names the path given.
            paths = [port.device for port in serial_ports() if port.serial_number == serial_number]
            current = paths[0] if len(paths) == 1 else path
        return open_port(current, uri, baud)

    return connect


def ports_here() -> str:
    """List of the serial ports of this machine, as a sentence."""
    listed = "; ".join(map(str, serial_ports()))
    return f"Ports here: {listed}" if listed else "No serial port was found here"


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
        with contextlib.suppress(*PORT_ERRORS):
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
            with contextlib.suppress(*PORT_ERRORS):
                self._port.close()

    def _use(self, use: Callable[[SerialPort], Result]) -> Result:
        self._require_open()
        try:
            return use(self._port)
        except PORT_ERRORS as error:
            raise DeviceError(
                f"{self.uri}: the board went away ({error}); check power and cable, then connect "
                "again"
            ) from error

    def _require_open(self) -> None:
        if self.closed:
            raise UnrecoverableError(f"{self.uri} is closed; open it again")
