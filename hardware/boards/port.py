"""Serial ports: what is used of one, finding and opening one, and what to do where that fails."""

import errno
import importlib
import importlib.util
import typing
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

from eitskin.errors import ConfigurationError, DeviceError
from eitskin.extras import require

BAUD = 921600
GONE: tuple[type[Exception], ...] = (OSError, TypeError)
"""What pyserial raises where the port has gone: SerialException (an OSError) from read and write,
OSError from in_waiting, termios.error from reset_input_buffer, TypeError where another thread
has closed it."""
if importlib.util.find_spec("termios"):
    GONE += (importlib.import_module("termios").error,)

_UNOPENED: tuple[type[Exception], ...] = (*GONE, ValueError)

_POLL = 0.05  # s, how long one read waits at most
_SEND_WITHIN = 0.5  # s


class SerialPort(typing.Protocol):
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


def open_port(path: str, uri: str, baud: int = BAUD) -> SerialPort:
    """A pyserial port, 8N1 without flow control, locked for this process."""
    serial = require("serial", "hardware")
    try:
        port: SerialPort = serial.Serial(
            path, baud, timeout=_POLL, write_timeout=_SEND_WITHIN, exclusive=True
        )
    except _UNOPENED as error:
        raise DeviceError(f"{uri}: cannot open the port: {remedy(error)}") from error
    return port


def remedy(error: Exception) -> str:
    """What went wrong on opening a port and what to do."""
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
    """A serial port of this machine, and the USB device behind it.

    Attributes:
        device: its path, or name on Windows.
        description, manufacturer: as the device says; empty where unknown.
        vid, pid: USB vendor and product; None for a port that is not of USB.
        serial_number: of the USB device; empty where it has none.
    """

    device: str
    description: str = ""
    manufacturer: str = ""
    vid: int | None = None
    pid: int | None = None
    serial_number: str = ""

    @property
    def uri(self) -> str:
        """What opens it, by serial number where it has one, since its path may change."""
        number = quote(self.serial_number)
        return f"serial:?usb={number}" if number else f"serial:{self.device}"

    def __str__(self) -> str:
        """In words."""
        usb = f"{self.vid:04x}:{self.pid or 0:04x}" if self.vid is not None else "no USB"
        told = (self.description, self.manufacturer, usb, self.serial_number)
        return f"{self.device} ({', '.join(filter(None, told))})"


def serial_ports() -> tuple[PortInfo, ...]:
    """The serial ports of this machine, by path."""
    found = require("serial.tools.list_ports", "hardware").comports()
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
        for port in found
    )
    return tuple(sorted(ports, key=lambda port: port.device))


Ports = Callable[[], tuple[PortInfo, ...]]


def find_port(usb_serial: str, ports: Ports = serial_ports) -> str:
    """Path of the port whose USB serial number that is, wherever it is now.

    Raises DeviceError where there is none, or where several devices have the same number.
    """
    found = [port for port in ports() if port.serial_number == usb_serial]
    if not found:
        raise DeviceError(
            f"no port has the USB serial number {usb_serial!r}; check the cable. "
            f"{ports_here(ports)}"
        )
    if len(found) > 1:
        raise DeviceError(
            f"{len(found)} ports have the USB serial number {usb_serial!r}; name one of them by "
            f"its path: {'; '.join(map(str, found))}"
        )
    return found[0].device


def usb_serial_of(path: str, ports: Ports = serial_ports) -> str:
    """USB serial number of the device at `path`, which may be a link; empty where it has none."""
    here = {Path(port.device): port.serial_number for port in ports()}
    return here.get(Path(path).resolve(), "")


def only_usb_port(scheme: str, ports: Ports = serial_ports) -> str:
    """Path of the one USB serial port of this machine; raises ConfigurationError without one."""
    found = [port for port in ports() if port.vid is not None]
    if len(found) != 1:
        count = f"there are {len(found)}" if found else "there is none"
        raise ConfigurationError(
            f"{scheme}: needs a port, such as {scheme}:/dev/ttyACM0 or {scheme}:?usb=SERIAL, but "
            f"where one alone is of USB, and {count}. {ports_here(ports)}"
        )
    return found[0].device


def connector(
    path: str,
    uri: str,
    baud: int = BAUD,
    usb: str = "",
    ports: Ports = serial_ports,
    opened: Callable[[str, str, int], SerialPort] = open_port,
) -> Callable[[], SerialPort]:
    """What opens a port, and opens it again after it has gone, at another path if need be.

    Args:
        path: of the port; empty for the one of `usb`, or the only USB port there is.
        uri: to name it in messages.
        baud: of the port.
        usb: serial number of its USB device, instead of a path.
        ports: gives the ports of this machine.
        opened: opens one.

    Raises ConfigurationError for both or neither, where the port does not follow from that.
    """
    if path and usb:
        raise ConfigurationError(f"{uri}: name the port by path or by usb=, not by both")
    if not usb:
        path = path or only_usb_port(uri.partition(":")[0], ports)
    known = usb or usb_serial_of(path, ports)

    def connect() -> SerialPort:
        place = path
        if usb:
            place = find_port(usb, ports)
        elif known and usb_serial_of(path, ports) != known:
            # It may have come back at another path; where it has not, the path is what to name.
            places = [port.device for port in ports() if port.serial_number == known]
            place = places[0] if len(places) == 1 else path
        return opened(place, uri, baud)

    return connect


def ports_here(ports: Ports = serial_ports) -> str:
    """The serial ports of this machine, in words."""
    found = ports()
    listed = "; ".join(map(str, found))
    return f"Ports here: {listed}" if found else "No serial port was found here"
