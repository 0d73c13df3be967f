"""The live page of `eitskin live --page`."""

import json
import logging
import threading
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from eitskin import hardware
from eitskin.cli.page.access import Access
from eitskin.cli.page.commands import SessionCommands, stage_commands
from eitskin.cli.page.plan import Region
from eitskin.cli.page.state import PageContent, Snapshot, next_reference
from eitskin.closeable import Closeable
from eitskin.extras import require_all
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.hardware.live import AcquisitionClock

if TYPE_CHECKING:
    from eitskin.cli.page.server import ClientLimits

log = logging.getLogger(__name__)

MIN_SILENCE = 1.0  # s; a machine that is busy for a moment is no silence
HEARTBEAT = 1.0  # s
MAX_UPDATE_RATE = 60  # more than a screen shows
MEMORY_PACE = 0.2  # s between two frames of the page's past, which a browser that comes late gets


class LivePage(Closeable):
    """Server of the page and its newest reading; there is no queue, so nothing is late.

    The live loop publishes readings; threads of the page encode and send these, so that browsers
    cannot slow the loop.

    Attributes:
        url: address of the page, without a token.
        invitations: permissions, each with its address.
    """

    def __init__(
        self,
        connection: "hardware.Connection",
        sheet: SensorDesign | Region,
        port: int = 0,
        access: Access | None = None,
        session: SessionCommands | None = None,
        limits: "ClientLimits | None" = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Start to serve.

        Args:
            connection: connection to the board whose readings will be published; a virtual one can
                be commanded by the page.
            sheet: design of its sensor, or the region of positions where that is not known.
            port: 0 for any that is free.
            access: address to serve at, and who may use the page; without it this machine.
            session: takes what is asked of the live session; without it nothing is.
            limits: limits with browsers.
            clock: [s].

        Raises ConfigurationError where the port cannot be had.
        """
        require_all(live="starlette uvicorn")
        from eitskin.cli.page.server import ClientLimits, Server

        board = connection.board
        self._connection, self._clock = connection, clock
        self._content = PageContent.from_board(board, sheet)
        self._acquired = AcquisitionClock()
        self._newest: Snapshot | None = None
        self._arrived = self._told = self._closed = False
        self._changed = threading.Condition()
        hello = b"retry: 1000\n" + event(
            "sensor",
            self._content.sensor() | {"tasks": None if session is None else list(session.commands)},
        )
        self._session = session
        self.server = Server(
            port,
            access or Access(),
            hello,
            {**stage_commands(board, sheet), **({} if session is None else session.commands)},
            limits or ClientLimits(),
        )
        self.url = self.server.access.url(self.server.port)
        self.invitations = self.server.access.invitations(self.server.port)
        self._thread = threading.Thread(target=self._send_events, name="page", daemon=True)
        self._thread.start()

    def publish(self, reading: "hardware.Reading") -> None:
        """Make this reading the next one that the page shows; returns at once."""
        counts, now, frame = self._connection.board.counts, self._clock(), reading.frame
        begun = self._acquired.measurement_start(frame, now - reading.latency)
        with self._changed:
            before = self._newest
            reference = next_reference(None if before is None else before.reference, frame)
            self._newest, self._arrived = Snapshot(reading, counts, reference, begun, now), True
            self._changed.notify()

    def tell(self) -> None:
        """Send what has changed other than the readings; returns at once."""
        with self._changed:
            self._told = True
            self._changed.notify()

    def close(self) -> None:
        if self._closed:
            return
        with self._changed:
            self._closed = True
            self._changed.notify()
        self._thread.join()
        self.server.close()

    def _send_events(self) -> None:
        """Encode each newest reading once, and the connection's health while none comes."""
        sent = -1.0 / MAX_UPDATE_RATE
        remembered = -MEMORY_PACE
        while True:
            snapshot = self._wait(sent)
            if self._closed:
                return
            sent = self._clock()
            memorable = snapshot is not None and sent - remembered >= MEMORY_PACE
            if not self.server.watching and not memorable:
                continue
            try:
                self.server.send(self._message(snapshot), memorable)
                remembered = sent if memorable else remembered
            except Exception:  # the page must outlive whatever a pipeline comes up with
                log.exception("the page cannot show frame")

    def _wait(self, sent_time: float) -> Snapshot | None:
        """Wait for a reading or the next heartbeat, no more often than a screen shows.

        The newest reading; None where that was taken before.
        """
        with self._changed:
            pause = sent_time + 1.0 / MAX_UPDATE_RATE - self._clock()
            if pause > 0.0:
                self._changed.wait_for(lambda: self._closed, pause)
            self._changed.wait_for(
                lambda: self._closed or self._arrived or self._told, self._heartbeat_delay()
            )
            newest = self._newest if self._arrived else None
            self._arrived = self._told = False
            return newest

    def _heartbeat_delay(self) -> float:
        """Time without a reading until the page is reported [s]."""
        age = self._age()
        remaining = self.max_age() - age if age is not None else 0.0
        return min(remaining, HEARTBEAT) if remaining > 0.0 else HEARTBEAT

    def max_age(self) -> float:
        """Age at which the newest reading is stale [s]; a text board's period is learned late."""
        from eitskin.hardware.boards.board import longest_silence

        return longest_silence(self._connection.board.info.period, MIN_SILENCE)

    def _age(self) -> float | None:
        """Age of the newest reading [s]; None without a reading."""
        return None if self._newest is None else self._clock() - self._newest.published

    def _message(self, snapshot: Snapshot | None) -> bytes:
        age = self._age()
        health = {
            "sent": round(self._clock(), 4),
            "age": None if age is None else round(age, 3),
            "stale": age is None or age >= self.max_age(),
            "connection": self._connection.problem,
            "tasks": None if self._session is None else self._session.state(),
        }
        if snapshot is None:
            return event("health", {**health, "stage": self._content.stage()})
        return event("frame", {**health, **self._content.frame(snapshot)})


def event(name: str, data: dict[str, Any]) -> bytes:
    """Server-sent event; raises ValueError for numbers that are not finite."""
    text = json.dumps(data, allow_nan=False, separators=(",", ":"))
    return f"event: {name}\ndata: {text}\n\n".encode()
