"""Reading of files from elsewhere in a process of its own, which may crash, loop or fill up alone.

HDF5, SciPy and the readers of other formats are large, and damage can end the process, keep it
busy for ever or fill its memory. A reader is a function of a module that yields `Answer`s; it is
called in a child with limits on processor time and memory, and its answers come back as plain
data and arrays, of which nothing is executed. A child that has answered is used again.

The child has the rights of its user: it contains accidents and malformed files, not an attacker.
"""

import contextlib
import importlib
import os
import signal
import struct
import subprocess
import sys
import threading
from collections.abc import Generator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any, ClassVar, Final

import msgspec
import numpy as np
from numpy.typing import NDArray

from eitskin.errors import ConfigurationError, DataError
from eitskin.files import printable

SIZE: Final = struct.Struct("<Q")
"""Begin of a message: its size [bytes]."""

_Message = tuple[Any, dict[str, tuple[str, tuple[int, ...], bytearray]]]

_CHILD: Final = "from eitskin.reader_process import answer_tasks; answer_tasks()"
_ERRORS: Final = {
    "ConfigurationError": ConfigurationError,
    "DataError": DataError,
    "ImportError": ImportError,
}


@dataclass(frozen=True, slots=True, eq=False)
class Answer:
    """Part of what a reader found: plain data, and arrays by name."""

    data: Any = None
    arrays: Mapping[str, NDArray[Any]] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Limits:
    """Limits of a reader, beyond which it is ended.

    Attributes:
        seconds: seconds of processor time for each answer.
        memory: next to that of the program itself [bytes]; kept to on Linux.
    """

    seconds: int
    memory: int


def read_in_subprocess(
    reader: str, argument: Any, content: bytes, limits: Limits
) -> Generator[Answer, None, None]:
    """Answers of a reader that is called in a child with plain data as `argument`, and with bytes.

    The reader is "module:function" of a function of `argument` and `content` that yields `Answer`s.
    Raises DataError where it raises anything but a ConfigurationError or an ImportError, ends its
    process, or is ended at its limits.
    """
    child = _Child.idle()
    clean = False
    try:
        yield from child.answers(reader, argument, content, limits)
        clean = True
    except (ConfigurationError, ImportError):
        clean = True
        raise
    except DataError:
        clean = child.running()
        raise
    finally:
        child.release(clean)


def write_message(stream: IO[bytes], data: Any, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write plain data and arrays, none of which is an object, to a stream."""
    if any(array.dtype.hasobject for array in arrays.values()):
        raise ValueError("expected arrays of plain numbers or text, got objects")
    packed = {name: (a.dtype.str, a.shape, a.tobytes()) for name, a in arrays.items()}
    content = msgspec.msgpack.encode((data, packed))
    stream.write(SIZE.pack(len(content)) + content)
    stream.flush()


def read_message(stream: IO[bytes]) -> Answer:
    """Read what `write_message` wrote; raises EOFError where the stream ends."""
    (size,) = SIZE.unpack(_exactly(stream, SIZE.size))
    data, packed = msgspec.msgpack.decode(_exactly(stream, size), type=_Message)
    return Answer(data, {n: np.frombuffer(c, d).reshape(s) for n, (d, s, c) in packed.items()})


def _exactly(stream: IO[bytes], size: int) -> bytes:
    content = stream.read(size)
    if len(content) != size:
        raise EOFError
    return content


class _Child:
    """Process that calls readers, one at a time."""

    _idle: ClassVar["list[_Child]"] = []
    _lock: ClassVar = threading.Lock()

    def __init__(self) -> None:
        environment = os.environ | {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
        try:
            self._process = subprocess.Popen(  # noqa: S603 - this interpreter
                [sys.executable, "-P", "-c", _CHILD],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                env=environment,
                start_new_session=True,  # Ctrl-C is answered by this process
            )
        except OSError as error:
            raise DataError(
                f"cannot start a process that reads the file: {error}; close other programs"
            ) from error
        self._owner = os.getpid()

    @classmethod
    def idle(cls) -> "_Child":
        """A child that waits, or a new one; those of the parent of a fork are not used."""
        with cls._lock:
            while cls._idle:
                child = cls._idle.pop()
                if child._owner == os.getpid() and child.running():
                    return child
        return cls()

    def running(self) -> bool:
        """Whether the process lives."""
        return self._process.poll() is None

    def release(self, clean: bool) -> None:
        """Keep the child for the next file, or end it where it is still busy."""
        if clean and self.running():
            with self._lock:
                self._idle.append(self)
            return
        self._process.kill()
        self._process.wait()
        for stream in (self._process.stdin, self._process.stdout):
            with contextlib.suppress(OSError):
                stream.close()  # type: ignore[union-attr]

    def answers(
        self, reader: str, argument: Any, content: bytes, limits: Limits
    ) -> Generator[Answer, None, None]:
        """Answers of a reader; errors as for `read_in_subprocess`."""
        task = [reader, argument, limits.seconds, limits.memory]
        sent = np.frombuffer(content, dtype=np.uint8)
        to, back = self._process.stdin, self._process.stdout
        assert to is not None  # noqa: S101 - pipes, as asked for
        assert back is not None  # noqa: S101
        try:
            write_message(to, task, {"content": sent})
            while True:
                answer = read_message(back)
                if answer.data is None:
                    return
                kind, data = answer.data
                if kind != "answer":
                    raise _ERRORS[kind](data)
                yield Answer(data, answer.arrays)
        except (EOFError, OSError) as error:
            raise DataError(_ending(self._process.wait(), limits)) from error


def _ending(code: int, limits: Limits) -> str:
    """Reason why a child ended while it read."""
    if code == -getattr(signal, "SIGXCPU", 0):
        return (
            f"reading it takes more than {limits.seconds} s of processor time; it is damaged, or "
            "not the file that it seems to be"
        )
    how = f"by signal {-code}" if code < 0 else f"with code {code}"
    return (
        f"the process that read it ended {how}; it is damaged, or not the file that it seems to "
        "be: copy it again"
    )


# In the child


def answer_tasks() -> None:
    """Call readers within limits, and answer on this process's output, until the input ends."""
    tasks = os.fdopen(os.dup(0), "rb")
    answers = os.fdopen(os.dup(1), "wb")
    nothing = os.open(os.devnull, os.O_RDWR)
    for number in (0, 1):  # what a library prints is no answer
        os.dup2(nothing, number)
    while True:
        try:
            task = read_message(tasks)
        except EOFError:
            return
        _perform(task, answers)


def _perform(task: Answer, answers: IO[bytes]) -> None:
    """Call one reader and write its answers, or its error."""
    reader, argument, seconds, memory = task.data
    module, _, function = reader.partition(":")
    outcome: Any = None
    try:
        reader_function = getattr(importlib.import_module(module), function)
        _limit_memory(memory)
        _limit_time(seconds)
        for answer in reader_function(argument, task.arrays["content"].tobytes()):
            write_message(answers, ["answer", answer.data], answer.arrays)
            _limit_time(seconds)
    except MemoryError:
        _unlimit()
        outcome = "DataError", f"it takes more than {memory // (1 << 20)} MB of memory to read"
    except BaseException as error:
        _unlimit()
        outcome = "DataError", f"it cannot be read: {type(error).__name__}: {str(error)[:1000]}"
        for name, kind in _ERRORS.items():
            if isinstance(error, kind):
                outcome = name, printable(error)
    _unlimit()
    write_message(answers, outcome, {})


def _limit_time(seconds: int) -> None:
    """End this process after more `seconds` of processor time."""
    with contextlib.suppress(ImportError):  # Windows
        import resource

        used = resource.getrusage(resource.RUSAGE_SELF)
        most = int(used.ru_utime + used.ru_stime) + seconds + 1
        resource.setrlimit(resource.RLIMIT_CPU, (most, resource.RLIM_INFINITY))


def _limit_memory(size: int) -> None:
    """Let this process have `size` more bytes of memory of its own."""
    if sys.platform == "linux":
        import resource

        status = Path("/proc/self/status").read_text(encoding="ascii")
        used = next(line for line in status.splitlines() if line.startswith("VmData"))
        most = int(used.split()[1]) * 1024 + size
        resource.setrlimit(resource.RLIMIT_DATA, (most, resource.RLIM_INFINITY))


def _unlimit() -> None:
    """Lift the limits until the next task."""
    with contextlib.suppress(ImportError):
        import resource

        unlimited = (resource.RLIM_INFINITY, resource.RLIM_INFINITY)
        resource.setrlimit(resource.RLIMIT_CPU, unlimited)
        if sys.platform == "linux":
            resource.setrlimit(resource.RLIMIT_DATA, unlimited)
