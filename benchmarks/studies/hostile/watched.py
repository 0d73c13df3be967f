"""Processes that perform trials, watched for crashes, time and memory."""

import importlib
import json
import os
import resource
import selectors
import signal
import subprocess
import tempfile
import warnings
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Final

from eitskin import contained, contained_child
from eitskin.errors import EitskinError

SECONDS: Final = 60
"""Processor time after which a trial counts as hanging [s]; recordings have 30 s for a block."""

WAIT: Final = 300.0
"""Time by the clock after which a trial counts as hanging [s], such as one that waits for ever."""

MOST_BYTES: Final = 500_000_000
OUTCOMES: Final = ("read", "one clear error", "traceback", "crash", "hang", "over 500 MB")

Task = tuple[str, int]


def watched(
    seed: int, tasks: Sequence[Task], workers: int = 1
) -> Iterator[tuple[str, int, str, str]]:
    """Kind, number, outcome and message of each trial, as they end.

    The trials are made in processes that are forked from this one, which has loaded what they
    need; where one ends, the next takes up its other tasks.
    """
    importlib.import_module(f"{__package__}.kinds")
    lanes = [_Lane(seed, deque(tasks[first::workers])) for first in range(workers)]
    with selectors.DefaultSelector() as selector:
        for lane in lanes:
            lane.start(selector)
        while selector.get_map():
            for key, _ in selector.select():
                yield from key.data.results(selector)


class _Lane:
    """Tasks that one process at a time performs."""

    def __init__(self, seed: int, tasks: deque[Task]) -> None:
        self._seed, self._tasks = seed, tasks
        self._pid = self._answers = -1
        self._begun = b""

    def start(self, selector: selectors.BaseSelector) -> None:
        """Fork a process for the tasks, where there are any."""
        if not self._tasks:
            return
        self._answers, end = os.pipe()
        self._pid = os.fork()
        if self._pid == 0:
            with suppress(BaseException):
                _perform(self._seed, list(self._tasks), end)
            os._exit(0)
        os.close(end)
        selector.register(self._answers, selectors.EVENT_READ, self)

    def results(self, selector: selectors.BaseSelector) -> Iterator[tuple[str, int, str, str]]:
        """Answer of the process; where it has ended, the reason, and the next is started."""
        content = os.read(self._answers, 1 << 16)
        *lines, self._begun = (self._begun + content).split(b"\n")
        for line in lines:
            yield *self._tasks.popleft(), *json.loads(line)
        if not content:
            selector.unregister(self._answers)
            os.close(self._answers)
            code = os.waitstatus_to_exitcode(os.waitpid(self._pid, 0)[1])
            if self._tasks:
                hung = code in (-signal.SIGXCPU, -signal.SIGALRM)
                how = "hang" if hung else "crash"
                yield *self._tasks.popleft(), how, f"ended with {code}"
            self.start(selector)


def _perform(seed: int, tasks: Sequence[Task], end: int) -> None:
    """Perform tasks in this process and write their outcomes, a line each.

    Whatever else is open is closed, so that a process whose reader has gone ends.
    """
    os.closerange(3, end)
    os.closerange(end + 1, 1024)
    nothing = os.open(os.devnull, os.O_RDWR)
    for number in (0, 1):  # what a library prints is no answer
        os.dup2(nothing, number)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    warnings.simplefilter("ignore")
    from eitskin.benchmarks.studies.hostile.kinds import draws, trial

    contained._Child._idle.clear()
    contained.subprocess = SimpleNamespace(  # type: ignore[attr-defined, assignment]
        Popen=lambda *_, **__: _ForkedChild(), PIPE=subprocess.PIPE, DEVNULL=subprocess.DEVNULL
    )
    with os.fdopen(end, "w") as answers, tempfile.TemporaryDirectory() as folder:
        os.environ["EITSKIN_CACHE"] = str(Path(folder) / "cache")
        for kind, number in tasks:
            _limit()
            result = outcome(trial(kind), draws(seed, kind, number), Path(folder))
            print(json.dumps(result), file=answers, flush=True)


class _ForkedChild:
    """Child of `contained`, forked from this process, which has imported everything.

    It is what a new process is, but for the second that this takes to start.
    """

    def __init__(self) -> None:
        tasks, self._tasks = os.pipe()
        self._answers, answers = os.pipe()
        self.pid = os.fork()
        if self.pid == 0:
            os.dup2(tasks, 0)
            os.dup2(answers, 1)
            os.closerange(3, 1024)
            signal.setitimer(signal.ITIMER_REAL, 0)
            with suppress(BaseException):
                contained_child.main()
            os._exit(0)
        os.close(tasks)
        os.close(answers)
        self.stdin, self.stdout = os.fdopen(self._tasks, "wb"), os.fdopen(self._answers, "rb")
        self._code: int | None = None

    def poll(self, wait: bool = False) -> int | None:
        """Exit status, negative for a signal; None while it runs."""
        if self._code is None:
            pid, status = os.waitpid(self.pid, 0 if wait else os.WNOHANG)
            if pid:
                self._code = os.waitstatus_to_exitcode(status)
        return self._code

    def wait(self) -> int | None:
        """Exit status when it has ended."""
        return self.poll(wait=True)

    def kill(self) -> None:
        """End it, unless it has ended."""
        if self.poll() is None:
            os.kill(self.pid, signal.SIGKILL)


def _limit() -> None:
    """End this process if the next trial takes too long, and begin to count its memory."""
    used = resource.getrusage(resource.RUSAGE_SELF)
    limit = int(used.ru_utime + used.ru_stime) + SECONDS
    resource.setrlimit(resource.RLIMIT_CPU, (limit, resource.RLIM_INFINITY))
    signal.setitimer(signal.ITIMER_REAL, WAIT)
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
    data = _status("self", "VmData")
    if data:
        # Twice as much, so that what is over is counted and the machine is safe.
        resource.setrlimit(resource.RLIMIT_DATA, (data + 2 * MOST_BYTES, resource.RLIM_INFINITY))


def outcome(trial: Any, numbers: Any, folder: Path) -> tuple[str, str]:
    """Outcome and message of one trial."""
    before = _peak()  # what earlier trials have loaded stays
    try:
        trial(numbers, folder)
        found, message = "read", ""
    except EitskinError as error:
        found, message = "one clear error", str(error)
    except MemoryError:
        found, message = "over 500 MB", ""
    except Exception as error:  # whatever comes is what is looked for
        found, message = "traceback", f"{type(error).__name__}: {error}"
    if _peak() - before > MOST_BYTES:
        found = "over 500 MB"
    return found, message[:300]


def _peak() -> int:
    """Largest memory of this process since the peak was reset, or of a waiting reader [bytes]."""
    readers = (str(child._process.pid) for child in contained._Child._idle)
    return max(_status(each, "VmHWM") for each in ("self", *readers))


def _status(process: str, name: str) -> int:
    """Size in the status of a process [bytes]; 0 where the system tells none."""
    with suppress(OSError):
        text = Path(f"/proc/{process}/status").read_text(encoding="ascii")
        return sum(
            int(line.split()[1]) << 10 for line in text.splitlines() if line.startswith(name)
        )
    return 0
