"""Files and folders that appear whole under their name or not at all, whatever happens."""

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from eitskin.errors import ConfigurationError, EitskinError

TEMPORARY = ".writing-"
_REMEDY = "name a file in a folder that exists and can be written to"


@contextmanager
def atomic_file(
    path: str | Path, failure: type[EitskinError] = ConfigurationError, remedy: str = _REMEDY
) -> Iterator[Path]:
    """Give a temporary file beside `path` to write to; it takes the name when the block ends.

    Where the block raises, or the machine fails, what stood at `path` before is left as it was.
    The temporary file has the ending of `path`, from which writers of pictures tell the format.

    Args:
        path: of the file.
        failure: the error to raise where it cannot be written.
        remedy: what to do then, the end of that error's message.
    """
    path = Path(path)
    try:
        handle, name = tempfile.mkstemp(prefix=TEMPORARY, suffix=path.suffix, dir=path.parent)
        os.close(handle)
        temporary = Path(name)
        try:
            yield temporary
            _sync(temporary)
            temporary.chmod(0o644)  # mkstemp's 0600 would keep others from reading the file
            temporary.replace(path)
        finally:
            temporary.unlink(missing_ok=True)
        _sync(path.parent)
    except OSError as error:
        raise failure(f"cannot write {path}: {error.strerror or error}; {remedy}") from error


@contextmanager
def atomic_folder(
    path: str | Path, failure: type[EitskinError] = ConfigurationError, remedy: str = _REMEDY
) -> Iterator[Path]:
    """Give a temporary folder beside `path` to fill; it takes the name when the block ends.

    Arguments and guarantees are those of `atomic_file`. A folder that stood at `path` is replaced;
    missing parent folders are made.
    """
    path = Path(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = Path(tempfile.mkdtemp(prefix=f".{path.name}.", dir=path.parent))
        try:
            yield temporary
            for file in temporary.iterdir():
                _sync(file)
            temporary.chmod(0o755)  # mkdtemp's 0700 would keep others out
            _put_in_place(temporary, path)
        finally:
            shutil.rmtree(temporary, ignore_errors=True)
    except OSError as error:
        raise failure(f"cannot write {path}: {error.strerror or error}; {remedy}") from error


def _put_in_place(temporary: Path, path: Path) -> None:
    """Rename the folder `temporary` to `path`; one that lies there steps aside first."""
    with tempfile.TemporaryDirectory(
        prefix=f".{path.name}.old.", dir=path.parent, ignore_cleanup_errors=True
    ) as aside:
        old = Path(aside) / path.name
        if path.exists():
            path.rename(old)
        try:
            temporary.rename(path)
        except BaseException:  # Ctrl-C too must not let the old one be removed with its place
            if old.exists() and not path.exists():
                old.rename(path)
            raise
        _sync(path.parent)


def _sync(path: Path) -> None:
    """Bring a file, or the names in a folder, to the disk.

    Without it a power cut can leave an empty file, or undo the rename of a synced one.
    """
    if os.name == "nt" and path.is_dir():  # Windows has no such call for folders
        return
    handle = os.open(path, os.O_RDONLY if path.is_dir() else os.O_RDWR)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
