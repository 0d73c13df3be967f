"""Store of solutions that take long: shipped with the package, in the user's cache, or solved now.

A `Problem` names everything that its solution depends on. The file of the solution is named by a
hash of that description; it holds arrays by name.
"""

import hashlib
import io
import json
import multiprocessing
import os
import signal
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import repeat
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from eitskin.errors import ConfigurationError, PartialError
from eitskin.files import atomic_file, read_bytes
from eitskin.threads import one_thread_per_process

Arrays = dict[str, NDArray[Any]]
Made = TypeVar("Made")
Report = Callable[[int, int], None]
"""Function that is called with the number of parts done and of all parts."""

# Solutions that come with the package.
LIBRARY = Path(__file__).with_name("library")
# Version of the format of files and of all solutions.
_VERSION = 1
_MAX_LOADED = 128  # solutions in memory, of 0.2 to 6 MB each
_MAX_BYTES = 1 << 30  # of a file; the largest has 3 MB


@dataclass(frozen=True, eq=False)
class Problem:
    """Something that is solved once.

    Attributes:
        kind: first part of the file's name.
        description: everything that the solution depends on, as numbers, texts, lists and mappings.
        solve: gives the arrays of the solution; reports the parts done.
        divided: whether `solve` uses several processes itself.
    """

    kind: str
    description: Mapping[str, object]
    solve: Callable[[Report], Arrays]
    divided: bool = False

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Problem) and self.name == other.name

    def __hash__(self) -> int:
        return hash(self.name)

    @cached_property
    def name(self) -> str:
        """Name of the file: the kind, and a hash of the description to nine digits."""
        described = json.dumps(
            _round_numbers({"format": _VERSION, **self.description}), sort_keys=True
        )
        return f"{self.kind}-{hashlib.sha256(described.encode()).hexdigest()[:32]}.npz"

    @property
    def path(self) -> Path:
        """File in the user's cache."""
        return cache_folder() / self.name

    @property
    def is_shipped(self) -> bool:
        """Whether the solution comes with the package."""
        return (LIBRARY / self.name).is_file()


def _round_numbers(value: object) -> object:
    """Description whose real numbers are texts of nine digits."""
    if type(value) is float:
        return f"{value:.9g}"
    if isinstance(value, list | tuple):
        # Most are of numbers, for which a call each would take longest.
        return [f"{x:.9g}" if type(x) is float else _round_numbers(x) for x in value]
    if isinstance(value, dict):
        return {key: _round_numbers(each) for key, each in value.items()}
    return value if value is None or isinstance(value, int | str) else f"{value:.9g}"


def cache_folder() -> Path:
    """Folder of the user's solutions: $EITSKIN_CACHE, or the system's folder for caches."""
    from platformdirs import user_cache_path

    folder = os.environ.get("EITSKIN_CACHE")
    return Path(folder) if folder else user_cache_path("eitskin", appauthor=False)


def missing(problems: Iterable[Problem]) -> dict[Path, Problem]:
    """Problems that are neither shipped nor in the cache, by their files there."""
    return {
        problem.path: problem
        for problem in dict.fromkeys(problems)
        if not (problem.is_shipped or problem.path.is_file())
    }


def load_or_solve(
    problem: Problem, make: Callable[[Arrays], Made], report: Report = lambda *_: None
) -> Made:
    """Solution from package or cache, or solved now and written to the cache.

    Processes that need the same solution wait for the one that solves it. Where the cache cannot
    be written, each solves for itself.

    Args:
        problem: problem to be solved.
        make: make of the arrays what is returned, and kept in memory while the file stays as it is.
        report: called with the number of parts done and of all parts.
    """

    def load() -> Made | None:
        solution = _load(LIBRARY / problem.name, make)
        return _load(problem.path, make) if solution is None else solution

    stored_solution = load()
    if stored_solution is None:
        with _lock_file(problem.path):
            stored_solution = load()  # another process may have solved it meanwhile
            if stored_solution is None:
                solution = problem.solve(report)
                write(problem.path, solution)
                stored_solution = make(solution)
    return stored_solution


def prepare(problems: Iterable[Problem], report: Report | None = None, workers: int = 1) -> None:
    """Solve and store what is missing, in a number of processes.

    Args:
        problems: each is solved once.
        report: called with the number of parts done and of all parts.
        workers: processes, each with a problem.
    """
    absent = list(missing(problems).values())
    report, workers = report or (lambda *_: None), max(min(workers, len(absent)), 1)

    def in_series(number: int) -> Report:
        return lambda done, total: report(number * total + done, len(absent) * total)

    if workers == 1 or any(problem.divided for problem in absent):
        for number, problem in enumerate(absent):
            load_or_solve(problem, dict, in_series(number))
        return
    with processes(workers) as run:
        for number, _ in enumerate(run(load_or_solve, absent, repeat(dict)), 1):
            report(number, len(absent))


@contextmanager
def processes(workers: int) -> Iterator[Callable[..., Iterable[Any]]]:
    """Map over arguments in this process, or in several; raises PartialError where one dies."""
    if workers == 1:
        yield map
        return
    context = multiprocessing.get_context("spawn")
    try:
        with (
            one_thread_per_process(),
            ProcessPoolExecutor(workers, context, _end_at_interrupt) as pool,
        ):
            yield pool.map
    except BrokenProcessPool as error:
        raise PartialError(
            "a process died while tables were solved. Look for lack of memory, or, in a script, "
            "for a missing if __name__ == '__main__'; then run it again"
        ) from error


def _end_at_interrupt() -> None:
    """Let Ctrl-C end this process at once, which would go on with the next problem otherwise."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


@contextmanager
def _lock_file(path: Path) -> Iterator[None]:
    """Context for one process at a time; a process that is killed lets the next one in."""
    from filelock import FileLock

    lock = FileLock(path.with_suffix(".lock"))
    with suppress(OSError, NotImplementedError):
        path.parent.mkdir(parents=True, exist_ok=True)
        lock.acquire()
    try:
        yield
    finally:
        # Whoever waits for this file, or makes it again, looks for the solution first.
        with suppress(OSError):
            path.with_suffix(".lock").unlink()
        lock.release()


def _load(path: Path, make: Callable[[Arrays], Made]) -> Made | None:
    """Object made of a file, again where it has changed; None where absent or damaged."""
    try:
        return _make_from_file(path, path.stat().st_mtime_ns, make)
    except OSError:
        return None


# Specimens of one design share solutions.
@lru_cache(maxsize=_MAX_LOADED)
def _make_from_file(path: Path, changed: int, make: Callable[[Arrays], Made]) -> Made | None:  # noqa: ARG001
    arrays = _read(path)
    return None if arrays is None else make(arrays)


def _read(path: Path) -> Arrays | None:
    try:
        content = io.BytesIO(read_bytes(path, _MAX_BYTES))  # which waits for no pipe
        with np.load(content, allow_pickle=False) as file:
            return {name: _join_planes(file[name]) for name in file.files}
    except Exception:  # damage raises errors of many classes, of which numpy lists none
        return None


def write(path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write arrays if the disk can be written; otherwise they are solved again next time."""
    with suppress(OSError, ConfigurationError):
        path.parent.mkdir(parents=True, exist_ok=True)
        planes = {name: _split(array) for name, array in arrays.items()}
        with atomic_file(path) as temporary:
            np.savez_compressed(temporary, allow_pickle=False, **planes)


def _split(array: NDArray[Any]) -> NDArray[Any]:
    """Planes of the first bytes of all numbers, of the second and so on: these compress better."""
    if array.dtype.kind != "f":
        return array
    numbers = array[..., None].copy().view(np.uint8)
    return np.ascontiguousarray(np.moveaxis(numbers, -1, 0))


def _join_planes(planes: NDArray[Any]) -> NDArray[Any]:
    """Array of single or double precision whose bytes are `planes`; others as they are."""
    if planes.dtype != np.uint8:
        return planes
    numbers = np.moveaxis(planes, 0, -1).copy()
    return np.asarray(numbers.view(f"<f{len(planes)}")[..., 0])
