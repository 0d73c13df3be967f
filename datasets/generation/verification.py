"""Verification of a dataset on disk: damaged, missing and foreign files."""

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
    """A damaged, missing or foreign file: its name, and the problem with a remedy."""

    file: str
    problem: str


@dataclass(frozen=True, slots=True)
class Verdict:
    """Result of a verification: number of sound shards, of their frames, and all damage."""

    shards: int
    frames: int
    damage: tuple[DamagedFile, ...]


def verify(folder: str | Path, watch: Callable[[int, int], None] | None = None) -> Verdict:
    """Check every file of a dataset, including those after a damaged one.

    Checks of a shard: SHA-256, the checksums within the file, format, links, shapes and values, and
    consistency with the other shards. Without a sound manifest, which is damage too, the shards in
    the folder are checked without SHA-256.

    Args:
        folder: of the dataset.
        watch: called with the number of checked shards and of all shards.
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
                shared = data.select([])  # the data that all shards share, without frames
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
    """Damage of the recipe beside the shards, and shards that the manifest does not name."""
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
