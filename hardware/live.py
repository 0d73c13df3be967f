"""Live loop: frames of a board through a pipeline, with latency, rate and damaged frames."""

import logging
import math
import threading
import time
import typing
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eitskin.closeable import Closeable
from eitskin.datasets.store.schema import State
from eitskin.errors import FrameError, UnusableFrameError
from eitskin.files import printable
from eitskin.frame import Frame
from eitskin.hardware.boards.board import Board, Connection, longest_silence
from eitskin.hardware.boards.port import UnrecoverableError
from eitskin.latest import Latest

DRIFT = 1e-4  # of two clocks, at most; crystals are off by some 5e-5


class AcquisitionClock:
    """When the measurement of each frame began, by the clock of this machine.

    No frame comes before it was measured: the smallest difference between an arrival and the end of
    that measurement by the board's clock counts as the difference of the two clocks. It holds the
    shortest time on the line, which one end alone cannot determine; every result is late by that.
    """

    def __init__(self) -> None:
        """Begin without a frame."""
        self._session: int | None = None
        self._offset, self._board_time, self._arrived = math.inf, -math.inf, 0.0

    def measurement_start(self, frame: Frame, arrived: float) -> float:
        """Time at which a frame's measurement began [s]; NaN where the board shows no duration.

        Args:
            frame: frame in the order of arrival.
            arrived: arrival by the clock of this machine [s].
        """
        if not math.isfinite(frame.duration + frame.time):
            return math.nan
        if frame.session != self._session or frame.time < self._board_time:  # another clock
            self._session, self._offset, self._arrived = frame.session, math.inf, arrived
        self._offset += DRIFT * (arrived - self._arrived)  # what was smallest may be so no more
        self._offset = min(self._offset, arrived - (frame.time + frame.duration))
        self._board_time, self._arrived = frame.time, arrived
        return frame.time + self._offset


MAX_REASON = 200  # letters

log = logging.getLogger(__name__)


class Estimate(typing.Protocol):
    """Result of a pipeline for one frame; None where the pipeline does not estimate a quantity.

    Example:
        >>> from eitskin.hardware import Estimate
        >>> estimate: Estimate | None = None
    """

    @property
    def state(self) -> State | str | None:
        """State: idle, touched or bent."""

    @property
    def probabilities(self) -> Sequence[float] | NDArray[np.floating]:
        """Probabilities of the states, in their order, (3,); NaN for those not distinguished."""

    @property
    def bend_angle_deg(self) -> float | None:
        """Bend angle [deg]; NaN where unknown."""

    @property
    def touch_map(self) -> NDArray[np.floating] | None:
        """Touch map, (rows, columns), 0 to 1; rows and columns grow with y and x."""

    @property
    def touches(self) -> Sequence[tuple[float, float, float]] | None:
        """Touches as (x [m], y [m], strength), with attributes force and deviation if known."""

    @property
    def problems(self) -> tuple[str, ...]:
        """Reasons not to trust the estimate; empty without doubts."""


class FramePipeline(typing.Protocol):
    """Pipeline as far as the live loop uses it: one frame in, one estimate out.

    Example:
        >>> from eitskin.hardware import FramePipeline
        >>> hasattr(FramePipeline, "process")
        True
    """

    def process(self, frame: Frame) -> Estimate:
        """Estimate for `frame`."""


@dataclass(frozen=True, slots=True, eq=False)
class Reading:
    """One turn of the live loop.

    Attributes:
        frame: frame of the board, unchanged.
        estimate: result of the pipeline; None for a frame too damaged for one.
        latency: time from the frame to its estimate [s].
        rate: mean frame rate over the last 20 frames [Hz]; NaN for the first.
        unusable: frames so far that were too damaged for an estimate.
        problem: reason for a missing estimate; empty otherwise.
        wall_time: arrival of the frame by this machine's clock [s since 1970]; NaN if unknown.

    Example:
        >>> import numpy as np
        >>> from eitskin import Frame, Protocol
        >>> from eitskin.hardware import Reading
        >>> frame = Frame(np.full(28, 600.0), Protocol.pairwise(8))
        >>> Reading(frame, None, latency=0.002, rate=3.4).rate
        3.4
    """

    frame: Frame
    estimate: Estimate | None
    latency: float
    rate: float
    unusable: int = 0
    problem: str = ""
    wall_time: float = math.nan


def run_live(
    board: Board | Connection,
    pipeline: FramePipeline,
    newest: bool = True,
    clock: Callable[[], float] = time.perf_counter,
) -> Iterator[Reading]:
    """Estimates of a board's frames, one reading per frame.

    Args:
        board: an open board; a `Connection` where it may go away and come back.
        pipeline: makes an estimate of every frame.
        newest: skip all but the newest waiting frame, so that no queue grows and no reading is
            old; the board counts the skipped frames.
        clock: time for latency and rate [s].

    A damaged frame is counted, and its reading has the reason instead of an estimate. So is any
    other frame by which the pipeline fails.

    Raises:
        DeviceError: where the board falls silent or goes away.
        FrameError: for a board of another sensor. After a first estimate the sensor is the right
            one: later errors count as damaged frames, since the board may recover.

    Example:
        >>> from eitskin.hardware import open_board, run_live
        >>> from eitskin.training import open_pipeline
        >>> with open_board("virtual:?speed=max") as board:
        ...     next(run_live(board, open_pipeline("reference.eitmodel"))).estimate.state.name
        'IDLE'
    """
    unusable = 0
    period_known = False
    arrivals: deque[float] = deque(maxlen=20)
    for frame in board.frames(newest=newest):
        arrivals.append(clock())
        wall_time = time.time()
        estimate, problem = None, ""
        try:
            estimate = pipeline.process(frame)
            period_known = True
        except FrameError as error:
            if not (period_known or isinstance(error, UnusableFrameError)):
                raise
            problem, unusable = str(error), unusable + 1
        except Exception as error:  # a session must outlive whatever one frame brings about
            log.debug("frame %d", frame.number, exc_info=True)
            problem, unusable = _failure(error), unusable + 1
        latency = clock() - arrivals[-1]
        yield Reading(frame, estimate, latency, _rate(arrivals), unusable, problem, wall_time)


def _failure(error: Exception) -> str:
    """Sentence on an error of a pipeline, on one line; the log has its traceback."""
    reason = printable(" ".join(str(error).split())[:MAX_REASON])
    return f"the pipeline failed on this frame ({type(error).__name__}: {reason})"


def _rate(arrivals: deque[float]) -> float:
    """Mean frame rate of the arrivals [Hz]; NaN without an interval."""
    if len(arrivals) < 2 or arrivals[-1] <= arrivals[0]:
        return float("nan")
    return (len(arrivals) - 1) / (arrivals[-1] - arrivals[0])


class LiveReadings(Closeable):
    """Live session in a thread of its own, which keeps the newest reading only.

    Any number of threads may iterate, ask for `newest` and have functions called. A board that goes
    away is connected to again, for as long as it takes. An error that ends the session, such as a
    board with another sensor, is raised by every iteration, and by `close` where nobody iterates.

    Example:
        >>> from eitskin.hardware import LiveReadings, open_board
        >>> from eitskin.training import open_pipeline
        >>> board = open_board("virtual:", period=0.01)
        >>> with LiveReadings(board, open_pipeline("reference.eitmodel")) as readings:
        ...     next(iter(readings)).estimate.state.name
        'IDLE'
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
        return reading if fresh and not self._latest.is_closed else None

    @property
    def problem(self) -> str:
        """Reason why no frames come; empty while they come."""
        return str(self._error or self._connection.problem)

    def __iter__(self) -> Iterator[Reading]:
        """Readings in their order, without those that became old meanwhile, until the session ends.

        Raises the error that ended the session.
        """
        number = 0
        while (newest := self._latest.wait_after(number)) is not None:
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
            while (newest := self._latest.wait_after(number)) is not None:
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
