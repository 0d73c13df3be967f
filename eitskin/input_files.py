"""Reading of files that others may have made: regular files of bounded size, text, JSON.

A pipe or a device could keep a reader waiting for ever, and a sparse file of some bytes on the
disk could fill the memory, so neither is read.
"""

import os
import stat
from pathlib import Path
from typing import Any, Final

import msgspec

from eitskin.errors import ConfigurationError, EitskinError, cut

MOST_TEXT: Final = 64 << 20
"""Largest size of a text file [bytes]: a recipe with a protocol of 16,384 channels has 0.5 MB."""

_LONGEST_QUOTE: Final = 100  # characters
_BINARY: Final = getattr(os, "O_BINARY", 0)  # Windows changes ends of lines otherwise


def read_bytes(
    path: str | Path, most: int = MOST_TEXT, failure: type[EitskinError] = ConfigurationError
) -> bytes:
    """Content of a regular file of at most `most` bytes.

    Raises `failure` where the file is missing, may not be read, is a folder, pipe or device, or is
    larger.
    """
    try:
        # Opening a pipe without a writer would wait for one.
        handle = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | _BINARY)
    except OSError as error:
        raise failure(f"cannot read {path}: {error.strerror or error}") from error
    except ValueError as error:  # a NUL in the name
        raise failure(f"cannot read {path}: {error}; give the name of a file") from error
    try:
        size = _regular_size(os.fstat(handle), path, most, failure)
        with open(handle, "rb", closefd=False) as file:
            content = file.read(size + 1)
            if len(content) > size:  # a file that grows meanwhile
                content += file.read(most - len(content) + 1)
    except OSError as error:
        if isinstance(error, failure):
            raise
        raise failure(f"cannot read {path}: {error.strerror or error}") from error
    finally:
        os.close(handle)
    if len(content) > most:
        raise failure(f"{path} is larger than {most} bytes; is this the file that was meant?")
    return content


def require_regular(
    path: str | Path, most: int, failure: type[EitskinError] = ConfigurationError
) -> None:
    """Raise `failure` as `read_bytes` does, without reading; a missing file is left to others."""
    try:
        status = Path(path).stat()
    except (OSError, ValueError):
        return
    _regular_size(status, path, most, failure)


def _regular_size(
    status: os.stat_result, path: str | Path, most: int, failure: type[EitskinError]
) -> int:
    """Size of a file [bytes]; raises `failure` unless it is regular and has at most `most`."""
    if not stat.S_ISREG(status.st_mode):
        kind = "folder" if stat.S_ISDIR(status.st_mode) else "pipe or device"
        raise failure(f"cannot read {path}: expected a file, got a {kind}")
    if status.st_size > most:
        raise failure(
            f"cannot read {path}: expected at most {most} bytes, got {status.st_size}; is this the "
            "file that was meant?"
        )
    return status.st_size


def read_text(
    path: str | Path, most: int = MOST_TEXT, failure: type[EitskinError] = ConfigurationError
) -> str:
    """Text of a file in UTF-8; arguments and errors as for `read_bytes`."""
    try:
        return read_bytes(path, most, failure).decode()
    except UnicodeDecodeError as error:
        raise failure(f"cannot read {path}: it is no text in UTF-8: {error}") from error


def parse_json(content: bytes | str, kind: Any = Any) -> Any:
    """Data of a JSON text, of the type `kind`; raises ValueError for anything that is not JSON.

    Numbers beyond the range of their type and nesting beyond that of Python's calls are refused.
    """
    try:
        return msgspec.json.decode(content, type=kind)
    except (ValueError, RecursionError) as error:  # a byte that is no UTF-8 is no MsgspecError
        raise ValueError(f"not valid JSON: {error}") from error


def quoted(value: object) -> str:
    """`repr` of a value from a file for a message, cut after a hundred characters."""
    return shortened(repr(value))


def shortened(text: str) -> str:
    """Text for a message, cut after a hundred characters."""
    return text if len(text) <= _LONGEST_QUOTE else f"{text[:_LONGEST_QUOTE]} ..."


def printable(message: object) -> str:
    """Text of an error for a terminal: cut where it is long, control characters made visible."""
    return visible(cut(str(message)))


def visible(text: str) -> str:
    """Text for a terminal, with control characters but for ends of lines made visible.

    A name in a file may hold sequences that colour, clear or rename the terminal.
    """
    return "".join(c if c.isprintable() or c == "\n" else repr(c)[1:-1] for c in text)
