"""Generation of a dataset from a recipe, resumable after interruptions."""

import dataclasses
import hashlib
from collections.abc import Callable, Generator, Iterable, Sequence
from contextlib import closing, suppress
from functools import partial
from pathlib import Path

from eitskin.datasets.generation.preparation import free_bytes, prepare
from eitskin.datasets.generation.shard_simulation import simulate_shard
from eitskin.datasets.recipe.frame_sampling import specimen_numbers
from eitskin.datasets.recipe.recipe import Recipe
from eitskin.datasets.store.folder import make_folder, require_empty
from eitskin.datasets.store.manifest import (
    MANIFEST,
    RECIPE,
    Manifest,
    ShardEntry,
    read_manifest,
    shard_content,
    write_manifest,
)
from eitskin.datasets.store.schema import ENGINE
from eitskin.datasets.store.shard import shard_name, write_entry
from eitskin.datasets.store.shard_reader import parse_shard, read_engine
from eitskin.datasets.store.worker_processes import (
    check_scheduler,
    leave_worker_that_starts,
    run_tasks,
    worthwhile,
)
from eitskin.errors import ConfigurationError, DataError, PartialError
from eitskin.files import TEMPORARY, read_bytes, remove_file, remove_leftovers, write_file

# Lower bound for any frame: noise does not compress, and each channel is stored twice.
_MIN_BYTES_PER_CHANNEL = 4

Progress = Callable[[int, int], None]
Entries = dict[int, ShardEntry]


def generate(
    recipe: Recipe,
    out: str | Path,
    workers: int = 2,
    progress: Progress | None = None,
    resume: bool = False,
    scheduler: str | None = None,
    shard: int | None = None,
    examined: Progress | None = None,
) -> Manifest | None:
    """Generate the dataset of `recipe` in the folder `out`.

    The bytes depend on the recipe alone, not on the workers or on interruptions. Scripts that call
    this function with several workers, which are new processes, need the usual
    `if __name__ == "__main__":`.

    Args:
        recipe: recipe of the dataset.
        out: folder; new or empty, unless `resume` or `shard`.
        workers: number of processes; one works in this process. With `scheduler` they only look
            for finished shards, with `shard` there are none.
        progress: called with the number of finished frames and of all frames.
        resume: keep the finished shards in `out` and simulate the others.
            Half-written files of killed writers are removed.
        scheduler: address of a dask.distributed scheduler, for its workers instead of processes.
        shard: number of the only shard to simulate. Any number of such calls may share a folder at
            the same time, and leave the half-written files of others alone; a call that finds all
            shards finished writes the manifest.
        examined: called with the number of examined shards and of all, while `resume` looks for
            finished ones.

    Returns:
        The manifest that was written; None with `shard` while other shards are missing.

    Raises:
        ConfigurationError: where `out` holds something else or has no room, forces are beyond the
            reach of the presses, or the scheduler cannot be used.
        PartialError: where files cannot be written or workers died; resume after the repair.

    Example:
        >>> from eitskin.datasets import Recipe, generate
        >>> generate(Recipe.from_shipped("quick"), "data", workers=2)  # doctest: +SKIP
    """
    if workers < 1:
        raise ConfigurationError(f"workers must be at least 1, got {workers}")
    leave_worker_that_starts()
    if shard is not None and scheduler:
        raise ConfigurationError(
            "expected a scheduler, which makes all shards, or the number of one shard, got both; "
            "leave one out"
        )
    if scheduler:
        check_scheduler(scheduler)
    folder = Path(out)
    if not resume and shard is None:
        require_empty(folder)  # before hours of work
    prepare(recipe, workers=workers, specimens=needed_specimens(recipe, shard))
    wanted = range(recipe.shards) if shard is None else range(shard, shard + 1)
    kept: Entries = {}
    if resume or shard is not None:
        kept = _verify_finished_shards(
            recipe, folder, wanted, workers if shard is None else 1, examined
        )
    missing = [number for number in wanted if number not in kept]
    _require_engine(folder, kept.values() if missing else ())
    _check_room(recipe, folder, missing)
    _begin(recipe, folder, shared=shard is not None)
    total = _frames(recipe, wanted)
    done = total - _frames(recipe, missing)

    def report(finished: int | None = None) -> None:
        nonlocal done
        done += _frames(recipe, () if finished is None else (finished,))
        if progress:
            progress(done, total)

    report()
    if missing:
        remove_file(folder / MANIFEST)
        try:
            with closing(make_shards(recipe, folder, missing, workers, scheduler)) as new_shards:
                for number, entry in new_shards:
                    kept[number] = entry
                    report(number)
        finally:
            if shard is None:
                remove_leftovers(folder)  # of workers killed while writing
    if shard is not None:
        shards = range(recipe.shards)
        if not all((folder / shard_name(number)).is_file() for number in shards):
            return None
        kept = _verify_finished_shards(recipe, folder, shards)
    if len(kept) < recipe.shards:
        return None
    manifest = Manifest.from_shards("simulated", kept.values(), recipe.to_toml(), recipe.seed)
    write_manifest(folder, manifest)
    return manifest


def make_shards(
    recipe: Recipe, folder: Path, shards: Sequence[int], workers: int, scheduler: str | None
) -> Generator[tuple[int, ShardEntry], None, None]:
    """Simulate `shards` into `folder`; numbers and entries of the finished ones in their order."""
    task = partial(make_shard, recipe, folder.resolve())
    remedy = "continue with --resume"
    for number, entry in run_tasks(task, shards, workers, scheduler, remedy):
        if not (folder / entry.name).is_file():
            raise PartialError(
                f"there is no {folder / entry.name} here, which a worker has written; where "
                "workers run on other machines, they must see the same folder under the same path; "
                f"then {remedy}"
            )
        yield number, entry


def make_shard(recipe: Recipe, folder: Path, shard: int) -> ShardEntry:
    """Simulate and write one shard; returns its entry: the task of a worker."""
    data = simulate_shard(recipe, shard)
    return write_entry(folder, shard, data, recipe.shard_range(shard).start)


def needed_specimens(recipe: Recipe, shard: int | None) -> list[int] | None:
    """Numbers of the specimens of one shard; None where all shards are wanted.

    Raises ConfigurationError for a shard that the recipe has not.
    """
    if shard is None:
        return None
    if not 0 <= shard < recipe.shards:
        raise ConfigurationError(
            f"recipe '{recipe.name}' has shards 0 to {recipe.shards - 1}, got shard {shard}; give "
            "one of them, or change frames_per_shard in the recipe"
        )
    return specimen_numbers(recipe, recipe.shard_range(shard))


def _require_engine(folder: Path, entries: Iterable[ShardEntry]) -> None:
    """Raise ConfigurationError for finished shards whose frames would be made otherwise now."""
    for entry in entries:
        engine = read_engine(folder / entry.name)
        if engine != ENGINE:
            raise ConfigurationError(
                f"cannot resume in {folder}: {entry.name} is of simulation {engine}, and this "
                f"eitskin has simulation {ENGINE}, whose frames differ; choose another folder, or "
                "finish it with the version that began it"
            )


def _check_room(recipe: Recipe, folder: Path, missing: Sequence[int]) -> None:
    """Raise ConfigurationError for a disk that is certainly too full, before hours of work."""
    electrodes = len(recipe.sensor.electrodes)
    channels = _frames(recipe, missing) * electrodes * (electrodes - 1) // 2
    needed, free = channels * _MIN_BYTES_PER_CHANNEL, free_bytes(folder)
    if needed > free:
        raise ConfigurationError(
            f"the disk of {folder} has no room: expected at least {needed / 1e6:.2g} MB, got "
            f"{free / 1e6:.2g} MB; make room, or choose a folder elsewhere"
        )


def _frames(recipe: Recipe, shards: Sequence[int]) -> int:
    return sum(len(recipe.shard_range(shard)) for shard in shards)


def _begin(recipe: Recipe, folder: Path, shared: bool) -> None:
    """Make sure that `folder` holds this recipe, and no files of another dataset.

    Several calls may begin a `shared` folder at once: they write the same recipe, and leave the
    temporary files of each other alone.
    """
    text, path = recipe.to_toml().encode(), folder / RECIPE
    # Listed before the look at the recipe: another call may write recipe and shard in between.
    held = sorted(name for name in make_folder(folder) if not name.startswith(TEMPORARY))
    if not shared:
        remove_leftovers(folder)
    if path.is_file():
        if read_bytes(path) != text:
            raise ConfigurationError(
                f"cannot resume in {folder}: {path} is another recipe or seed; give that recipe, "
                "or choose another folder"
            )
    elif held:
        raise ConfigurationError(
            f"cannot resume in {folder}: the folder holds {held[0]} but no {RECIPE}, so that no "
            "dataset was begun there; choose another folder"
        )
    else:
        write_file(path, text)


def _verify_finished_shards(
    recipe: Recipe,
    folder: Path,
    shards: Sequence[int],
    workers: int = 1,
    examined: Progress | None = None,
) -> Entries:
    """Entries of those `shards` that lie finished in `folder`, by number."""
    checksums: dict[str, str] = {}
    with suppress(DataError):
        checksums = {entry.name: entry.sha256 for entry in read_manifest(folder).shards}
    names = []
    for name, frames in ((shard_name(shard), recipe.shard_range(shard)) for shard in shards):
        names.append(ShardEntry(name, frames.start, len(frames), checksums.get(name, "")))
    workers = worthwhile(workers, (folder / entry.name for entry in names))
    valid_entries: Entries = {}
    numbers = dict(zip(names, shards, strict=True))
    examine = partial(_examine, folder, recipe)
    with closing(run_tasks(examine, names, workers)) as entries:
        for count, (expected, entry) in enumerate(entries, 1):
            if entry is not None:
                valid_entries[numbers[expected]] = entry
            if examined:
                examined(count, len(names))
    return valid_entries


def _examine(folder: Path, recipe: Recipe, expected_entry: ShardEntry) -> ShardEntry | None:
    """Entry of a shard that is whole and of this recipe; None where it has to be made."""
    try:
        content = shard_content(folder, expected_entry)
        # Whoever made the file, a seal says that it is whole and not that it does no harm.
        data = parse_shard(content, folder / expected_entry.name, expected_entry.first_index)
    except DataError:
        return None
    origin = data.recipe, data.seed, data.source, data.protocol, data.design
    expected = recipe.to_toml(), recipe.seed, "simulated", recipe.measured_protocol, recipe.sensor
    said = data.frequency, data.quantity, bool(read_engine(folder / expected_entry.name))
    sound = len(data) == expected_entry.count and origin == expected
    sound &= said == (recipe.excitation_frequency, recipe.quantity, True)
    digest = hashlib.sha256(content).hexdigest()
    return dataclasses.replace(expected_entry, sha256=digest) if sound else None
