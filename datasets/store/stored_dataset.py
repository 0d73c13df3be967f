"""Dataset of a folder whose columns are read when they are first used."""

import os
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from eitskin.datasets.store.dataset import ORIGIN, Dataset, frame_bytes, require_same_origin
from eitskin.datasets.store.manifest import Manifest, ShardEntry, note_known, shard_content
from eitskin.datasets.store.schema import FIELDS, FRAME_FIELDS
from eitskin.datasets.store.shard_reader import Columns, opened_shard
from eitskin.datasets.store.values import SpecimenReferences
from eitskin.errors import ConfigurationError
from eitskin.frame import Frame

_NAMES = frozenset(field.name for field in FIELDS)
# Columns whose values are checked against each other.
_TOGETHER = ({"touch_x", "touch_y"}, {"specimen", "specimen_number", "reference"})


class StoredDataset(Dataset):
    """Dataset of a folder, whose columns are read into memory when they are first used.

    All else is as in a `Dataset`. A column takes a pass over all shards, `read` takes one for
    several. Each file's SHA-256 is compared before the file is opened, in every pass, and the
    columns are checked as they are read. A part of the frames is read without the others by
    `select`, which reads all columns of the shards that hold them.
    """

    __slots__ = ("_compared", "_folder", "_head", "_held", "_manifest", "_progress")
    _folder: Path
    _manifest: Manifest
    _head: Dataset
    _progress: Callable[[int, int], None] | None
    _held: set[str]  # names of the columns in memory
    _compared: set[str]  # names of the shards that were found to be of this dataset

    def __new__(cls, *values: Any, **known: Any) -> Any:
        """Dataset in memory, as `dataclasses.replace` asks for; `of_folder` makes the others."""
        return Dataset(*values, **known)

    @classmethod
    def of_folder(
        cls,
        folder: Path,
        manifest: Manifest,
        head: Dataset,
        progress: Callable[[int, int], None] | None = None,
    ) -> "StoredDataset":
        """Dataset without any column in memory.

        Args:
            folder: of the shards.
            manifest: of the folder.
            head: one of its shards, without frames.
            progress: called with the number of shards read and of all shards, in each pass.
        """
        made: StoredDataset = object.__new__(cls)
        known = {"_folder": folder, "_manifest": manifest, "_head": head, "_progress": progress}
        known |= {"_held": set(), "_compared": set()}
        known["names"] = head.names
        for name, value in (known | {name: getattr(head, name) for name in ORIGIN}).items():
            object.__setattr__(made, name, value)
        return made

    def __reduce__(self) -> Any:
        """Folder, without frames: another process reads its own."""
        return StoredDataset.of_folder, (self._folder, self._manifest, self._head)

    def __repr__(self) -> str:
        """Folder and number of frames."""
        return f"StoredDataset({str(self._folder)!r}, {len(self)} frames)"

    def __len__(self) -> int:
        return self._manifest.frames

    def __getattr__(self, name: str) -> Any:
        """Read a column that is not in memory; called where an attribute has no value."""
        if name not in _NAMES:
            raise AttributeError(name)
        self.read(name)
        return getattr(self, name)

    @property
    def channels(self) -> int:
        return self._head.channels

    def read(self, *names: str) -> None:
        missing = _complete(names) - self._held
        if not missing:
            return
        columns, references = self._empty(len(self), missing), SpecimenReferences()
        shards = self._manifest.shards
        for number, entry in enumerate(shards, 1):
            part = self._part(entry, missing)
            if "reference" in part:
                references.add(part["specimen_number"], part["reference"])
                part["specimen"] = part["specimen_number"][part["specimen"]]
            for name, column in columns.items():
                column[entry.first_index : entry.first_index + entry.count] = part[name]
            if self._progress:
                self._progress(number, len(shards))
        if "reference" in missing:
            columns["specimen_number"], columns["reference"] = references.collected()
            rows = np.searchsorted(columns["specimen_number"], columns["specimen"])
            columns["specimen"] = rows.astype(np.uint32)
        for name, column in columns.items():
            object.__setattr__(self, name, column)
        self._held.update(missing)
        object.__setattr__(self, "_manifest", note_known(self._manifest))

    def frame(self, index: int) -> Frame:
        self.read("impedance", "time", "number", "episode", "status")
        return super().frame(index)

    def select(self, indices: ArrayLike | slice) -> Dataset:
        chosen = indices if isinstance(indices, slice) else np.asarray(indices)
        if isinstance(chosen, np.ndarray) and chosen.size == 0:
            chosen = chosen.astype(np.int64)
        rows = np.arange(len(self))[chosen]
        self.read("reference")
        columns = self._empty(len(rows), _NAMES)
        order = np.argsort(rows, kind="stable")
        starts = [entry.first_index for entry in self._manifest.shards]
        ends = [*np.searchsorted(rows[order], starts).tolist(), len(rows)]
        for entry, start, end in zip(self._manifest.shards, ends[:-1], ends[1:], strict=True):
            if start < end:
                part, places = self._part(entry, _NAMES), order[start:end]
                numbers = part["specimen_number"][part["specimen"]]
                part["specimen"] = np.searchsorted(self.specimen_number, numbers).astype(np.uint32)
                for name, column in columns.items():
                    column[places] = part[name][rows[places] - entry.first_index]
        known: dict[str, Any] = {name: getattr(self, name) for name in ORIGIN}
        known |= {"reference": self.reference, "specimen_number": self.specimen_number}
        known["names"] = self.names
        return Dataset(**(known | columns))

    def _empty(self, frames: int, names: Collection[str]) -> Columns:
        """Uninitialised columns of as many frames; raises ConfigurationError without the memory."""
        require_memory(self._folder, frames * frame_bytes(self.channels, names))
        return {
            field.name: np.empty((frames, *getattr(self._head, field.name).shape[1:]), field.dtype)
            for field in FRAME_FIELDS
            if field.name in names
        }

    def _part(self, entry: ShardEntry, names: Collection[str]) -> Columns:
        """Columns of one shard; raises DataError for damage and shards of another dataset."""
        content = shard_content(self._folder, entry)
        path = self._folder / entry.name
        with opened_shard(content, path, entry.first_index, entry.known) as shard:
            if entry.name not in self._compared:
                require_same_origin(self._head, shard.origin())
                self._compared.add(entry.name)
            return shard.columns(entry.count, self.channels, names)


def require_memory(path: Path, needed: int) -> None:
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


def _complete(names: Collection[str]) -> set[str]:
    """`names` with those that are checked together with them."""
    partners = (group for group in _TOGETHER if group.intersection(names))
    return set(names).union(*partners)
