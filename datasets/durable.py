"""Files that are whole or absent, whatever happens while they are written."""

import os
import tempfile
from pathlib import Path

from eitskin.geometry import PartialError

TEMPORARY = ".writing-"


def write_file(path: Path, content: bytes) -> None:
    """Write `content` to `path` so that a crash leaves the old file, or none, or the new one.

    Raises PartialError, and leaves nothing of the new file, where it cannot be written.
    """
    try:
        _write_and_rename(path, content)
    except OSError as error:
        raise PartialError(
            f"could not write {path} ({len(content)} bytes): {error.strerror or error}. Files "
            "finished before it are intact; make room or give write permission, then continue "
            "with --resume, or choose another folder"
        ) from error


def remove_leftovers(folder: Path) -> None:
    """Remove what writers that were killed left half-written in `folder`."""
    for leftover in folder.glob(TEMPORARY + "*"):
        leftover.unlink(missing_ok=True)


def _write_and_rename(path: Path, content: bytes) -> None:
    handle, name = tempfile.mkstemp(prefix=TEMPORARY, dir=path.parent)
    temporary = Path(name)
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        temporary.chmod(0o644)  # mkstemp's 0600 would keep colleagues out of a shared dataset
        temporary.replace(path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    _sync_folder(path.parent)


def _sync_folder(folder: Path) -> None:
    """Make a rename last; without it a power cut can undo the rename of a synced file."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
