"""Atomic files and folders: complete under their name, or absent, whatever happens.

`atomic_file` and `atomic_folder` are for any output; `write_file`, `remove_file` and
`remove_leftovers` are for work of many files that can be stopped and resumed.
"""

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from eitskin.errors import ConfigurationError, EitskinError, PartialError

TEMPORARY = ".writing-"
_REMEDY = "name a file in a folder that exists and can be written to"
_RESUME = (
    "files finished before it are intact; make room or give write permission, then start again "
    "(`eitskin generate` with --resume), or choose another folder"
)


@contextmanager
def atomic_file(
    path: str | Path,
    failure: type[EitskinError] = ConfigurationError,
    remedy: str = _REMEDY,
    mode: int = 0o644,
) -> Iterator[Path]:
    """Context manager of a temporary file beside `path`, which is renamed to `path` at the end.

    Where the block raises, or the machine fails, an older file at `path` is left as it was. The
    temporary file has the suffix of `path`, from which writers of pictures tell the format.

    Args:
        path: of the file.
        failure: class of the error that is raised where the file cannot be written.
        remedy: end of that error's message.
        mode: permissions of the file; until the end only its owner can read it.
    """
    path = Path(path)
    try:
        handle, name = tempfile.mkstemp(prefix=TEMPORARY, suffix=path.suffix, dir=path.parent)
        os.close(handle)
        temporary = Path(name)
        try:
            yield temporary
            sync(temporary)
            temporary.chmod(mode)  # mkstemp's 0600 would keep others from reading the file
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
    """Context manager of a temporary folder beside `path`, which is renamed to `path` at the end.

    Arguments and guarantees are those of `atomic_file`. A folder that stood at `path` is replaced;
    missing parent folders are made.
    """
    path = Path(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = Path(tempfile.mkdtemp(prefix=f".{path.name}.", dir=path.parent))
        try:
            yield temporary
            for file in temporary.rglob("*"):
                sync(file)
            temporary.chmod(0o755)  # mkdtemp's 0700 would keep others out
            _put_in_place(temporary, path)
        finally:
            shutil.rmtree(temporary, ignore_errors=True)
    except OSError as error:
        raise failure(f"cannot write {path}: {error.strerror or error}; {remedy}") from error


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
