"""Verification of a dataset on disk: damaged, missing and foreign files."""

import hashlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from eitskin.datasets.generation.generate import RECIPE
from eitskin.datasets.store.dataset import Dataset, require_same_origin
from eitskin.datasets.store.folder import read_entry
from eitskin.datasets.store.manifest import (
    MANIFEST,
    Manifest,
    ShardEntry,
    note_known,
    read_manifest,
)
from eitskin.datasets.store.schema import SpecimenReferences
from eitskin.datasets.store.shard_reader import read_shard
from eitskin.datasets.store.worker_processes import run_tasks, worthwhile
from eitskin.errors import DataError
from eitskin.files import read_bytes

SHARDS = "shard-*.h5"
_REPAIR = "copy it again, or delete it and generate with --resume"


@dataclass(frozen=True, slots=True)
class DamagedFile:
    """A damaged, missing or foreign file: its name, and the problem with a remedy."""

    file: str
    problem: str


@dataclass(frozen=True, slots=True)
class Verdict:
    """Result of a verification: number of sound shards, of their frames, and all damage."""

    shards: int
    frames: int
    damage: tuple[DamagedFile, ...]


def verify(
    folder: str | Path, watch: Callable[[int, int], None] | None = None, workers: int = 1
) -> Verdict:
    """Check every file of a dataset, including those after a damaged one.

    Checks of a shard: SHA-256, the checksums within the file, format, links, shapes and values, and
    consistency with the other shards. Without a sound manifest, which is damage too, the shards in
    the folder are checked without SHA-256. A worker holds one shard at a time.

    Args:
        folder: folder of the dataset.
        watch: called with the number of checked shards and of all shards.
        workers: number of processes for a large dataset; more than one needs
            `if __name__ == "__main__":` in a script.

    Raises PartialError where a worker dies.

    Example:
        >>> import numpy as np
        >>> from eitskin.datasets import Dataset, save_dataset, verify
        >>> _ = save_dataset(Dataset.from_arrays(np.full((4, 28), 600.0)), "verified")
        >>> verify("verified").damage
        ()
    """
    folder = Path(folder)
    damage: list[DamagedFile] = []
    manifest, entries = None, dict[str, ShardEntry | None]()
    try:
        manifest = read_manifest(folder)
        entries = {entry.name: entry for entry in manifest.shards}
        damage.extend(_damage_outside_shards(folder, manifest))
    except DataError as error:
        damage.append(DamagedFile(MANIFEST, str(error)))
        entries = {path.name: None for path in sorted(folder.glob(SHARDS))}
    sound = frames = 0
    first: Dataset | None = None
    references = SpecimenReferences()
    if watch:
        watch(0, len(entries))
    workers = worthwhile(workers, (folder / name for name in entries))
    task, items = partial(_check, folder, manifest), list(entries.items())
    for number, ((name, _), file_damage) in enumerate(run_tasks(task, items, workers), 1):
        if isinstance(file_damage, str):
            damage.append(DamagedFile(name, file_damage))
        else:
            count, shared = file_damage
            first = shared if first is None else first
            try:
                require_same_origin(first, shared)
                references.add(shared.specimen_number, shared.reference)
                sound, frames = sound + 1, frames + count
            except DataError as error:
                damage.append(DamagedFile(name, str(error)))
        if watch:
            watch(number, len(entries))
    if manifest and not damage:
        note_known(manifest)
    return Verdict(sound, frames, tuple(damage))


def _check(
    folder: Path, manifest: Manifest | None, shard: tuple[str, ShardEntry | None]
) -> tuple[int, Dataset] | str:
    """Frames and shared data of a shard that is sound on its own; the problem of a damaged one."""
    name, entry = shard
    try:
        data = read_entry(folder, entry) if entry else read_shard(folder / name)
    except DataError as error:
        return str(error)
    origin = (data.source, data.seed, hashlib.sha256(data.recipe.encode()).hexdigest())
    if manifest and origin != (manifest.source, manifest.seed, manifest.recipe_sha256):
        return (
            f"{folder / name} was made from another recipe or seed than {MANIFEST} says; {_REPAIR}"
        )
    return len(data), data.select([])


def _damage_outside_shards(folder: Path, manifest: Manifest) -> Iterator[DamagedFile]:
    """Damage of the recipe next to the shards, and shards that the manifest does not name."""
    recipe = folder / RECIPE
    if manifest.source == "simulated" and recipe.is_file():
        digest = hashlib.sha256(read_bytes(recipe, failure=DataError)).hexdigest()
        if digest != manifest.recipe_sha256:
            yield DamagedFile(
                RECIPE,
                f"expected SHA-256 {manifest.recipe_sha256}, got {digest}; copy it again",
            )
    shard_names = {entry.name for entry in manifest.shards}
    for path in sorted(folder.glob(SHARDS)):
        if path.name not in shard_names:
            yield DamagedFile(path.name, f"is not named in {MANIFEST}; move it elsewhere")
