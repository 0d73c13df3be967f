"""Opening of the outlets that the options of a command name."""

from contextlib import ExitStack, closing

from eitskin.errors import ConfigurationError
from eitskin.hardware.boards.connection import Connection
from eitskin.hardware.streams.publisher import Outlet, ReadingPublisher
from eitskin.hardware.streams.udp import UdpOutlet
from eitskin.hardware.streams.websocket import WebSocketOutlet

LOOPBACK = "127.0.0.1"


def open_publisher(
    connection: Connection, udp: str | None, websocket: str | None
) -> ReadingPublisher:
    """Publisher by UDP, WebSocket or both.

    Args:
        connection: to the board whose readings will be published.
        udp: "PORT" or "HOST:PORT" that datagrams go to; None for no datagrams.
        websocket: "PORT" or "HOST:PORT" to listen at; None for no server.

    Raises:
        ConfigurationError: for another form, an unknown host or a port that cannot be had.
        ImportError: naming the extra, where websockets is missing.
    """
    outlets: list[Outlet] = []
    with ExitStack() as stack:
        if udp is not None:
            outlets.append(stack.enter_context(closing(UdpOutlet(*address_of("--udp", udp)))))
        if websocket is not None:
            served = WebSocketOutlet(*address_of("--websocket", websocket))
            outlets.append(stack.enter_context(closing(served)))
        publisher = ReadingPublisher(connection, outlets)
        stack.pop_all()  # the publisher closes them
    return publisher


def address_of(option: str, text: str) -> tuple[str, int]:
    """Host and port of "PORT", which is this machine's own, or "HOST:PORT".

    Args:
        option: name of the option, for the error.
        text: its value; an IPv6 host stands in brackets.

    Raises ConfigurationError for another form.
    """
    host, _, port = text.rpartition(":")
    if not (port.isascii() and port.isdigit() and 0 <= int(port) <= 65535):
        raise ConfigurationError(
            f"{option} must be PORT or HOST:PORT, such as 5005 or 192.168.1.7:5005, got '{text}'"
        )
    return host.strip("[]") or LOOPBACK, int(port)
