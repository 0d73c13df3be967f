"""Compaction: a dataset written anew in other shards, in the newest version of the format."""

from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from eitskin.datasets.store.dataset import Dataset
from eitskin.datasets.store.folder import Progress, new_folder, read_entry
from eitskin.datasets.store.manifest import (
    MANIFEST,
    Manifest,
    ShardEntry,
    manifest_bytes,
    note_known,
    read_manifest,
)
from eitskin.datasets.store.schema import LIMITS
from eitskin.datasets.store.shard import write_entry
from eitskin.datasets.store.worker_processes import run_tasks, worthwhile
from eitskin.errors import ConfigurationError, PartialError
from eitskin.files import atomic_folder

FRAMES_PER_SHARD = 65536
_REMEDY = "make room or give write permission, then compact again; nothing was left behind"


def compact(
    folder: str | Path,
    out: str | Path,
    frames_per_shard: int | None = FRAMES_PER_SHARD,
    progress: Progress | None = None,
    workers: int = 1,
) -> Manifest:
    """Write the frames of a dataset of any version into a new folder; returns the manifest.

    Frames and labels are the same, in the same order. The bytes depend on the frames alone, not on
    the workers. The dataset in `folder` stays as it is, and each of its shards is verified. The new
    folder appears when it is complete: after an error or Ctrl-C nothing is left.

    Args:
        folder: of the dataset.
        out: folder of the new dataset, new or empty.
        frames_per_shard: number of frames in a file; None keeps the shards as they are.
        progress: called with the number of written shards and of all shards.
        workers: number of processes for a large dataset, each of which holds the frames of one new
            shard; more than one needs `if __name__ == "__main__":` in a script.

    Raises:
        DataError: where the dataset is not complete, or a shard is damaged.
        ConfigurationError: where `out` holds something, or for an impossible number of frames.
        PartialError: where a file cannot be written, or a worker dies.
    """
    folder, manifest = Path(folder), read_manifest(Path(folder))
    if frames_per_shard is not None and not 1 <= frames_per_shard <= LIMITS["frame"]:
        raise ConfigurationError(
            f"frames_per_shard must be from 1 to {LIMITS['frame']}, got {frames_per_shard}"
        )
    out = new_folder(Path(out))
    out.rmdir()  # until it is complete
    pieces = _pieces(manifest, frames_per_shard)
    entries: list[ShardEntry] = []
    workers = worthwhile(workers, (folder / entry.name for entry in manifest.shards))
    with (
        atomic_folder(out, PartialError, _REMEDY) as temporary,
        closing(run_tasks(partial(_write, folder, temporary), pieces, workers)) as written,
    ):
        for _, entry in written:
            entries.append(entry)
            if progress:
                progress(len(entries), len(pieces))
        shards = tuple(sorted(entries, key=lambda entry: entry.first_index))
        made = Manifest(
            manifest.source,
            manifest.recipe_sha256,
            manifest.seed,
            manifest.frames,
            shards,
            names=manifest.names,
        )
        (temporary / MANIFEST).write_bytes(manifest_bytes(made))
    note_known(made)
    return made


@dataclass(frozen=True, slots=True)
class _Piece:
    """New shard: its number, its frames, and the old shards that hold them."""

    number: int
    frames: range
    sources: tuple[ShardEntry, ...]


def _pieces(manifest: Manifest, frames_per_shard: int | None) -> list[_Piece]:
    shards = manifest.shards
    if frames_per_shard is None:
        return [_Piece(n, _frames(entry), (entry,)) for n, entry in enumerate(shards)]
    pieces: list[_Piece] = []
    begun = 0  # first old shard with frames of the piece
    for number, first in enumerate(range(0, manifest.frames, frames_per_shard)):
        frames = range(first, min(first + frames_per_shard, manifest.frames))
        while _frames(shards[begun]).stop <= frames.start:
            begun += 1
        end = begun
        while end < len(shards) and shards[end].first_index < frames.stop:
            end += 1
        pieces.append(_Piece(number, frames, shards[begun:end]))
    return pieces


def _frames(entry: ShardEntry) -> range:
    return range(entry.first_index, entry.first_index + entry.count)


def _write(folder: Path, out: Path, piece: _Piece) -> ShardEntry:
    """Write one new shard; returns its entry."""
    parts = (_part(folder, entry, piece.frames) for entry in piece.sources)
    data = Dataset.collect(parts, len(piece.frames))
    return write_entry(out, piece.number, data, piece.frames.start, Path.write_bytes)


def _part(folder: Path, entry: ShardEntry, frames: range) -> Dataset:
    """Frames of one old shard that are among `frames`."""
    start, stop = (edge - entry.first_index for edge in (frames.start, frames.stop))
    return read_entry(folder, entry).select(slice(max(start, 0), max(stop, 0)))
