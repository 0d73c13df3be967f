"""Store of bounds: each finished layout is a small file, written atomically.

A file is named by a hash of what was asked, holds that too, and is taken only for the same: a run
that was stopped goes on, and a layout that has changed is judged anew.
"""

import hashlib
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import asdict, dataclass, fields
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

import msgspec
import numpy as np

from eitskin.benchmarks.layouts.bound import FORCE, Sampling, SheetBound, sheet_bound
from eitskin.benchmarks.layouts.candidates import Layout
from eitskin.datasets.store.folder import make_folder
from eitskin.errors import PartialError
from eitskin.files import remove_leftovers, write_file

_VERSION = 1  # of what a file means; raised when the calculation changes

Question: TypeAlias = tuple[Layout, Sampling]
Judge = Callable[[Sequence[Question]], list[SheetBound]]
Watch = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class StoredBound:
    """Finished layout in a file.

    Attributes:
        asked: version, design, angle, force and sampling.
        found: fields of its `SheetBound`.
    """

    asked: dict[str, Any]
    found: dict[str, Any]


@contextmanager
def judging(folder: Path, workers: int = 1, watch: Watch = lambda _: None) -> Iterator[Judge]:
    """Context of a function that judges layouts in order, from files in `folder` where possible.

    Args:
        folder: for the files; made where it is missing.
        workers: processes that judge; with one, this one does.
        watch: called with the name of each layout that is finished.

    Raises PartialError where a file cannot be written or a process died; run again to go on.
    """
    make_folder(folder)
    remove_leftovers(folder)
    with working(workers) as pool:
        yield partial(_answers, folder, watch, pool)


@contextmanager
def working(workers: int) -> Iterator[ProcessPoolExecutor | None]:
    """Context of a process pool; None for one worker, which is this process.

    They end at once when the block raises, so what they write must be whole or absent.

    Raises PartialError where one died; run again to go on.
    """
    if workers == 1:
        yield None
        return
    context, others = multiprocessing.get_context("spawn"), set(multiprocessing.active_children())
    with ProcessPoolExecutor(workers, context, initializer=_start_worker) as pool:
        try:
            yield pool
        except BrokenProcessPool as error:
            raise PartialError(
                "a process that worked on layouts died; what was finished is kept, run again to go "
                "on"
            ) from error
        except BaseException:
            for process in set(multiprocessing.active_children()) - others:
                process.terminate()
            raise


def _answers(
    folder: Path, watch: Watch, pool: ProcessPoolExecutor | None, questions: Sequence[Question]
) -> list[SheetBound]:
    """Bounds of all questions; questions that differ only in the layout's name share one."""
    by_path = {_path(folder, question): question for question in questions}
    missing = []
    for path, question in by_path.items():
        if _read(path, question) is None:
            missing.append((path, question))
        else:
            watch(question[0].name)
    if pool is None:
        for path, question in missing:
            _write(path, question)
            watch(question[0].name)
    else:
        futures = {pool.submit(_write, *each): each[1][0].name for each in missing}
        for future in as_completed(futures):
            future.result()
            watch(futures[future])
    found = [_read(_path(folder, question), question) for question in questions]
    return [bound for bound in found if bound is not None]


def _asked(question: Question) -> dict[str, Any]:
    layout, sampling = question
    return {
        "version": _VERSION,
        "design": layout.design.to_toml(),
        "angle_deg": layout.angle_deg,
        "force": FORCE,
        **asdict(sampling),
    }


def _path(folder: Path, question: Question) -> Path:
    content = msgspec.json.encode(_asked(question), order="sorted")
    return folder / f"{hashlib.sha256(content).hexdigest()[:20]}.json"


def _read(path: Path, question: Question) -> SheetBound | None:
    """Bound stored in a file; None where it is missing or belongs to another question."""
    try:
        part = msgspec.json.decode(path.read_bytes(), type=StoredBound)
    except (OSError, msgspec.MsgspecError):
        return None
    if part.asked != _asked(question) or set(part.found) != {f.name for f in fields(SheetBound)}:
        return None
    arrays: dict[str, Any] = {
        name: np.array(value) if isinstance(value, list) else value
        for name, value in part.found.items()
    }
    return SheetBound(**arrays)


def _write(path: Path, question: Question) -> None:
    bound = sheet_bound(*question)
    values = {each.name: getattr(bound, each.name) for each in fields(bound)}
    found = {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in values.items()}
    write_file(path, msgspec.json.encode(StoredBound(_asked(question), found)) + b"\n")


def _start_worker() -> None:
    """Leave Ctrl-C to the parent; end when it has gone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
