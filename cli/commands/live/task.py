"""One piece of work beside the live loop: frames of the session, questions and their answers."""

import threading
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any

from eitskin import hardware, simulator
from eitskin.cli.commands.own_sensor.poses import Dialogue
from eitskin.errors import DeviceError, EitskinError
from eitskin.latest import Latest

PATIENCE = 15.0  # s without a frame, after which a task fails; slow boards take seconds for one
_GLANCE = 0.1  # s between two looks whether a task was cancelled
MOST_LINES = 12


class Progress(StrEnum):
    """State of a task."""

    WORKING = "working"
    ASKING = "asking"
    DONE = "done"
    FAILED = "failed"
    CANCELLED = "cancelled"


@dataclass(frozen=True, slots=True)
class TaskState:
    """State of a task, for those who watch it.

    Attributes:
        name: of the task.
        progress: whether it works, asks or is over, and how.
        text: what is being done or asked, or what came of it.
        lines: what was said so far, newest last.
        choices: words of the possible answers, by answer.
        place: position on the sensor that the question is about, (x, y) [m].
    """

    name: str
    progress: Progress
    text: str = ""
    lines: tuple[str, ...] = ()
    choices: tuple[tuple[str, str], ...] = ()
    place: tuple[float, float] | None = None

    @property
    def over(self) -> bool:
        """Whether nothing more will happen."""
        return self.progress not in (Progress.WORKING, Progress.ASKING)


class CancelledError(EitskinError):
    """A task that somebody cancelled, or whose session has ended."""


class Task(Dialogue):
    """One piece of work in a thread of its own, which asks by buttons of the page.

    Attributes:
        state: what there is to see, replaced as a whole.
    """

    def __init__(
        self,
        name: str,
        readings: "Latest[hardware.Reading]",
        changed: Callable[[], None],
        patience: float = PATIENCE,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Prepare a task.

        Args:
            name: of the task.
            readings: newest reading of the session.
            changed: called after every change of the state.
            patience: time without a frame, after which the task fails [s].
            clock: [s].
        """
        self.state = TaskState(name, Progress.WORKING)
        self._readings, self._changed = readings, changed
        self._patience, self._clock = patience, clock
        self._cancelled = threading.Event()
        self._answered = threading.Condition()
        self._answer: Any = None  # text of the choice

    def run(self, work: "Callable[[Task], str]") -> None:
        """Do the work; its result, or its error, is the last state."""
        try:
            self._become(Progress.DONE, work(self))
        except CancelledError:
            self._become(Progress.CANCELLED, "cancelled")
        except EitskinError as error:
            self._become(Progress.FAILED, str(error))
        except Exception as error:
            self._become(Progress.FAILED, f"failed: {type(error).__name__}: {error}")
            raise

    def show(self, text: str) -> None:
        """Show what is being done."""
        self._become(Progress.WORKING, text)

    def note(self, text: str) -> None:
        """Add a line to what was said."""
        lines = (*self.state.lines, text)[-MOST_LINES:]
        self.state = replace(self.state, lines=lines)
        self._changed()

    def sketch(self, text: str) -> None:
        """Do nothing: the page shows places on its map."""

    def readings(self) -> "Iterator[hardware.Reading]":
        """Readings from the next one on, without those that become old meanwhile.

        Raises DeviceError where none comes for too long, CancelledError after `cancel`.
        """
        number = self._readings.number
        since = self._clock()
        while True:
            newest = self._readings.after(number, _GLANCE)
            if self._cancelled.is_set() or self._readings.closed:
                raise CancelledError
            if newest is not None:
                number, since = newest[0], self._clock()
                yield newest[1]
            elif self._clock() - since > self._patience:
                raise DeviceError(
                    f"expected frames of the board, got none for {self._patience:g} s; begin again "
                    "when it is back"
                )

    def take(self, count: int, what: str) -> "list[hardware.Reading]":
        """So many readings, all of one session of the board; their number is shown."""
        taken: list[hardware.Reading] = []
        for reading in self.readings():
            if taken and taken[0].frame.session != reading.frame.session:
                taken = []  # the board has started anew
            taken.append(reading)
            self.show(f"{what}: {len(taken)} of {count} frames")
            if len(taken) == count:
                break
        return taken

    def frames(self) -> "Iterator[simulator.Frame]":
        """Frames of `readings`."""
        for reading in self.readings():
            yield reading.frame

    def ask(
        self, text: str, choices: Mapping[str, str], place: tuple[float, float] | None = None
    ) -> str:
        """Answer to a question, one of the choices; raises CancelledError after `cancel`."""
        with self._answered:
            self._answer = None
        self.state = replace(self.state, place=place)
        self._become(Progress.ASKING, text, tuple(choices.items()))
        with self._answered:
            self._answered.wait_for(lambda: self._cancelled.is_set() or self._answer is not None)
            if self._answer is None:
                raise CancelledError
            return str(self._answer)

    def answer(self, text: str) -> bool:
        """Answer the question; False where there is none, or none with this choice."""
        with self._answered:
            asked = self.state.progress is Progress.ASKING and self._answer is None
            if not asked or text not in dict(self.state.choices):
                return False
            self._answer = text
            self._become(Progress.WORKING, self.state.text)  # from here on nothing is asked
            self._answered.notify_all()
        return True

    def cancel(self) -> None:
        """End the task at its next frame or question."""
        with self._answered:
            self._cancelled.set()
            self._answered.notify_all()

    def _become(
        self, progress: Progress, text: str, choices: tuple[tuple[str, str], ...] = ()
    ) -> None:
        place = self.state.place if progress in (Progress.ASKING, Progress.WORKING) else None
        self.state = replace(self.state, progress=progress, text=text, choices=choices, place=place)
        self._changed()
