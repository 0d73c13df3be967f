"""The files of a dataset: whole or absent, whatever happens while they are written."""

from pathlib import Path

from eitskin.errors import PartialError
from eitskin.files import TEMPORARY, atomic_file

_REMEDY = (
    "files finished before it are intact; make room or give write permission, then continue with "
    "--resume, or choose another folder"
)


def write_file(path: Path, content: bytes) -> None:
    """Write `content` to `path` so that a crash leaves the old file, or none, or the new one.

    Raises PartialError, and leaves nothing of the new file, where it cannot be written.
    """
    with atomic_file(path, PartialError, _REMEDY) as temporary:
        temporary.write_bytes(content)


def remove_file(path: Path) -> None:
    """Remove a file, where there is one; raises PartialError where that cannot be done."""
    try:
        path.unlink(missing_ok=True)
    except OSError as error:
        raise PartialError(f"cannot remove {path}: {error.strerror}; {_REMEDY}") from error


def remove_leftovers(folder: Path) -> None:
    """Remove what writers that were killed left half-written in `folder`."""
    for leftover in folder.glob(TEMPORARY + "*"):
        remove_file(leftover)
