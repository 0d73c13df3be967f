"""Report of an unexpected exception, in a file that can be sent."""

import os
import platform
import shlex
import sys
import tempfile
import traceback
from datetime import UTC, datetime
from importlib import metadata

from eitskin import __version__
from eitskin.files import printable

_PACKAGES = ("h5py", "msgspec", "numpy", "safetensors", "scikit-fem", "scipy", "torch")
_LONGEST_LINE = 300  # characters; the message of an exception may quote a file


def told(error: Exception) -> str:
    """Sentence about an unexpected exception, whose report is written.

    Memory that ends is a fault of the input or of the machine, and needs no report.
    """
    if isinstance(error, MemoryError):
        return (
            "eitskin: the memory is not enough; ask for less, such as a smaller file, mesh or "
            "dataset, or fewer workers\n"
        )
    kind = type(error).__name__
    try:
        place = f"; please send {_written(report(error))}, after a look at what it says"
    except OSError:
        place = f", in {_place(error)}; no report could be written"
    return f"eitskin: this is a fault of eitskin ({kind}){place}\n"


def report(error: Exception) -> str:
    """Text of a report: versions, the command, and where the exception was raised.

    Files are named as the command names them; their content is not in it but for what messages
    quote, which is cut.
    """
    lines = [
        f"eitskin {__version__}, {datetime.now(UTC):%Y-%m-%d %H:%M} UTC",
        f"Python {platform.python_version()}, {platform.platform()}",
        ", ".join(f"{name} {_version(name)}" for name in _PACKAGES),
        f"command: eitskin {shlex.join(sys.argv[1:])}",
        "",
        *"".join(traceback.format_exception(error)).splitlines(),
    ]
    return "\n".join(printable(line[:_LONGEST_LINE]) for line in lines) + "\n"


def _written(text: str) -> str:
    """Name of a new file in the system's folder for temporary files, with this text."""
    handle, name = tempfile.mkstemp(prefix="eitskin-report-", suffix=".txt")
    with os.fdopen(handle, "w", encoding="utf-8", errors="backslashreplace") as file:
        file.write(text)
    return name


def _place(error: Exception) -> str:
    """Function and line of eitskin that raised the exception."""
    frames = traceback.extract_tb(error.__traceback__)
    last = frames[-1]
    return f"{last.name}, line {last.lineno}"


def _version(package: str) -> str:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "not installed"
