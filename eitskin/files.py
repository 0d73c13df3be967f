"""Files and folders: written whole under their name or not at all, and read with care.

`atomic_file` and `atomic_folder` are for any output; `write_file`, `remove_file` and
`remove_leftovers` are for work of many files that can be stopped and resumed.

Files that others may have made are read where they are regular ones of bounded size: a pipe or a
device could keep a reader waiting for ever, and a sparse file could fill the memory.
"""

import os
import shutil
import stat
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from secrets import token_hex
from typing import Any, Final

import msgspec

from eitskin.errors import ConfigurationError, EitskinError, PartialError, cut

TEMPORARY = ".writing-"
_REMEDY = "name a file in a folder that exists and can be written to"
_RESUME = (
    "files finished before it are intact; make room or give write permission, then start again "
    "(`eitskin generate` with --resume), or choose another folder"
)

MAX_TEXT: Final = 64 << 20
"""Largest size of a text file [bytes]: a recipe with a protocol of 16,384 channels has 0.5 MB."""

_LARGE: Final = 1 << 24  # bytes, from which a file is looked through for holes
_MAX_QUOTE: Final = 100  # characters
_BINARY: Final = getattr(os, "O_BINARY", 0)  # Windows changes ends of lines otherwise


@contextmanager
def atomic_file(
    path: str | Path,
    failure: type[EitskinError] = ConfigurationError,
    remedy: str = _REMEDY,
    mode: int = 0o666,
) -> Iterator[Path]:
    """Context manager of a temporary file next to `path`, which is renamed to `path` at the end.

    Where the block raises, or the machine fails, an older file at `path` is left as it was. The
    temporary file has the suffix of `path`, from which writers of pictures show the format, and the
    permissions `mode`, less those that the umask withholds. Where the file cannot be written, or
    `path` is a pipe or device, `failure` is raised with `remedy` at the end of its message.
    """
    path = _require_name(path, failure, remedy)
    try:
        if path.exists() and not (path.is_file() or path.is_dir()):
            raise OSError("it is a pipe or a device, which a file would replace")
        temporary = path.with_name(f"{TEMPORARY}{token_hex(8)}{path.suffix}")
        os.close(os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_WRONLY, mode))
        try:
            yield temporary
            sync(temporary)
            temporary.replace(path)
        finally:
            temporary.unlink(missing_ok=True)
        sync(path.parent)
    except OSError as error:
        raise failure(f"cannot write {path}: {error.strerror or error}; {remedy}") from error


@contextmanager
def atomic_folder(
    path: str | Path, failure: type[EitskinError] = ConfigurationError, remedy: str = _REMEDY
) -> Iterator[Path]:
    """Context manager of a temporary folder next to `path`, which is renamed to `path` at the end.

    As `atomic_file`. A folder that stood at `path` is replaced; missing parent folders are made.
    """
    path = _require_name(path, failure, remedy)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = path.with_name(f".{path.name}.{token_hex(8)}")
        temporary.mkdir()
        try:
            yield temporary
            for file in temporary.rglob("*"):
                sync(file)
            _put_in_place(temporary, path)
        finally:
            shutil.rmtree(temporary, ignore_errors=True)
    except OSError as error:
        raise failure(f"cannot write {path}: {error.strerror or error}; {remedy}") from error


@contextmanager
def new_contents(folder: Path) -> Iterator[None]:
    """Context manager of writing into a folder that is made if missing; what is new goes on errors.

    Where the block raises, files that were not in the folder before are removed.
    """
    before = {*folder.iterdir()} if folder.exists() else None
    folder.mkdir(parents=True, exist_ok=True)
    try:
        yield
    except BaseException:
        for path in {*folder.iterdir()} - (before or set()):
            with suppress(OSError):
                path.unlink()
        if before is None:
            with suppress(OSError):
                folder.rmdir()
        raise


def write_file(path: Path, content: bytes) -> None:
    """Write one file of resumable work, atomically.

    Raises PartialError, and leaves nothing of the new file, where it cannot be written.
    """
    with atomic_file(path, PartialError, _RESUME) as temporary:
        temporary.write_bytes(content)


def remove_file(path: Path) -> None:
    """Remove one file of resumable work, if it exists; raises PartialError where that fails."""
    try:
        path.unlink(missing_ok=True)
    except OSError as error:
        raise PartialError(f"cannot remove {path}: {error.strerror}; {_RESUME}") from error


def remove_leftovers(folder: Path) -> None:
    """Remove temporary files that killed writers left in `folder`."""
    for leftover in folder.glob(TEMPORARY + "*"):
        remove_file(leftover)


def _require_name(path: str | Path, failure: type[EitskinError], remedy: str) -> Path:
    """Path of something new; "", "." and "/" name folders that stand already."""
    if not (made := Path(path)).name:
        raise failure(f"cannot write {made}: expected a new name; {remedy}")
    return made


def _put_in_place(temporary: Path, path: Path) -> None:
    """Rename the folder `temporary` to `path`; an older folder at `path` is moved away first."""
    with tempfile.TemporaryDirectory(
        prefix=f".{path.name}.old.", dir=path.parent, ignore_cleanup_errors=True
    ) as aside:
        old = Path(aside) / path.name
        if path.exists():
            path.rename(old)
        try:
            temporary.rename(path)
        except BaseException:  # not even Ctrl-C may let the old folder be removed
            if old.exists() and not path.exists():
                old.rename(path)
            raise
        sync(path.parent)


def sync(path: Path) -> None:
    """Flush a file, or the names in a folder, to the disk (fsync).

    Without the flush a power cut can leave an empty file, or undo the rename of a synced one.
    """
    if os.name == "nt" and path.is_dir():  # Windows has no such call for folders
        return
    handle = os.open(path, os.O_RDONLY if path.is_dir() else os.O_RDWR)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def read_bytes(
    path: str | Path, max_bytes: int = MAX_TEXT, failure: type[EitskinError] = ConfigurationError
) -> bytes:
    """Content of a regular file of at most `max_bytes` bytes.

    Raises `failure` where the file is missing, unreadable, a folder, pipe or device, or larger.
    """
    try:
        # Opening a pipe without a writer would wait for one.
        handle = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | _BINARY)
    except OSError as error:
        raise failure(f"cannot read {path}: {error.strerror or error}") from error
    except ValueError as error:  # a NUL in the name
        raise failure(f"cannot read {path}: {error}; give the name of a file") from error
    try:
        size = _regular_size(handle, path, max_bytes, failure)
        with open(handle, "rb", closefd=False) as file:
            content = file.read(size + 1)
            if len(content) > size:  # a file that grows meanwhile
                content += file.read(max_bytes - len(content) + 1)
    except OSError as error:
        if isinstance(error, failure):
            raise
        raise failure(f"cannot read {path}: {error.strerror or error}") from error
    finally:
        os.close(handle)
    if len(content) > max_bytes:
        raise failure(f"{path} is larger than {max_bytes} bytes; is this the file that was meant?")
    return content


def require_regular(
    path: str | Path, max_bytes: int, failure: type[EitskinError] = ConfigurationError
) -> None:
    """Raise `failure` as `read_bytes` does, without reading; a missing file is left to others."""
    try:
        handle = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | _BINARY)
    except (OSError, ValueError):
        return
    try:
        _regular_size(handle, path, max_bytes, failure)
    finally:
        os.close(handle)


def _regular_size(handle: int, path: str | Path, most: int, failure: type[EitskinError]) -> int:
    """Size of a file [bytes]; raises `failure` unless it is regular and has at most `most`.

    So it does for a large file that is nearly all holes, whatever its size claims.
    """
    status = os.fstat(handle)
    if not stat.S_ISREG(status.st_mode):
        kind = "folder" if stat.S_ISDIR(status.st_mode) else "pipe or device"
        raise failure(f"cannot read {path}: expected a file, got a {kind}")
    if status.st_size > most:
        raise failure(
            f"cannot read {path}: expected at most {most} bytes, got {status.st_size}; is this the "
            "file that was meant?"
        )
    if status.st_size > _LARGE and _allocated_bytes(handle, status.st_size) < status.st_size // 100:
        raise failure(f"cannot read {path}: most of its {status.st_size} bytes are missing")
    return status.st_size


def _allocated_bytes(handle: int, size: int) -> int:
    """Bytes of a file that are no holes, as far as the system shows."""
    if not hasattr(os, "SEEK_DATA"):
        return size
    stored = end = 0
    with suppress(OSError):  # no data after the last
        while end < size:
            start = os.lseek(handle, end, os.SEEK_DATA)
            end = os.lseek(handle, start, os.SEEK_HOLE)
            stored += end - start
    os.lseek(handle, 0, os.SEEK_SET)
    return stored


def read_text(
    path: str | Path, max_bytes: int = MAX_TEXT, failure: type[EitskinError] = ConfigurationError
) -> str:
    """Text of a file in UTF-8, or UTF-16 that says so; arguments and errors as for `read_bytes`."""
    content = read_bytes(path, max_bytes, failure)
    try:
        wide = content[:2] in (b"\xff\xfe", b"\xfe\xff")
        return content.decode("utf-16" if wide else "utf-8-sig")
    except UnicodeDecodeError as error:
        raise failure(f"cannot read {path}: it is no text in UTF-8: {error}") from error


def parse_json(content: bytes | str, target: Any = Any) -> Any:
    """Data of a JSON text, of the type `target`; raises ValueError for anything that is not JSON.

    Numbers beyond the range of their type and nesting beyond that of Python's calls are refused.
    """
    try:
        return msgspec.json.decode(content, type=target)
    except (ValueError, RecursionError) as error:  # a byte that is no UTF-8 is no MsgspecError
        raise ValueError(f"not valid JSON: {error}") from error


def quote_value(value: object) -> str:
    """`repr` of a value from a file for a message, cut after a hundred characters."""
    return shorten_text(repr(value))


def shorten_text(text: str) -> str:
    """Text for a message, cut after a hundred characters."""
    return text if len(text) <= _MAX_QUOTE else f"{text[:_MAX_QUOTE]} ..."


def printable(message: object) -> str:
    """Text of an error for a terminal: cut where it is long, control characters made visible."""
    return visible(cut(str(message)))


def visible(text: str) -> str:
    """Text for a terminal, with control characters but for ends of lines made visible.

    A name in a file may hold sequences that colour, clear or rename the terminal.
    """
    return "".join(c if c.isprintable() or c == "\n" else repr(c)[1:-1] for c in text)
