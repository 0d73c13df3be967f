"""Frames of a board that may go away: it is connected to again and again until it is back."""

import time
from collections.abc import Callable, Iterator

from eitskin.errors import DeviceError
from eitskin.frame import Frame
from eitskin.hardware.boards.board import Board
from eitskin.hardware.boards.reopenable_port import UnrecoverableError

FIRST_PAUSE = 0.1  # s, before the first try
LONGEST_PAUSE = 5.0  # s; the pause doubles until then


class Connection:
    """A board that is kept for as long as it takes.

    Attributes:
        board: that gives the frames.
        problem: why none come; empty while they do.
        tell: told of each new problem, and of its end.
    """

    def __init__(self, board: Board, wait: Callable[[float], None] = time.sleep) -> None:
        """Keep `board`, which is open; `wait` waits so many seconds."""
        self.board, self._wait = board, wait
        self.problem = ""
        self.tell: Callable[[str], None] = lambda _: None

    def frames(self, newest: bool = False) -> Iterator[Frame]:
        """The board's frames, as `Board.frames` gives them, over all interruptions.

        Raises DeviceError where connecting again cannot help: another board answers, or this one
        was closed.
        """
        pause = FIRST_PAUSE
        while True:
            try:
                for frame in self.board.frames(newest=newest):
                    pause = FIRST_PAUSE
                    self._notice("")
                    yield frame
            except UnrecoverableError:
                raise
            except DeviceError as error:
                self._notice(str(error))
            else:
                return  # a recording has an end
            pause = self._come_back(pause)

    def _come_back(self, pause: float) -> float:
        """Connect again, however long it takes; returns the pause to begin with next time [s]."""
        while True:
            self._wait(pause)
            # Doubled after success too: a board that goes away at once again is not hammered.
            pause = min(2.0 * pause, LONGEST_PAUSE)
            try:
                self.board.reconnect()
            except UnrecoverableError:
                raise
            except DeviceError as error:
                self._notice(str(error))
            else:
                return pause

    def _notice(self, problem: str) -> None:
        if problem != self.problem:
            self.problem = problem
            self.tell(problem or "the board is back")
