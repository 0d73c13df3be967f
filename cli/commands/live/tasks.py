"""Tasks of a live session that its page asks for: zero, check, set-up and recordings."""

import contextlib
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from eitskin import datasets, hardware, simulator, training
from eitskin.cli.commands.check import FRAMES, sensor_findings
from eitskin.cli.commands.live.session import Recording
from eitskin.cli.commands.own_sensor.adapt import ANGLES, in_words, open_start
from eitskin.cli.commands.own_sensor.poses import Dialogue, ask_for_poses, stage_poses
from eitskin.cli.commands.own_sensor.setup import FORCE, Setup, SetupOptions
from eitskin.cli.commands.tare import FRAMES as TARE_FRAMES
from eitskin.cli.page.commands import Commands, ConflictError, SessionCommands, make_commands
from eitskin.closeable import Closeable
from eitskin.errors import ConfigurationError, DeviceError, EitskinError, FrameError
from eitskin.latest import Latest
from eitskin.simulator.scene.scene import Scene

if TYPE_CHECKING:
    from eitskin.cli.commands.live.session import LiveSession

PATIENCE = 15.0  # s without a frame, after which a task fails; slow boards take seconds for one
_POLL = 0.1  # s between two looks whether a task was cancelled
MAX_LINES = 12


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
        name: name of the task.
        progress: whether it works, asks or is over, and how.
        text: present step, question or outcome.
        lines: lines reported so far, newest last.
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
    def is_over(self) -> bool:
        """Whether nothing more will happen."""
        return self.progress not in (Progress.WORKING, Progress.ASKING)


class CancelledError(EitskinError):
    """A task that somebody cancelled, or whose session has ended."""


class Task(Dialogue):
    """One piece of work in a thread of its own, which asks by buttons of the page.

    Attributes:
        state: state that is shown, replaced as a whole.
    """

    def __init__(
        self, name: str, readings: "Latest[hardware.Reading]", changed: Callable[[], None]
    ) -> None:
        """Prepare a task.

        Args:
            name: name of the task.
            readings: newest reading of the session.
            changed: called after every change of the state.
        """
        self.state = TaskState(name, Progress.WORKING)
        self._readings, self._changed = readings, changed
        self._cancelled = threading.Event()
        self._answered = threading.Condition()
        self._answer: Any = None  # text of the choice

    def run(self, work: "Callable[[Task], str]") -> None:
        """Do the work; its result, or its error, is the last state."""
        try:
            self._set_progress(Progress.DONE, work(self))
        except CancelledError:
            self._set_progress(Progress.CANCELLED, "cancelled")
        except EitskinError as error:
            self._set_progress(Progress.FAILED, str(error))
        except Exception as error:
            self._set_progress(Progress.FAILED, f"failed: {type(error).__name__}: {error}")
            raise

    def show(self, text: str) -> None:
        """Show what is being done."""
        self._set_progress(Progress.WORKING, text)

    def note(self, text: str) -> None:
        """Add a line to what was reported."""
        lines = (*self.state.lines, text)[-MAX_LINES:]
        self.state = replace(self.state, lines=lines)
        self._changed()

    def sketch(self, text: str) -> None:
        """Do nothing: the page shows places on its map."""

    def readings(self) -> "Iterator[hardware.Reading]":
        """Readings from the next one on, without those that become old meanwhile.

        Raises DeviceError where none comes for too long, CancelledError after `cancel`.
        """
        number = self._readings.number
        since = time.monotonic()
        while True:
            newest = self._readings.wait_after(number, _POLL)
            if self._cancelled.is_set() or self._readings.is_closed:
                raise CancelledError
            if newest is not None:
                number, since = newest[0], time.monotonic()
                yield newest[1]
            elif time.monotonic() - since > PATIENCE:
                raise DeviceError(
                    f"expected frames of the board, got none for {PATIENCE:g} s; begin again when "
                    "it is back"
                )

    def take(self, count: int, what: str) -> "list[hardware.Reading]":
        """So many readings, all of one session of the board; their number is shown."""
        readings: list[hardware.Reading] = []
        for reading in self.readings():
            if readings and readings[0].frame.session != reading.frame.session:
                readings = []  # the board has started again
            readings.append(reading)
            self.show(f"{what}: {len(readings)} of {count} frames")
            if len(readings) == count:
                break
        return readings

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
        self._set_progress(Progress.ASKING, text, tuple(choices.items()))
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
            self._set_progress(Progress.WORKING, self.state.text)  # from here on nothing is asked
            self._answered.notify_all()
        return True

    def cancel(self) -> None:
        """End the task at its next frame or question."""
        with self._answered:
            self._cancelled.set()
            self._answered.notify_all()

    def _set_progress(
        self, progress: Progress, text: str, choices: tuple[tuple[str, str], ...] = ()
    ) -> None:
        place = self.state.place if progress in (Progress.ASKING, Progress.WORKING) else None
        self.state = replace(self.state, progress=progress, text=text, choices=choices, place=place)
        self._changed()


class SessionBoard(Closeable):
    """The board of a live session, for one who reads frames next to the live loop.

    It stays open, and is connected to again, by the session.
    """

    def __init__(self, board: "hardware.Board", task: Task) -> None:
        """Frames are those that come while they are asked for."""
        self._board, self._task = board, task

    def __getattr__(self, name: str) -> Any:
        return getattr(self._board, name)

    def frames(self, newest: bool = False) -> "Iterator[simulator.Frame]":  # noqa: ARG002
        """Frames of the session from now on."""
        return self._task.frames()

    def close(self) -> None:
        """Do nothing: the session needs its board."""


MAX_FRAMES = 1000
USE = "use the new pipeline in this session? Lay the sensor flat, untouched, first"
END_TIMEOUT = 5.0  # s, after which a task is left alone: its files are whole or absent


class SessionTasks(Closeable, SessionCommands):
    """Tasks that a page may ask of a live session, one at a time, and its recordings.

    Attributes:
        folder: folder of the files that are made.
    """

    def __init__(
        self,
        session: "LiveSession",
        folder: Path,
        model: Path,
        method: "type[training.Method] | None" = None,
    ) -> None:
        """Take what is asked from now on.

        Args:
            session: live session.
            folder: folder of files that are made, itself made when it is needed.
            model: model that the pipeline was opened from, for a set-up to begin with.
            method: class of the user's own method; None for one of eitskin's.
        """
        self.folder = folder
        self._session = session
        self._model, self._method = model, method
        self._lock = threading.Lock()
        self._task: Task | None = None
        self._thread: threading.Thread | None = None
        self._recording: Recording | None = None
        self._recorded = ""
        self._recordings = self._find_recordings()

    @property
    def commands(self) -> Commands:
        acts: dict[str, Callable[..., None]] = {
            "/tare": lambda: self._start("zero", self._tare),
            "/check": lambda: self._start("check", self._check),
            "/record": self._record,
            "/setup": self._set_up,
            "/answer": self._give,
            "/cancel": self._cancel,
        }

        def take(act: Callable[[], Any]) -> None:
            with self._lock:
                act()
            self._tell()

        return {**make_commands(acts, take), **make_commands({"/replay": self._replay})}

    def state(self) -> Mapping[str, Any]:
        recording, task = self._recording, self._task
        return {
            "task": None if task is None else asdict(task.state) | {"over": task.state.is_over},
            "recording": recording
            and {
                "folder": str(recording.folder),
                "frames": recording.given,
                "problem": recording.problem,
            },
            "recorded": self._recorded,
            "recordings": list(self._recordings),
        }

    def close(self) -> None:
        with self._lock:
            if self._task is not None:
                self._task.cancel()
            with contextlib.suppress(ConfigurationError):
                self._record(False)
        if self._thread is not None:
            self._thread.join(END_TIMEOUT)

    def _tell(self) -> None:
        if self._session.page is not None:
            self._session.page.tell()

    def _start(self, name: str, work: Callable[[Task], str]) -> None:
        if self._task is not None and not self._task.state.is_over:
            raise ConflictError(
                f"{self._task.state.name} is not finished; wait for its end, or cancel it"
            )
        task = self._task = Task(name, self._session.latest, self._tell)
        self._thread = threading.Thread(target=task.run, args=(work,), name="task", daemon=True)
        self._thread.start()

    def _give(self, answer: str) -> None:
        if self._task is None or not self._task.answer(answer):
            raise ConflictError(f"nothing is asked that {answer!r} would answer")

    def _cancel(self) -> None:
        if self._task is None or self._task.state.is_over:
            raise ConflictError("nothing is being done that could be cancelled")
        self._task.cancel()

    def _tare(self, task: Task) -> str:
        readings = task.take(TARE_FRAMES, "hold the sensor still and untouched")
        frames = [reading.frame for reading in readings]
        return self._in_loop(task, lambda: self._session.tare(frames))

    def _in_loop(self, task: Task, function: Callable[[], str]) -> str:
        """Result of a function that the live loop calls between two frames."""
        asked = self._session.call_between_frames(function)
        for _ in task.readings():
            if asked.done():
                break
        return asked.result()

    def _check(self, task: Task) -> str:
        readings = task.take(FRAMES, "keep the sensor flat and untouched")
        frames = [reading.frame for reading in readings]
        findings = sensor_findings(self._session.pipeline, frames, lambda: _estimate(readings[-1]))
        for sentence in findings.sentences:
            task.note(sentence)
        return findings.describe(len(readings))

    def _set_up(self, angles: str = ANGLES, presses: int = 10, frames: int = 8) -> None:
        options = SetupOptions(angles, presses, frames)
        if max(presses, options.frames) > MAX_FRAMES:
            raise ConfigurationError(
                f"expected at most {MAX_FRAMES} touches, and frames in each pose, got "
                f"{presses} and {options.frames}"
            )
        out = self._fresh("setup", ".eitmodel")
        board = self._session.connection.board

        def work(task: Task) -> str:
            task.show(f"opening {self._model}")
            hand = ask_for_poses(task) if board.stage is None else stage_poses(FORCE)
            start = open_start(self._model, self._method)
            opened: Any = partial(SessionBoard, board, task)
            done = Setup(self._model, start, out, options, task, hand)
            try:
                adapted = done.run(opened)
            finally:
                if board.stage is not None:  # which the set-up itself has moved
                    board.stage.set(Scene())
                if done.taken:
                    task.note(done.kept_files_note)
            text = f"{done.out}: {in_words(adapted)}\nfor later: {done.live_command(board.uri)}"
            task.note(text)
            if task.ask(USE, {"": "use it now", "n": "not now"}):
                return text
            return f"{text}\n{self._in_loop(task, lambda: self._exchange(done))}"

        self._start("set up", work)

    def _exchange(self, done: Setup) -> str:
        """Go on with the pipeline that was set up; between two frames."""
        done.adapted.use(None if done.zero is None else training.StoredReference.read(done.zero))
        self._session.pipeline, self._session.checks = done.adapted, True
        text = "this session goes on with it"
        self._session.say(f"{done.out}: {text}")
        return text

    def _record(self, record: bool) -> None:
        """Begin or end the recording; raises ConflictError where there is nothing to do."""
        if record == (self._recording is not None):
            what, now = ("begin", "one") if record else ("end", "none")
            raise ConflictError(f"expected a recording to {what}, but {now} is being made")
        if self._recording is None:
            folder = self._fresh("recording")
            self._recording = Recording(datasets.ShardWriter(folder), folder)
            self._session.begin(self._recording)
            return
        ended, self._recording = self._recording, None
        self._session.end(ended)
        self._recorded = ended.loss or f"{ended.folder}: {ended.given} frames"
        self._recordings = self._find_recordings()
        self._session.say(f"recorded: {self._recorded}")

    def _find_recordings(self) -> dict[str, Path]:
        """Recordings in the page's folder, and the one that the board replays, by name."""
        scheme, _, replayed = self._session.connection.board.uri.partition(":")
        here = Path(replayed.partition("?")[0])
        found = {
            path.parent.name: path.parent
            for path in sorted(self.folder.glob("*/*.h5"), reverse=True)
        }
        return found | ({here.name: here} if scheme == "replay" else {})

    def _replay(self, name: str) -> bytes:
        """Readings of a recording by a new pipeline of the session's model, as JSON."""
        import msgspec

        from eitskin.cli.page.drawing import sensor_or_region
        from eitskin.cli.page.live_page import recorded_moments

        if name not in self._recordings:
            raise ConfigurationError(f"there is no recording {name!r} in {self.folder}")
        pipeline = training.open_pipeline(self._model, self._method)
        with hardware.ReplayBoard(str(self._recordings[name])) as board:
            own = self._session.connection.board.protocol
            own.require_same(board.protocol, "the board has", name, "choose another recording")
            moments = recorded_moments(board, pipeline, sensor_or_region(pipeline))
        return msgspec.json.encode({"readings": moments})

    def _fresh(self, name: str, ending: str = "") -> Path:
        """Path of this second in the page's folder, which does not exist yet."""
        name = f"{name}-{time.strftime('%Y%m%d-%H%M%S')}"
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ConfigurationError(
                f"cannot make {self.folder}: {error.strerror or error}; name another --page-folder"
            ) from error
        number, path = 1, self.folder / f"{name}{ending}"
        while path.exists():
            number += 1
            path = self.folder / f"{name}-{number}{ending}"
        return path


def _estimate(reading: "hardware.Reading") -> "hardware.Estimate":
    if reading.estimate is None:
        raise FrameError(reading.problem)
    return reading.estimate
