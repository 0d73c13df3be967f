"""Processes that perform trials, watched for crashes, time and memory."""

import json
import os
import resource
import signal
import subprocess
import sys
import tempfile
import warnings
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


def watched(seed: int, tasks: Sequence[Task]) -> Iterator[tuple[str, int, str, str]]:
    """Kind, number, outcome and message of each trial, in processes of their own."""
    while tasks:
        done = 0
        for outcome, message in _in_child(seed, tasks):
            yield *tasks[done], outcome, message
            done += 1
        tasks = tasks[done:]


def _in_child(seed: int, tasks: Sequence[Task]) -> Iterator[tuple[str, str]]:
    """Outcomes of tasks in a child, until it ends; the last is why."""
    with subprocess.Popen(  # noqa: S603 - this package
        [sys.executable, "-m", f"{__package__}.run", "--watched"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as child:
        assert child.stdin is not None  # noqa: S101 - pipes, as asked for
        assert child.stdout is not None  # noqa: S101
        child.stdin.write(json.dumps([seed, tasks]))
        child.stdin.close()
        count = 0
        for line in child.stdout:
            count += 1
            outcome, message = json.loads(line)
            yield outcome, message
        code = child.wait()
        if count < len(tasks):
            hung = code in (-signal.SIGXCPU, -signal.SIGALRM)
            yield ("hang" if hung else "crash"), f"ended with {code}"


def perform() -> None:
    """Perform the tasks of the input in this process."""
    seed, tasks = json.load(sys.stdin)
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # what a library prints is no answer
    warnings.simplefilter("ignore")
    from eitskin.benchmarks.studies.hostile.kinds import draws, trial

    contained.subprocess = SimpleNamespace(  # type: ignore[attr-defined, assignment]
        Popen=lambda *_, **__: _ForkedChild(), PIPE=subprocess.PIPE, DEVNULL=subprocess.DEVNULL
    )
    with tempfile.TemporaryDirectory() as folder:
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
