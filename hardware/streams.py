"""Readings as JSON for other programs, by UDP and WebSocket, sent by a thread of their own.

`reading_record` is the form of a reading, the same in every stream and in `live --json`.
"""

import contextlib
import json
import logging
import math
import re
import socket
import struct
import threading
import time
import typing
from collections.abc import Callable, Sequence
from contextlib import ExitStack, closing
from typing import TYPE_CHECKING, Any

import numpy as np

from eitskin.closeable import Closeable
from eitskin.datasets.store.schema import State
from eitskin.errors import ConfigurationError
from eitskin.extras import require
from eitskin.files import quote_value
from eitskin.frame import Frame, Status
from eitskin.hardware.boards.board import Connection, Counts
from eitskin.hardware.live import Estimate, Reading
from eitskin.latest import Latest

VERSION = 1
"""Version of the records; keys may be added without a new one, none is removed or changed."""


def reading_record(reading: Reading, counts: Counts) -> dict[str, Any]:
    """Record of one reading; null stands for what is unknown or not estimated.

    docs/reference/live.md lists the keys with their units.

    Args:
        reading: reading from the live loop.
        counts: counts of the board at that moment.
    """
    frame, estimate = reading.frame, reading.estimate
    return {
        "version": VERSION,
        "kind": "reading",
        "number": frame.number,
        "session": frame.session,
        "time": finite_or_none(frame.time),
        "wall_time": finite_or_none(reading.wall_time),
        **(_without_estimate(reading) if estimate is None else _estimate_fields(estimate)),
        "bad_channels": bad_channels(frame),
        "latency_ms": reading.latency * 1e3,
        "rate_hz": finite_or_none(reading.rate),
        "lost": counts.lost,
        "skipped": counts.skipped,
        "unusable": reading.unusable,
        "reconnections": counts.reconnections,
        "dropped": dict(counts.dropped),
    }


def silence_record(seconds: float, problem: str) -> dict[str, Any]:
    """Record of a second without a frame.

    Args:
        seconds: since the newest reading; since the beginning before the first.
        problem: reason why no frames come, where known.
    """
    return {"version": VERSION, "kind": "silence", "seconds": seconds, "problem": problem}


def _estimate_fields(estimate: Estimate) -> dict[str, Any]:
    values = np.asarray(estimate.probabilities, dtype=float).tolist()
    names = (state.name.lower() for state in State)
    return {
        "state": state_name(estimate),
        "probabilities": dict(zip(names, map(finite_or_none, values), strict=True)),
        "bend_angle_deg": finite_or_none(estimate.bend_angle_deg),
        "bend_deviation_deg": finite_or_none(getattr(estimate, "bend_deviation_deg", None)),
        "touches": _touches(estimate),
        "zero": zero_name(estimate),
        "problems": list(estimate.problems),
    }


def _touches(estimate: Estimate) -> list[dict[str, float | None]] | None:
    """Record of each touch; None where touches are not estimated."""
    if estimate.touches is None:
        return None
    return [
        {
            "x": finite_or_none(touch[0]),
            "y": finite_or_none(touch[1]),
            "strength": finite_or_none(touch[2]),
            "force": finite_or_none(getattr(touch, "force", None)),
            "deviation": finite_or_none(getattr(touch, "deviation", None)),
        }
        for touch in estimate.touches
    ]


def _without_estimate(reading: Reading) -> dict[str, Any]:
    """Estimate of a frame that was too damaged for one."""
    names = ("state", "probabilities", "bend_angle_deg", "bend_deviation_deg", "touches", "zero")
    return {**dict.fromkeys(names), "problems": [reading.problem]}


def bad_channels(frame: Frame) -> dict[str, str]:
    """Status of each bad measurement, by its label."""
    return {
        label: _status_text(int(bits))
        for label, bits in zip(frame.protocol.labels, frame.status, strict=True)
        if bits
    }


def state_name(estimate: Estimate) -> str | None:
    """Name of the state in lower case; None where the pipeline does not estimate it."""
    state = estimate.state
    if state is None:
        return None
    return (state if isinstance(state, str) else state.name).lower()


def zero_name(estimate: Estimate) -> str:
    """State of the sensor that an estimate is relative to, in words."""
    return str(getattr(estimate, "zero", "first frames"))


def finite_or_none(value: float | None) -> float | None:
    """`value`, None where it is unknown or not finite, which JSON cannot say."""
    return float(value) if value is not None and math.isfinite(value) else None


def _status_text(bits: int) -> str:
    names = [flag.name.lower().replace("_", " ") for flag in Status if flag.name and flag & bits]
    return ", ".join(names) or f"status {bits:#04x}"


HEARTBEAT = 1.0  # s without a reading, after which silence is reported


class Outlet(typing.Protocol):
    """Way to other programs.

    Attributes:
        url: address of the readings.
    """

    url: str

    def send(self, message: str) -> None:
        """Send one line of JSON without waiting; clients that cannot take it miss it."""

    def close(self) -> None:
        """End all connections; a second call does nothing."""


class ReadingPublisher(Closeable):
    """Newest reading of a live session for all outlets; there is no queue, so nothing is late."""

    def __init__(
        self,
        connection: Connection,
        outlets: Sequence[Outlet],
        clock: Callable[[], float] = time.monotonic,
        heartbeat: float = HEARTBEAT,
    ) -> None:
        """Start the thread.

        Args:
            connection: connection to the board whose readings will be published.
            outlets: ways to other programs, which `close` closes.
            clock: [s].
            heartbeat: time without a reading, after which silence is reported [s].
        """
        self._outlets = tuple(outlets)
        self._connection, self._clock, self._heartbeat = connection, clock, heartbeat
        self._latest: Latest[tuple[Reading, Counts]] = Latest()
        self._thread = threading.Thread(target=self._run, name="streams", daemon=True)
        self._thread.start()

    def publish(self, reading: Reading) -> None:
        """Make this reading the next one that is sent; returns at once."""
        self._latest.put((reading, self._connection.board.counts))

    def close(self) -> None:
        self._latest.close()
        self._thread.join()
        for outlet in self._outlets:
            outlet.close()

    @property
    def addresses(self) -> tuple[str, ...]:
        """Addresses where other programs find the readings."""
        return tuple(outlet.url for outlet in self._outlets)

    def _run(self) -> None:
        number, came = 0, self._clock()
        while True:
            newest = self._latest.wait_after(number, self._heartbeat)
            if newest is not None:
                number, came = newest[0], self._clock()
                record = reading_record(*newest[1])
            elif self._latest.is_closed:
                return
            else:
                record = silence_record(self._clock() - came, self._connection.problem)
            message = json.dumps(record, allow_nan=False)
            for outlet in self._outlets:
                outlet.send(message)


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
            addresses = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)
        except OSError as error:
            raise ConfigurationError(
                f"--udp: cannot find {host}: {error.strerror or error}; give a name or number of a "
                "machine on this network"
            ) from error
        family, kind, protocol, _, address = addresses[0]
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


if TYPE_CHECKING:
    from websockets.sync.server import ServerConnection

MAX_CLIENTS = 8
STALL_TIMEOUT = 5.0  # s, after which a client that takes nothing is disconnected
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
            port: port of it; 0 for any that is free.

        Raises:
            ImportError: naming the extra, where websockets is missing.
            ConfigurationError: where the port cannot be had.
        """
        serve = require("websockets.sync.server", "websocket").serve
        self._messages: Latest[str] = Latest()
        self._seats = threading.Semaphore(MAX_CLIENTS)
        try:
            self._server = serve(
                self._serve,
                host,
                port,
                origins=ORIGINS,
                compression=None,
                ping_interval=STALL_TIMEOUT,
                ping_timeout=STALL_TIMEOUT,
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
            client.close(TRY_AGAIN_LATER, f"{MAX_CLIENTS} clients listen already")
            return
        try:
            _limit_sending(client.socket)
            number = 0  # the newest message is at most a heartbeat old
            while (newest := self._messages.wait_after(number)) is not None:
                number, message = newest
                client.send(message)
                # The next only when this one has arrived: buffers between would fill with old ones.
                if not client.ping(ack_on_close=True).wait(STALL_TIMEOUT):
                    raise TimeoutError(f"nothing was read for {STALL_TIMEOUT:g} s")
        except Exception:  # gone, or stalled for too long, in any of the ways of the library
            log.debug("a client has gone", exc_info=True)
            with contextlib.suppress(OSError):
                client.socket.shutdown(socket.SHUT_RDWR)
        finally:
            self._seats.release()


def _limit_sending(connected: socket.socket) -> None:
    """Let a send fail that takes too long; the library's own pings wait behind a stalled one."""
    seconds = int(STALL_TIMEOUT)
    limit = struct.pack("ll", seconds, round(1e6 * (STALL_TIMEOUT - seconds)))
    with contextlib.suppress(OSError, AttributeError):
        connected.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, limit)


LOOPBACK = "127.0.0.1"


def open_publisher(
    connection: Connection, udp: str | None, websocket: str | None
) -> ReadingPublisher:
    """Publisher by UDP, WebSocket or both.

    Args:
        connection: connection to the board whose readings will be published.
        udp: "PORT" or "HOST:PORT" that datagrams go to; None for no datagrams.
        websocket: "PORT" or "HOST:PORT" to listen at; None for no server.

    Raises:
        ConfigurationError: for another form, an unknown host or a port that cannot be had.
        ImportError: naming the extra, where websockets is missing.
    """
    outlets: list[Outlet] = []
    with ExitStack() as stack:
        if udp is not None:
            outlets.append(stack.enter_context(closing(UdpOutlet(*parse_address("--udp", udp)))))
        if websocket is not None:
            served = WebSocketOutlet(*parse_address("--websocket", websocket))
            outlets.append(stack.enter_context(closing(served)))
        publisher = ReadingPublisher(connection, outlets)
        stack.pop_all()  # the publisher closes them
    return publisher


def parse_address(option: str, text: str) -> tuple[str, int]:
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
    host = host.strip("[]") or LOOPBACK
    try:
        name = host.encode("idna").decode()
    except UnicodeError:
        name = " "
    if not re.fullmatch(r"[!-~]+", name):
        raise ConfigurationError(
            f"{option}: expected a name or number of a machine before the port, got "
            f"{quote_value(host)}"
        )
    return host, int(port)
