"""Dataset on disk: a folder of shards with a manifest, written last."""

import hashlib
import itertools
import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import msgspec

from eitskin.datasets.store.dataset import Dataset
from eitskin.datasets.store.schema import FORMAT, FORMAT_VERSION
from eitskin.datasets.store.shard import read_shard, shard_name, shard_of, write_shard
from eitskin.errors import ConfigurationError, DataError, PartialError
from eitskin.files import write_file

MANIFEST = "manifest.json"
Progress = Callable[[int, int], None]


@dataclass(frozen=True, slots=True)
class ShardEntry:
    """Entry of a shard in a manifest: file name, frames, SHA-256."""

    name: str
    first_index: int
    count: int
    sha256: str


@dataclass(frozen=True, slots=True)
class Manifest:
    """Content of a complete dataset; written after all files that it names."""

    source: str
    recipe_sha256: str
    seed: int
    frames: int
    shards: tuple[ShardEntry, ...]
    format: str = FORMAT
    format_version: int = FORMAT_VERSION


def open_dataset(path: str | Path, progress: Progress | None = None) -> Dataset:
    """Dataset read into memory.

    Args:
        path: folder of a dataset, or a single shard.
        progress: called with the number of shards read and of all shards.

    Raises:
        DataError: where files are missing, damaged, newer than this eitskin, or no dataset.
        ConfigurationError: for a dataset larger than the memory of this machine.
    """
    path = Path(path)
    if path.is_file():
        return read_shard(path)
    manifest = read_manifest(path)
    parts = read_shards(path, progress)
    first = next(parts)
    _check_memory(path, manifest.frames * first.bytes_per_frame)
    return Dataset.collect(itertools.chain((first,), parts), manifest.frames)


def read_shards(path: str | Path, progress: Progress | None = None) -> Iterator[Dataset]:
    """Datasets of all shards, one after the other, for datasets larger than the memory.

    A shard holds only the specimens that occur in it; `specimen_number` says which of the whole
    dataset they are. Arguments and DataError as for `open_dataset`.
    """
    path = Path(path)
    if path.is_file():
        yield read_shard(path)
        return
    shards = read_manifest(path).shards
    for number, entry in enumerate(shards, 1):
        yield read_entry(path, entry)
        if progress:
            progress(number, len(shards))


def save_dataset(data: Dataset, folder: str | Path, frames_per_shard: int = 4096) -> Manifest:
    """Write `data` into a new or empty folder; returns the manifest.

    Args:
        data: at least one frame.
        folder: of the new dataset.
        frames_per_shard: number of frames in a file.

    Raises DataError without frames, ConfigurationError where the folder holds something, and
    PartialError where a file cannot be written.
    """
    if not len(data):
        raise DataError("a dataset needs at least one frame, got none")
    folder = new_folder(Path(folder))
    entries: list[ShardEntry] = []
    for first in range(0, len(data), frames_per_shard):
        part = data.select(slice(first, first + frames_per_shard))
        name = shard_name(len(entries))
        write_shard(folder / name, part, first)
        entries.append(shard_entry(folder, name, first, len(part)))
    manifest = Manifest(
        source=data.source,
        recipe_sha256=hashlib.sha256(data.recipe.encode()).hexdigest(),
        seed=data.seed,
        frames=len(data),
        shards=tuple(entries),
    )
    write_manifest(folder, manifest)
    return manifest


def read_manifest(folder: Path) -> Manifest:
    """Manifest of a dataset's folder, checked; raises DataError."""
    path = folder / MANIFEST
    if not path.is_file():
        found = len(list(folder.glob("shard-*.h5"))) if folder.is_dir() else 0
        remedy = (
            f"{found} finished shards lie there, so it was interrupted; generate it again with "
            "--resume, or open a single shard"
            if found
            else "give the folder that eitskin generate or eitskin import wrote"
        )
        raise DataError(f"{folder} is not a complete dataset, it has no {MANIFEST}; {remedy}")
    try:
        content = path.read_bytes()
        _check_version(path, content)
        manifest = msgspec.json.decode(content, type=Manifest)
    except (OSError, msgspec.MsgspecError) as error:
        raise DataError(f"{path} is not a manifest: {error}; make the dataset again") from error
    _check_shards(path, manifest)
    return manifest


def write_manifest(folder: Path, manifest: Manifest) -> None:
    """Write the manifest, after all shards: a manifest marks a complete dataset."""
    content = msgspec.json.format(msgspec.json.encode(manifest), indent=2)
    write_file(folder / MANIFEST, content + b"\n")


def shard_entry(folder: Path, name: str, first_index: int, count: int) -> ShardEntry:
    """Manifest entry of a shard in `folder`; raises PartialError where the shard is missing."""
    try:
        content = (folder / name).read_bytes()
    except OSError as error:
        raise PartialError(
            f"cannot read back {folder / name}: {error.strerror}; where workers run on other "
            "machines, they must see the same folder under the same path; then continue with "
            "--resume"
        ) from error
    return ShardEntry(name, first_index, count, hashlib.sha256(content).hexdigest())


def new_folder(folder: Path) -> Path:
    """Create `folder`, or accept an empty one; raises ConfigurationError otherwise."""
    if make_folder(folder):
        raise ConfigurationError(
            f"{folder} is not empty; choose another folder, or continue what lies there with "
            "--resume where it was generated"
        )
    return folder


def make_folder(folder: Path) -> frozenset[str]:
    """Create `folder` unless it exists; returns the names of the files in it.

    Raises ConfigurationError where the folder cannot be created or read.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        return frozenset(path.name for path in folder.iterdir())
    except OSError as error:
        raise ConfigurationError(
            f"cannot use the folder {folder}: {error.strerror}; give permission, or choose another"
        ) from error


def read_entry(folder: Path, entry: ShardEntry) -> Dataset:
    """Dataset of a shard that the manifest names; raises DataError for any damage.

    A file with another checksum is not opened, because damage can crash the HDF5 library.
    """
    path = folder / entry.name
    try:
        content = path.read_bytes()
    except OSError as error:
        raise DataError(f"cannot read {path}, which the manifest names: {error}") from error
    found = hashlib.sha256(content).hexdigest()
    if found != entry.sha256:
        raise DataError(
            f"{path} is not the file that the manifest names: expected SHA-256 {entry.sha256}, "
            f"got {found}; copy it again, or delete it and generate with --resume"
        )
    data = shard_of(content, path, entry.first_index)
    if len(data) != entry.count:
        raise DataError(f"{path} must hold {entry.count} frames, got {len(data)}")
    return data


def _check_memory(path: Path, needed: int) -> None:
    """Raise ConfigurationError where `needed` bytes are more than this machine has, if it says."""
    try:
        memory = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, ValueError, OSError):
        return
    if needed > memory:
        raise ConfigurationError(
            f"{path} takes {needed / 1e9:.1f} GB in memory, expected at most the "
            f"{memory / 1e9:.1f} GB of this machine; read it in parts with read_shards, or with "
            "ShuffledShards"
        )


def _check_version(path: Path, content: bytes) -> None:
    """Check format and version first: a newer manifest may have unknown keys."""
    head = msgspec.json.decode(content)
    if not isinstance(head, dict):
        raise DataError(f"{path} is not a manifest: expected an object, got {type(head).__name__}")
    name, version = head.get("format"), head.get("format_version")
    if name != FORMAT:
        raise DataError(f"{path}: expected format '{FORMAT}', got {name!r}")
    if not isinstance(version, int) or version < 1:
        raise DataError(f"{path}: expected a format version of 1 or more, got {version!r}")
    if version > FORMAT_VERSION:
        raise DataError(
            f"{path}: format version {version} is newer than {FORMAT_VERSION}, the last that this "
            "eitskin reads; upgrade with pip install --upgrade eitskin"
        )


def _check_shards(path: Path, manifest: Manifest) -> None:
    """Raise DataError for shards outside the folder, gaps and overlaps."""
    following = 0
    for entry in manifest.shards:
        if Path(entry.name).name != entry.name or entry.name.startswith("."):
            raise DataError(f"{path}: a shard must lie beside the manifest, got {entry.name!r}")
        if entry.first_index != following:
            raise DataError(
                f"{path}: {entry.name} must start at frame {following}, got {entry.first_index}"
            )
        following += entry.count
    if not manifest.shards or following != manifest.frames:
        raise DataError(f"{path}: expected {manifest.frames} frames, its shards hold {following}")
