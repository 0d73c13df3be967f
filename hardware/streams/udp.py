"""Readings by UDP: one datagram for each."""

import socket
from typing import Any

from eitskin.errors import ConfigurationError


class UdpOutlet:
    """Datagrams to one address, whether or not anybody listens there.

    Attributes:
        url: address that datagrams go to.
        refused: datagrams that the system did not take: no route, full buffer, too long.
    """

    def __init__(self, host: str, port: int) -> None:
        """Look the address up; raises ConfigurationError where there is none."""
        self.url = f"udp://{host}:{port}"
        self.refused = 0
        try:
            found = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)
        except OSError as error:
            raise ConfigurationError(
                f"--udp: cannot find {host}: {error.strerror or error}; give a name or number of a "
                "machine on this network"
            ) from error
        family, kind, protocol, _, address = found[0]
        self._address: tuple[Any, ...] = address
        self._socket = socket.socket(family, kind, protocol)
        self._socket.setblocking(False)

    def send(self, message: str) -> None:
        """Send one datagram."""
        try:
            self._socket.sendto(message.encode(), self._address)
        except OSError:
            self.refused += 1

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()
