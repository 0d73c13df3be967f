"""Readings by WebSocket: one text message for each, to any number of clients up to eight."""

import contextlib
import logging
import re
import socket
import struct
import threading
from typing import TYPE_CHECKING

from eitskin.errors import ConfigurationError
from eitskin.extras import require
from eitskin.latest import Latest

if TYPE_CHECKING:
    from websockets.sync.server import ServerConnection

MOST_CLIENTS = 8
STALLED = 5.0  # s, after which a client that takes nothing is disconnected
TRY_AGAIN_LATER = 1013  # close code
# Pages of this machine, and programs, which send no Origin: no foreign page may listen.
ORIGINS = (None, re.compile(r"https?://(localhost|127\.0\.0\.1|\[::1\])(:\d+)?"))

log = logging.getLogger(__name__)
log.setLevel(logging.CRITICAL)  # the terminal shows the sensor, not clients that come and go


class WebSocketOutlet:
    """Server of the newest reading; a client that is slow misses readings and gets no old one.

    Attributes:
        url: address of the stream.
    """

    def __init__(self, host: str, port: int) -> None:
        """Start to serve.

        Args:
            host: address to listen at.
            port: of it; 0 for any that is free.

        Raises:
            ImportError: naming the extra, where websockets is missing.
            ConfigurationError: where the port cannot be had.
        """
        serve = require("websockets.sync.server", "websocket").serve
        self._messages: Latest[str] = Latest()
        self._seats = threading.Semaphore(MOST_CLIENTS)
        try:
            self._server = serve(
                self._serve,
                host,
                port,
                origins=ORIGINS,
                compression=None,
                ping_interval=STALLED,
                ping_timeout=STALLED,
                close_timeout=1.0,
                max_size=1024,
                logger=log,
            )
        except OSError as error:
            raise ConfigurationError(
                f"--websocket: cannot listen at {host}:{port}: {error.strerror or error}; name "
                "another port, or 0 for any that is free"
            ) from error
        shown = f"[{host}]" if ":" in host else host
        self.url = f"ws://{shown}:{self._server.socket.getsockname()[1]}/"
        self._thread = threading.Thread(
            target=self._server.serve_forever, name="websocket", daemon=True
        )
        self._thread.start()

    def send(self, message: str) -> None:
        """Make the message the next one that every client gets."""
        self._messages.put(message)

    def close(self) -> None:
        """Disconnect all clients and end the server."""
        self._messages.close()
        self._server.shutdown()
        self._thread.join()

    def _serve(self, client: "ServerConnection") -> None:
        """Send each newest message until the client has gone, stalls, or the server ends."""
        if not self._seats.acquire(blocking=False):
            client.close(TRY_AGAIN_LATER, f"{MOST_CLIENTS} clients listen already")
            return
        try:
            _limit_sending(client.socket)
            number = 0  # the newest message is at most a heartbeat old
            while (newest := self._messages.after(number)) is not None:
                number, message = newest
                client.send(message)
                # The next only when this one has arrived: buffers between would fill with old ones.
                if not client.ping(ack_on_close=True).wait(STALLED):
                    raise TimeoutError(f"nothing was read for {STALLED:g} s")
        except Exception:  # gone, or stalled for too long, in any of the ways of the library
            log.debug("a client has gone", exc_info=True)
            with contextlib.suppress(OSError):
                client.socket.shutdown(socket.SHUT_RDWR)
        finally:
            self._seats.release()


def _limit_sending(connected: socket.socket) -> None:
    """Let a send fail that takes too long; the library's own pings wait behind a stalled one."""
    seconds = int(STALLED)
    limit = struct.pack("ll", seconds, round(1e6 * (STALLED - seconds)))
    with contextlib.suppress(OSError, AttributeError):
        connected.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, limit)
