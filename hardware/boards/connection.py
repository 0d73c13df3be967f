"""Frames of a board over interruptions: reconnection with growing pauses."""

import time
from collections.abc import Callable, Iterator

from eitskin.errors import DeviceError
from eitskin.frame import Frame
from eitskin.hardware.boards.board import Board
from eitskin.hardware.boards.reopenable_port import UnrecoverableError

FIRST_PAUSE = 0.1  # s, before the first try
LONGEST_PAUSE = 5.0  # s; the pause doubles until then


class Connection:
    """Board that is reconnected until frames come again.

    Attributes:
        board: source of the frames.
        problem: reason why no frames come; empty while frames come.
        tell: called with each new problem, and with its end.
    """

    def __init__(self, board: Board, wait: Callable[[float], None] = time.sleep) -> None:
        """Take the open `board`; `wait` sleeps for a number of seconds."""
        self.board, self._wait = board, wait
        self.problem = ""
        self.tell: Callable[[str], None] = lambda _: None

    def frames(self, newest: bool = False) -> Iterator[Frame]:
        """Frames of the board, as `Board.frames` gives them, over all interruptions.

        Raises UnrecoverableError, a DeviceError, where connecting again cannot help: another
        board answers, or this board was closed.
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
        """Connect again, however long that takes; returns the first pause of the next time [s]."""
        while True:
            self._wait(pause)
            # Doubled after success too: a board that goes away again at once is asked rarely.
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
