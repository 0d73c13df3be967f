"""Manifest of a dataset: the shards of a complete folder, with their checksums."""

import hashlib
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated

import msgspec

from eitskin.datasets.store.schema import (
    FORMAT,
    FORMAT_VERSION,
    LIMITS,
    MAX_SHARD_BYTES,
    require_format,
)
from eitskin.errors import DataError
from eitskin.files import parse_json, quote_value, read_bytes, write_file
from eitskin.simulator.deformation.solution_store import cache_folder

MANIFEST = "manifest.json"
RECIPE = "recipe.toml"
MAX_BYTES = 1 << 28  # of a manifest; a million shards take 150 MB


@dataclass(frozen=True, slots=True)
class Names:
    """Names of specimens and sessions by their numbers; those without a name are left out.

    Attributes:
        specimens: name of a specimen, with that of its sensor where a recording shows both, by
            `Dataset.specimen_number`.
        sessions: name of a session, by the number of its episode.
    """

    specimens: dict[int, str] = field(default_factory=dict)
    sessions: dict[int, str] = field(default_factory=dict)

    @classmethod
    def from_numbers(cls, specimens: Mapping[str, int], sessions: Mapping[str, int]) -> "Names":
        """Names that say more than the numbers they stand for; both are numbers by name."""
        both = (specimens, sessions)
        return cls(*({n: name for name, n in each.items() if name != str(n)} for each in both))

    def __bool__(self) -> bool:
        """Whether there is any name."""
        return bool(self.specimens or self.sessions)

    def shift_numbers(self, specimens: int, episodes: int) -> "Names":
        """The same names of specimens and episodes that are counted from other numbers."""
        return Names(
            {number + specimens: name for number, name in self.specimens.items()},
            {number + episodes: name for number, name in self.sessions.items()},
        )

    def merge(self, other: "Names") -> "Names":
        """Names of both; where both name a number, those of this one."""
        return Names(other.specimens | self.specimens, other.sessions | self.sessions)

    def specimen(self, number: int) -> str:
        """Name of a specimen; its number where it has none."""
        return self.specimens.get(number, str(number))


@dataclass(frozen=True, slots=True)
class ShardEntry:
    """Entry of a shard in a manifest: file name, frames, SHA-256.

    `known` says that this content is known to do no harm; a file has no say in it.
    """

    name: str
    first_index: int
    count: Annotated[int, msgspec.Meta(ge=1, le=LIMITS["frame"])]
    sha256: str
    known: bool = field(default=False, compare=False)

    @property
    def frames(self) -> range:
        """Numbers of its frames within the dataset."""
        return range(self.first_index, self.first_index + self.count)


@dataclass(frozen=True, slots=True)
class Manifest:
    """Content of a complete dataset; written after all files that it names.

    Names of specimens and sessions are in the file where there are any.
    """

    source: str
    recipe_sha256: str
    seed: Annotated[int, msgspec.Meta(ge=0, le=(1 << 63) - 1)]
    frames: int
    shards: tuple[ShardEntry, ...]
    format: str = FORMAT
    format_version: int = FORMAT_VERSION
    names: Names = field(default_factory=Names)

    @classmethod
    def from_shards(
        cls,
        source: str,
        shards: Iterable[ShardEntry],
        recipe: str = "",
        seed: int = 0,
        names: Names | None = None,
    ) -> "Manifest":
        """Manifest of a recipe's shards, or of shards without a recipe."""
        ordered = tuple(sorted(shards, key=lambda entry: entry.first_index))
        digest = hashlib.sha256(recipe.encode()).hexdigest()
        frames = sum(entry.count for entry in ordered)
        return cls(source, digest, seed, frames, ordered, names=names or Names())


def read_manifest(folder: Path) -> Manifest:
    """Manifest of a dataset's folder, checked; raises DataError."""
    path = folder / MANIFEST
    if not path.is_file():
        count = len(list(folder.glob("shard-*.h5"))) if folder.is_dir() else 0
        remedy = (
            f"{count} finished shards lie there, so it was interrupted; generate it again with "
            "--resume, or open a single shard"
            if count
            else "give the folder that eitskin generate or eitskin import wrote"
        )
        if not folder.exists():
            raise DataError(f"there is no folder {folder}; {remedy}")
        raise DataError(f"{folder} is not a complete dataset, it has no {MANIFEST}; {remedy}")
    content = read_bytes(path, MAX_BYTES, DataError)
    try:
        head = parse_json(content)
        if isinstance(head, dict):  # a newer manifest may have unknown keys
            require_format(head.get("format"), head.get("format_version"))
        manifest: Manifest = parse_json(content, Manifest)
    except DataError as error:
        raise DataError(f"{path}: {error}") from error
    except ValueError as error:
        raise DataError(f"{path} is not a manifest: {error}; make the dataset again") from error
    _check_shards(path, manifest)
    with suppress(OSError):
        return _mark_entries(manifest, _note_path(manifest).is_file())
    return manifest


def write_manifest(folder: Path, manifest: Manifest) -> None:
    """Write the manifest, after all shards: a manifest marks a complete dataset."""
    write_file(folder / MANIFEST, manifest_bytes(manifest))
    note_known(manifest)


def note_known(manifest: Manifest) -> Manifest:
    """Note that the shards of a manifest do no harm to HDF5, since they were made or read here.

    A hash in a manifest shows damage and not intent: a folder from elsewhere brings both. Datasets
    that were made here, or whose shards were all read in a child, are noted in the user's folder
    for caches, so that their shards are read in this process from then on. Without a folder to
    write to, nothing is noted.

    Returns the manifest with entries that say so.
    """
    if not all(entry.known for entry in manifest.shards):
        with suppress(OSError):
            path = _note_path(manifest)
            path.parent.mkdir(parents=True, exist_ok=True)
            path.touch()
    return _mark_entries(manifest, True)


def _note_path(manifest: Manifest) -> Path:
    text = "\n".join(entry.sha256 for entry in manifest.shards).encode(errors="surrogatepass")
    return cache_folder() / "known-datasets" / hashlib.sha256(text).hexdigest()


def _mark_entries(manifest: Manifest, is_trusted: bool) -> Manifest:
    shards = tuple(replace(entry, known=is_trusted) for entry in manifest.shards)
    return replace(manifest, shards=shards)


def manifest_bytes(manifest: Manifest) -> bytes:
    """Content of the manifest's file."""
    document = msgspec.to_builtins(manifest, str_keys=True)
    for entry in document["shards"]:
        del entry["known"]
    if not manifest.names:
        del document["names"]
    return bytes(msgspec.json.format(msgspec.json.encode(document), indent=2)) + b"\n"


def shard_content(folder: Path, entry: ShardEntry) -> bytes:
    """Content of a shard; raises DataError for another checksum than that of its entry, if any.

    Damage can crash the HDF5 library, which is to be given this content only.
    """
    path = folder / entry.name
    content = read_bytes(path, MAX_SHARD_BYTES, DataError)
    digest = hashlib.sha256(content).hexdigest()
    if entry.sha256 not in ("", digest):
        raise DataError(
            f"{path} is not the file that the manifest names: expected SHA-256 {entry.sha256}, "
            f"got {digest}; copy it again, or delete it and generate with --resume"
        )
    return content


def _check_shards(path: Path, manifest: Manifest) -> None:
    """Raise DataError for shards outside the folder, gaps and overlaps."""
    following = 0
    for entry in manifest.shards:
        name = quote_value(entry.name)
        if Path(entry.name).name != entry.name or entry.name.startswith(".") or "\0" in entry.name:
            raise DataError(f"{path}: a shard must lie next to the manifest, got {name}")
        if entry.first_index != following:
            raise DataError(
                f"{path}: {name} must start at frame {following}, got {entry.first_index}"
            )
        following += entry.count
    if not manifest.shards or following != manifest.frames:
        raise DataError(f"{path}: expected {manifest.frames} frames, its shards hold {following}")
