"""Files of solutions that are kept between runs: folder, names, reading and writing."""

import hashlib
import json
import os
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from eitskin.errors import ConfigurationError
from eitskin.files import atomic_file

Solution = TypeVar("Solution")


def folder() -> Path:
    """Folder of the files: $EITSKIN_CACHE, or the user's folder for caches."""
    given = os.environ.get("EITSKIN_CACHE")
    if given:
        return Path(given)
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA", Path.home())) / "eitskin"
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches" / "eitskin"
    return Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "eitskin"


def file_name(kind: str, described: Mapping[str, object]) -> str:
    """Name of the file of a solution: its kind, and a hash of everything that it depends on.

    Numbers count to nine digits.
    """
    text = json.dumps(described, default=float, sort_keys=True)
    rounded = json.dumps(json.loads(text, parse_float=lambda s: f"{float(s):.9g}"))
    return f"{kind}-{hashlib.sha256(rounded.encode()).hexdigest()[:32]}.npz"


def kept(
    path: Path,
    read_file: Callable[[], Solution | None],
    solve: Callable[[], Solution],
    write_file: Callable[[Solution], None],
) -> Solution:
    """Solution from the file at `path`, or solved now and written there.

    Processes that need the same solution wait for the one that solves it. Where the folder cannot
    be written, or the system has no locks of files (Windows), each solves for itself.
    """
    found = read_file()
    if found is None:
        with _locked(path):
            found = read_file()  # another process may have solved it meanwhile
            if found is None:
                found = solve()
                write_file(found)
    return found


@contextmanager
def _locked(path: Path) -> Iterator[None]:
    """Context for one process at a time; a process that is killed lets the next one in."""
    try:
        import fcntl

        path.parent.mkdir(parents=True, exist_ok=True)
        lock = _lock_file(path.with_suffix(".lock"), fcntl.flock, fcntl.LOCK_EX)
    except (ImportError, OSError):
        yield
        return
    with lock:
        try:
            yield
        finally:
            Path(lock.name).unlink(missing_ok=True)


def _lock_file(path: Path, flock: Callable[[int, int], None], exclusive: int) -> IO[str]:
    """Open file with a lock, which is still the file of this name."""
    while True:
        lock = path.open("w")
        flock(lock.fileno(), exclusive)
        # Whoever had the lock before has removed the file, which others may have made anew.
        with suppress(FileNotFoundError):
            if os.path.samestat(path.stat(), os.fstat(lock.fileno())):
                return lock
        lock.close()


def read(path: Path) -> dict[str, NDArray[Any]] | None:
    """Arrays of a file by name; None where the file is absent or damaged."""
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
            return {name: file[name] for name in file.files}
    except Exception:  # damage raises errors of many classes, of which numpy lists none
        return None


def write(path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write arrays if the disk can be written; otherwise they are solved again next time."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_file(path) as temporary:
            np.savez_compressed(temporary, allow_pickle=False, **arrays)
    except (OSError, ConfigurationError):
        return
