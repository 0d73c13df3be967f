"""Looking through a dataset on disk for everything that is damaged, lost or does not belong."""

import hashlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from eitskin.datasets.generation.generate import RECIPE
from eitskin.datasets.store.dataset import Dataset
from eitskin.datasets.store.folder import MANIFEST, Manifest, ShardEntry, read_entry, read_manifest
from eitskin.datasets.store.shard import read_shard
from eitskin.errors import DataError

SHARDS = "shard-*.h5"
_REPAIR = "copy it again, or delete it and generate with --resume"


@dataclass(frozen=True, slots=True)
class DamagedFile:
    """One thing that is wrong: the file's name, and what is wrong with it and what to do."""

    file: str
    problem: str


@dataclass(frozen=True, slots=True)
class Verdict:
    """What was looked through: number of good shards and frames in them, and all damage."""

    shards: int
    frames: int
    damage: tuple[DamagedFile, ...]


def verify(folder: str | Path, watch: Callable[[int, int], None] | None = None) -> Verdict:
    """Check every file of a dataset, and go on where one is damaged.

    Of each shard: its SHA-256, the checksums within it, format, links, shapes and values, and
    whether it belongs to the others. Where the manifest is lost or damaged, which is damage too,
    the shards that lie there are checked without their SHA-256.

    Args:
        folder: of the dataset.
        watch: called with the number of shards that were looked at and of all.
    """
    folder = Path(folder)
    damage: list[DamagedFile] = []
    readers: dict[str, Callable[[], Dataset]]
    try:
        manifest = read_manifest(folder)
        readers = {each.name: partial(_shard, folder, each, manifest) for each in manifest.shards}
        damage.extend(_around(folder, manifest))
    except DataError as error:
        damage.append(DamagedFile(MANIFEST, str(error)))
        readers = {path.name: partial(read_shard, path) for path in sorted(folder.glob(SHARDS))}
    frames = 0
    shared: Dataset | None = None
    for number, (name, read) in enumerate(readers.items()):
        if watch:
            watch(number, len(readers))
        try:
            data = read()
            if shared is None:
                shared = data.select([])  # what all shards have in common, without frames
            Dataset.concatenate((shared, data))
            frames += len(data)
        except DataError as error:
            damage.append(DamagedFile(name, str(error)))
    if watch:
        watch(len(readers), len(readers))
    broken = {each.file for each in damage}
    return Verdict(len(set(readers) - broken), frames, tuple(damage))


def _shard(folder: Path, entry: ShardEntry, manifest: Manifest) -> Dataset:
    data = read_entry(folder, entry)
    recipe = hashlib.sha256(data.recipe.encode()).hexdigest()
    if (data.source, data.seed, recipe) != (
        manifest.source,
        manifest.seed,
        manifest.recipe_sha256,
    ):
        raise DataError(
            f"{folder / entry.name} was made from another recipe or seed than {MANIFEST} says; "
            f"{_REPAIR}"
        )
    return data


def _around(folder: Path, manifest: Manifest) -> Iterator[DamagedFile]:
    """What is wrong with the recipe beside the shards, and shards that nothing names."""
    recipe = folder / RECIPE
    if manifest.source == "simulated" and recipe.is_file():
        found = hashlib.sha256(recipe.read_bytes()).hexdigest()
        if found != manifest.recipe_sha256:
            yield DamagedFile(
                RECIPE,
                f"expected SHA-256 {manifest.recipe_sha256}, got {found}; copy it again",
            )
    known = {entry.name for entry in manifest.shards}
    for path in sorted(folder.glob(SHARDS)):
        if path.name not in known:
            yield DamagedFile(path.name, f"is not named in {MANIFEST}; move it elsewhere")
