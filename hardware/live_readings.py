"""Readings of a board for programs that do something else meanwhile, such as moving a robot."""

import threading
import time
from collections.abc import Callable, Iterator

from eitskin.closeable import Closeable
from eitskin.hardware.boards.board import Board, longest_silence
from eitskin.hardware.boards.connection import Connection
from eitskin.hardware.boards.reopenable_port import UnrecoverableError
from eitskin.hardware.live import FramePipeline, Reading, run_live
from eitskin.latest import Latest


class LiveReadings(Closeable):
    """Live session in a thread of its own, which keeps the newest reading only.

    Any number of threads may iterate, ask for `newest` and have functions called. A board that goes
    away is connected to again, for as long as it takes. An error that ends the session, such as a
    board with another sensor, is raised by every iteration, and by `close` where nobody iterates.
    """

    def __init__(self, board: Board, pipeline: FramePipeline) -> None:
        """Begin a session; the sensor must be as the pipeline needs it at the start.

        Args:
            board: an open board, which `close` closes.
            pipeline: makes the estimates; nobody else may use it meanwhile.
        """
        self._board = board
        self._closing = threading.Event()
        self._connection = Connection(board, wait=self._pause)
        self._latest: Latest[Reading] = Latest()
        self._arrived = 0.0
        self._error: Exception | None = None
        self._told = False
        self._threads: list[threading.Thread] = []
        self._start(lambda: self._read(pipeline), "live readings")

    @property
    def newest(self) -> Reading | None:
        """The newest reading; None before the first, and where it is older than three periods."""
        reading = self._latest.value
        fresh = time.monotonic() - self._arrived <= longest_silence(self._board.info.period)
        return reading if fresh and not self._latest.closed else None

    @property
    def problem(self) -> str:
        """Reason why no frames come; empty while they come."""
        return str(self._error or self._connection.problem)

    def __iter__(self) -> Iterator[Reading]:
        """Readings as they come, without those that became old meanwhile, until the session ends.

        Raises the error that ended the session.
        """
        number = 0
        while (newest := self._latest.after(number)) is not None:
            number, reading = newest
            yield reading
        if self._error is not None:
            self._told = True
            raise self._error

    def call(self, function: Callable[[Reading], object]) -> None:
        """Call `function` with each newest reading, in a thread of its own.

        A slow function misses readings. An error that it raises ends the session.
        """
        self._start(lambda: self._call(function), "live call")

    def close(self) -> None:
        """End the session, close the board, and wait until all threads are done.

        Raises the error that ended the session, unless an iteration has raised it.
        """
        self._closing.set()
        self._latest.close()
        self._board.close()
        for thread in self._threads:
            if thread is not threading.current_thread():
                thread.join()
        if self._error is not None and not self._told:
            self._told = True
            raise self._error

    def _start(self, target: Callable[[], None], name: str) -> None:
        thread = threading.Thread(target=target, name=name, daemon=True)
        self._threads.append(thread)
        thread.start()

    def _pause(self, seconds: float) -> None:
        """Wait before connecting again; raises UnrecoverableError where the session ends."""
        if self._closing.wait(seconds):
            raise UnrecoverableError(f"{self._board.uri}: the session has ended")

    def _read(self, pipeline: FramePipeline) -> None:
        try:
            for reading in run_live(self._connection, pipeline):
                self._arrived = time.monotonic()
                self._latest.put(reading)
                if self._closing.is_set():
                    break
        except Exception as error:  # raised where the readings are used
            self._fail(error)
        finally:
            self._latest.close()

    def _call(self, function: Callable[[Reading], object]) -> None:
        number = 0
        try:
            while (newest := self._latest.after(number)) is not None:
                number, reading = newest
                function(reading)
        except Exception as error:  # raised by `close`
            self._fail(error)

    def _fail(self, error: Exception) -> None:
        """End the session by an error; one that closing the board causes is none."""
        if not self._closing.is_set():
            self._error = self._error or error
            self._closing.set()
            self._latest.close()
