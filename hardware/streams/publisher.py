"""Readings sent to other programs by a thread, so that none of them can hold up the live loop."""

import json
import threading
import time
import typing
from collections.abc import Callable, Sequence

from eitskin.closeable import Closeable
from eitskin.hardware.boards.board import Counts
from eitskin.hardware.boards.connection import Connection
from eitskin.hardware.live import Reading
from eitskin.hardware.streams.reading_record import reading_record, silence_record
from eitskin.latest import Latest

HEARTBEAT = 1.0  # s without a reading, after which silence is told


class Outlet(typing.Protocol):
    """Way to other programs.

    Attributes:
        url: where they find the readings.
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
            connection: to the board whose readings will be published.
            outlets: ways to other programs, which `close` closes.
            clock: [s].
            heartbeat: time without a reading, after which silence is told [s].
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
            newest = self._latest.after(number, self._heartbeat)
            if newest is not None:
                number, came = newest[0], self._clock()
                record = reading_record(*newest[1])
            elif self._latest.closed:
                return
            else:
                record = silence_record(self._clock() - came, self._connection.problem)
            message = json.dumps(record, allow_nan=False)
            for outlet in self._outlets:
                outlet.send(message)
