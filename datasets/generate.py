"""Making a dataset from a recipe, on all cores, so that it can be interrupted and resumed."""

import ctypes
import hashlib
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from pathlib import Path

from eitskin.datasets.durable import remove_leftovers, write_file
from eitskin.datasets.folder import MANIFEST, Manifest, new_folder, shard_entry, write_manifest
from eitskin.datasets.recipe import Recipe
from eitskin.datasets.shard import read_shard, shard_name, write_shard
from eitskin.datasets.simulated import prepare, simulate_shard
from eitskin.geometry import ConfigurationError, DataError, PartialError

RECIPE = "recipe.toml"
_THREAD_LIMITS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")

Progress = Callable[[int, int], None]


def generate(
    recipe: Recipe,
    out: str | Path,
    workers: int = 2,
    progress: Progress | None = None,
    resume: bool = False,
) -> Manifest:
    """Make the dataset of `recipe` in the folder `out`.

    The bytes depend on the recipe alone, not on `workers` or on interruptions. Scripts that call
    this need the usual `if __name__ == "__main__":`, because workers are started afresh.

    Args:
        recipe: what to make.
        out: folder; new or empty, unless `resume`.
        workers: processes that simulate.
        progress: called with the number of finished frames and of all frames.
        resume: keep the finished shards that lie in `out` and make the others.

    Returns:
        The manifest that was written.

    Raises:
        ConfigurationError: where `out` holds something else, or forces are beyond reach.
        PartialError: where files cannot be written or workers died; resume when that is mended.
    """
    if workers < 1:
        raise ConfigurationError(f"workers must be at least 1, got {workers}")
    prepare(recipe)
    folder = _folder(recipe, Path(out), resume)
    missing = [shard for shard in range(recipe.shards) if not _finished(recipe, folder, shard)]
    done = recipe.frames - sum(len(recipe.shard_range(shard)) for shard in missing)

    def report(shard: int | None = None) -> None:
        nonlocal done
        done += len(recipe.shard_range(shard)) if shard is not None else 0
        if progress:
            progress(done, recipe.frames)

    report()
    if missing:
        (folder / MANIFEST).unlink(missing_ok=True)
        missing = _make(recipe, folder, missing, workers, report)
    if missing:  # a worker died: the fault may be the machine's, so its shards get one more try
        missing = _make(recipe, folder, missing, workers, report)
    if missing:
        raise PartialError(
            f"workers died twice, {len(missing)} of {recipe.shards} shards are missing in "
            f"{folder}. Look for lack of memory, or, in a script, for a missing "
            "if __name__ == '__main__'; then continue with --resume"
        )
    manifest = _manifest(recipe, folder)
    write_manifest(folder, manifest)
    return manifest


def _folder(recipe: Recipe, folder: Path, resume: bool) -> Path:
    """A folder that holds this recipe, and nothing of another."""
    text = recipe.to_toml().encode()
    path = folder / RECIPE
    if not (resume and folder.is_dir() and any(folder.iterdir())):
        new_folder(folder)
        write_file(path, text)
        return folder
    remove_leftovers(folder)
    if not path.is_file():
        if any(folder.iterdir()):
            raise ConfigurationError(
                f"cannot resume in {folder}: it holds no {RECIPE}, so it is no dataset that was "
                "begun; choose another folder"
            )
        write_file(path, text)
    elif path.read_bytes() != text:
        raise ConfigurationError(
            f"cannot resume in {folder}: it was begun with another recipe or seed, which "
            f"{path} holds; give that recipe, or choose another folder"
        )
    return folder


def _finished(recipe: Recipe, folder: Path, shard: int) -> bool:
    """Whether `shard` lies there whole; a damaged one counts as missing and is made again."""
    path, frames = folder / shard_name(shard), recipe.shard_range(shard)
    if not path.is_file():
        return False
    try:
        data = read_shard(path, frames.start)
    except DataError:
        return False
    return len(data) == len(frames) and data.recipe == recipe.to_toml()


def _make(
    recipe: Recipe,
    folder: Path,
    shards: Sequence[int],
    workers: int,
    report: Callable[[int], None],
) -> list[int]:
    """Make `shards`; returns those that were lost because a worker died."""
    context = multiprocessing.get_context("spawn")
    # Shared memory without a lock: one held at the wrong moment would stop the workers for ever.
    stop = context.RawValue(ctypes.c_bool, False)
    lost = set(shards)
    with (
        _one_interrupt(stop),
        _one_thread_per_process(),
        ProcessPoolExecutor(
            min(workers, len(shards)), context, initializer=_start_worker, initargs=(stop,)
        ) as pool,
    ):
        try:
            with _interrupts_held_back():  # workers start here, and keep them blocked
                futures = [pool.submit(_make_shard, recipe, folder, shard) for shard in shards]
            for future in as_completed(futures):
                if isinstance(future.exception(), BrokenProcessPool):
                    continue
                lost.remove(future.result())
                report(future.result())
        except BrokenProcessPool:  # from submit
            pass
        except BaseException:
            stop.value = True
            # Waits while further interrupts are still swallowed: after a shutdown that does not
            # wait, nobody would, and one of them could cut the pool off from its workers.
            pool.shutdown(wait=True, cancel_futures=True)
            raise
    return sorted(lost)


@contextmanager
def _one_interrupt(stop: ctypes.c_bool) -> Iterator[None]:
    """Let Ctrl-C stop the workers and be raised once; more would disturb the clearing up."""

    def interrupt(number: int, frame: object) -> None:  # noqa: ARG001
        if not stop.value:
            stop.value = True
            raise KeyboardInterrupt

    # Only the main thread may say what a signal does, and only it gets the interrupt.
    before = signal.getsignal(signal.SIGINT)
    ours = threading.current_thread() is threading.main_thread() and callable(before)
    if ours:
        signal.signal(signal.SIGINT, interrupt)
    try:
        yield
    finally:
        if ours:
            signal.signal(signal.SIGINT, before)


@contextmanager
def _interrupts_held_back() -> Iterator[None]:
    """Keep Ctrl-C waiting; processes that are started meanwhile never get it."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def _one_thread_per_process() -> Iterator[None]:
    """Let processes that are started now use one BLAS thread each.

    More would fight over the cores, and sums would depend on how many there are.
    """
    before = {name: os.environ.get(name) for name in _THREAD_LIMITS}
    os.environ.update(dict.fromkeys(_THREAD_LIMITS, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


def _manifest(recipe: Recipe, folder: Path) -> Manifest:
    ranges = [recipe.shard_range(shard) for shard in range(recipe.shards)]
    return Manifest(
        source="simulated",
        recipe_sha256=hashlib.sha256(recipe.to_toml().encode()).hexdigest(),
        seed=recipe.seed,
        frames=recipe.frames,
        shards=tuple(
            shard_entry(folder, shard_name(shard), frames.start, len(frames))
            for shard, frames in enumerate(ranges)
        ),
    )


# From here on: what runs in a worker.

_stop: ctypes.c_bool | None = None


class _Stopped(Exception):  # noqa: N818 - it is no error
    """The parent has asked for an end."""


def _start_worker(stop: ctypes.c_bool) -> None:
    """Look to `stop`, which the parent sets; end when the parent has gone."""
    global _stop  # noqa: PLW0603 - the one way to reach tasks from a pool's initializer
    _stop = stop
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _make_shard(recipe: Recipe, folder: Path, shard: int) -> int:
    """Simulate and write `shard`; only its number goes back."""
    data = simulate_shard(recipe, shard, before_solve=_check_stop)
    write_shard(folder / shard_name(shard), data, recipe.shard_range(shard).start)
    return shard


def _check_stop() -> None:
    if _stop is not None and _stop.value:
        raise _Stopped
