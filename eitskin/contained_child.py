"""Child of `contained`: calls readers within limits, and answers on its output."""

import importlib
import os
import sys
from contextlib import suppress
from pathlib import Path
from typing import IO, Any

from eitskin.contained import Answer, read_message, write_message
from eitskin.errors import ConfigurationError, DataError
from eitskin.input_files import printable

_MEGABYTE = 1 << 20


def main() -> None:
    """Answer tasks until the input ends."""
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
    try:
        made = getattr(importlib.import_module(module), function)
        _limit_memory(memory)
        _limit_time(seconds)
        for answer in made(argument, task.arrays["content"].tobytes()):
            write_message(answers, ["answer", answer.data], answer.arrays)
            _limit_time(seconds)
    except MemoryError:
        _unlimit()
        error: Any = f"it takes more than {memory // _MEGABYTE} MB of memory to read"
        write_message(answers, ["DataError", error], {})
    except (ConfigurationError, DataError, ImportError) as error:
        _unlimit()
        kind = next(k for k in (ConfigurationError, DataError, ImportError) if isinstance(error, k))
        write_message(answers, [kind.__name__, printable(error)], {})
    except BaseException as error:
        _unlimit()
        said = f"it cannot be read: {type(error).__name__}: {str(error)[:1000]}"
        write_message(answers, ["DataError", said], {})
    else:
        _unlimit()
        write_message(answers, None, {})


def _limit_time(seconds: int) -> None:
    """End this process after more `seconds` of processor time."""
    with suppress(ImportError):  # Windows
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
    with suppress(ImportError):
        import resource

        unlimited = (resource.RLIM_INFINITY, resource.RLIM_INFINITY)
        resource.setrlimit(resource.RLIMIT_CPU, unlimited)
        if sys.platform == "linux":
            resource.setrlimit(resource.RLIMIT_DATA, unlimited)
