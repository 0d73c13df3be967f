"""Interface of every board: frames, identity, counts; and frames over interruptions."""

import math
import re
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from eitskin.closeable import Closeable
from eitskin.errors import DeviceError
from eitskin.frame import Frame
from eitskin.hardware.boards import port
from eitskin.hardware.protocol.messages import Info
from eitskin.protocol import Protocol

Item = TypeVar("Item")


@dataclass(frozen=True, slots=True)
class Counts:
    """Counts of frames and of dropped data since a board was opened.

    Attributes:
        frames: frames given out.
        lost: frames missing by their numbers; never interpolated.
        skipped: good frames left out because a newer one was waiting.
        dropped: packets, messages or lines that could not be used, by reason.
        reconnections: connections after the first.

    Example:
        >>> from eitskin.hardware import Counts
        >>> Counts(frames=100, lost=2).lost
        2
    """

    frames: int = 0
    lost: int = 0
    skipped: int = 0
    dropped: Mapping[str, int] = field(default_factory=dict)
    reconnections: int = 0


SILENT_PERIODS = 3
MIN_SILENCE = 0.5  # s, a host may be busy for as long
MAX_SILENCE = 600.0  # s, three frames of 16,384 channels; a firmware may show of over an hour


def longest_silence(period: float, least: float = MIN_SILENCE) -> float:
    """Longest time without a frame at `period` [s]; infinite for an unknown period, NaN or 0."""
    return min(max(SILENT_PERIODS * period, least), MAX_SILENCE) if period > 0.0 else math.inf


class Board(Closeable, ABC):
    """Source of frames: a board on a port, a virtual board, or a recording.

    Attributes:
        uri: URI that the board was opened by.
        protocol: stimulation and measurement pattern of the frames.
        stage: scene and faults of a virtual board, a `Stage`; None for every other board.

    Example:
        >>> from eitskin.hardware import Board, open_board
        >>> with open_board("virtual:?speed=max&resolution=coarse") as board:
        ...     isinstance(board, Board)
        True
    """

    uri: str
    protocol: Protocol
    stage: Any = None
    _frames = _lost = _skipped = _reconnections = 0

    if TYPE_CHECKING:  # an attribute of some boards, computed by others

        @property
        def info(self) -> Info:
            """Identity and settings of the board, as far as known."""

    @property
    def lost(self) -> int:
        """Number of frames lost so far; never interpolated."""
        return self._lost

    @property
    def counts(self) -> Counts:
        """Counts of frames and dropped data so far."""
        dropped = {
            reason.value: count
            for drops in self._drops()
            for reason, count in sorted(drops.items())
        }
        return Counts(self._frames, self.lost, self._skipped, dropped, self._reconnections)

    def _drops(self) -> Sequence[Mapping[Any, int]]:
        """Counts of dropped data by reason, of each decoder."""
        return ()

    @abstractmethod
    def frames(self, newest: bool = False) -> Iterator[Frame]:
        """Frames in their order.

        Args:
            newest: skip all but the newest of the waiting frames, and count them as skipped.

        Raises DeviceError where the board falls silent, for three periods, or goes away.
        """

    @abstractmethod
    def calibrate(self) -> None:
        """Measure the calibration resistor again, before the next frame.

        Raises ConfigurationError where the board cannot.
        """

    @abstractmethod
    def reconnect(self) -> None:
        """Connect again; `frames` then goes on.

        Raises:
            DeviceError: where the board is absent or does not answer as expected; try again later.
            UnrecoverableError: where another board answers, or this one with another table.
        """


class PortBoard(Board, Generic[Item]):
    """Board at the other end of a serial port; what it sends waits until it is taken."""

    _restarted = False

    def __init__(
        self, connect: Callable[[], port.SerialPort], uri: str, clock: Callable[[], float]
    ) -> None:
        """Open the port.

        Args:
            connect: opens a port whose reads return soon; called again by `reconnect`.
            uri: name of the board in messages.
            clock: time that pauses and silence are measured by [s].
        """
        self.uri, self._clock = uri, clock
        self._inbox: deque[Item] = deque()
        self._port = port.ReopenablePort(connect, uri)

    @abstractmethod
    def _receive(self) -> None:
        """Read the port once and decode; waits a short while at most."""

    @abstractmethod
    def _frame(self, item: Item) -> Frame | None:
        """Frame of what was received; None where it is no frame."""

    def _receive_items(self, seconds: float) -> Iterator[Item]:
        """All that is received within `seconds`; the rest stays for the next call."""
        deadline = self._clock() + seconds
        while True:
            # Read before giving up: this process itself may have slept past the deadline.
            if not self._inbox:
                self._receive()
            while self._inbox:
                yield self._inbox.popleft()
            if self._clock() >= deadline:
                return

    def _newest_pending(self, frame: Frame) -> Frame:
        """Newest of `frame` and the frames that have arrived since."""
        # Bounded, since a board may never pause.
        for _ in range(port.BACKLOG // port.CHUNK):
            while self._inbox and not self._restarted:
                if (later := self._frame(self._inbox.popleft())) is not None:
                    self._skipped += 1
                    frame = later
            if self._restarted or not self._port.waiting():
                break
            self._receive()
        return frame


FIRST_PAUSE = 0.1  # s, before the first try
MAX_PAUSE = 5.0  # s; the pause doubles until then


class Connection:
    """Board that is reconnected until frames come again.

    Attributes:
        board: source of the frames.
        problem: reason why no frames come; empty while frames come.
        show: called with each new problem, and with its end.

    Example:
        >>> from eitskin.hardware import Connection, open_board
        >>> with open_board("virtual:?speed=max&resolution=coarse") as board:
        ...     next(iter(Connection(board).frames())).impedance.shape
        (28,)
    """

    def __init__(self, board: Board, wait: Callable[[float], None] = time.sleep) -> None:
        """Take the open `board`; `wait` sleeps for a number of seconds."""
        self.board, self._wait = board, wait
        self.problem = ""
        self.tell: Callable[[str], None] = lambda _: None

    def frames(self, newest: bool = False) -> Iterator[Frame]:
        """Frames of the board, as `Board.frames` gives them, over all interruptions.

        Raises UnrecoverableError where connecting cannot help: another board, or this one closed.
        """
        pause = FIRST_PAUSE
        while True:
            try:
                for frame in self.board.frames(newest=newest):
                    pause = FIRST_PAUSE
                    self._notice("")
                    yield frame
            except port.UnrecoverableError:
                raise
            except DeviceError as error:
                self._notice(str(error))
            else:
                return  # a recording has an end
            pause = self._come_back(pause)

    def _come_back(self, pause: float) -> float:
        """Connect again, however long that takes; returns the first pause of the next time [s]."""
        while True:
            self._wait(pause)
            # Doubled after success too: a board that goes away again at once is asked rarely.
            pause = min(2.0 * pause, MAX_PAUSE)
            try:
                self.board.reconnect()
            except port.UnrecoverableError:
                raise
            except DeviceError as error:
                self._notice(str(error))
            else:
                return pause

    def _notice(self, problem: str) -> None:
        kinds = [re.sub(r"[\d.]+|;.*", "", each, flags=re.S) for each in (problem, self.problem)]
        self.problem = problem  # the newest line that came is another one each time
        if kinds[0] != kinds[1]:
            self.tell(problem or "the board is back")
