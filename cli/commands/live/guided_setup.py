"""The steps of `eitskin setup` on the live page, with frames of its session."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from eitskin.cli.commands.live.task import Task
from eitskin.cli.commands.own_sensor.adapt import open_start
from eitskin.cli.commands.own_sensor.dialogue import Dialogue
from eitskin.cli.commands.own_sensor.poses import asked, staged
from eitskin.cli.commands.own_sensor.setup import FORCE, Setup, SetupResult, Wanted, design_of
from eitskin.closeable import Closeable

if TYPE_CHECKING:
    from eitskin.frame import Frame
    from eitskin.hardware.boards.board import Board, Counts
    from eitskin.training.method.interface import Method


@dataclass(frozen=True, slots=True)
class PageDialogue(Dialogue):
    """Dialogue by buttons of the page, which shows places on its map."""

    task: Task

    def ask(
        self, text: str, choices: Mapping[str, str], place: tuple[float, float] | None = None
    ) -> str:
        return self.task.ask(text, choices, place)

    def note(self, text: str) -> None:
        self.task.say(text)

    def sketch(self, text: str) -> None:
        pass


class SessionBoard(Closeable):
    """The board of a live session, for one who reads frames beside the live loop."""

    def __init__(self, board: "Board", task: Task) -> None:
        """Frames are those that come while they are asked for."""
        self._board, self._task = board, task
        self.uri, self.info, self.protocol = board.uri, board.info, board.protocol
        self.stage = board.stage

    @property
    def counts(self) -> "Counts":
        """Counts of the session."""
        return self._board.counts

    @property
    def lost(self) -> int:
        """Number of frames lost in the session."""
        return self._board.lost

    def frames(self, newest: bool = False) -> "Iterator[Frame]":  # noqa: ARG002
        """Frames of the session from now on, the newest only.

        Raises DeviceError where none comes for too long.
        """
        return self._task.frames()

    def calibrate(self) -> None:
        """Do nothing: the session goes on meanwhile."""

    def reconnect(self) -> None:
        """Do nothing: the session connects again by itself."""

    def close(self) -> None:
        """Do nothing: the session needs its board."""


def guided_setup(
    task: Task,
    board: "Board",
    model: Path,
    method: "type[Method] | None",
    out: Path,
    wanted: Wanted,
) -> SetupResult:
    """Go through the steps of a set-up.

    Args:
        task: with the frames of the session.
        board: of the session; a virtual one is moved by the set-up itself.
        model: trained pipeline to start from.
        method: class of the user's own method; None for one of eitskin's.
        out: of the sensor's own pipeline.
        wanted: what is taken of the sensor.
    """
    task.show(f"opening {model}")
    start, dialogue = open_start(model, method), PageDialogue(task)
    virtual = board.stage is not None
    hand = staged(FORCE) if virtual else asked(dialogue)
    setup = Setup(model, start, design_of(start), out, wanted, dialogue, hand)
    try:
        return setup.run(lambda: SessionBoard(board, task))
    finally:
        if virtual:
            _flatten(board)
        if setup.taken:
            task.say(setup.kept)


def _flatten(board: "Board") -> None:
    from eitskin.simulator.scene.scene import Scene

    board.stage.set(Scene())
