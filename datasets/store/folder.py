"""Dataset on disk, a folder of shards with a manifest: read by columns, written frame by frame."""

import dataclasses
import itertools
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eitskin.bounds import require_count
from eitskin.closeable import Closeable
from eitskin.datasets.store.dataset import ORIGIN, Dataset, frame_numbers, require_same_origin
from eitskin.datasets.store.manifest import (
    Manifest,
    Names,
    ShardEntry,
    note_known,
    read_manifest,
    shard_content,
    write_manifest,
)
from eitskin.datasets.store.schema import (
    FIELDS,
    LIMITS,
    MAX_TOUCHES,
    UNKNOWN_STATE,
    ColumnCollector,
    frame_bytes,
)
from eitskin.datasets.store.shard import write_entry
from eitskin.datasets.store.shard_reader import parse_shard, read_shard
from eitskin.errors import ConfigurationError, DataError
from eitskin.extras import old_names
from eitskin.files import new_contents
from eitskin.frame import Frame, Status
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.simulator.scene.scene import Touch

READ_AT_ONCE = 64_000_000
"""Largest size of files that `open_dataset` reads at once [bytes]: a second or two of reading."""

Progress = Callable[[int, int], None]

_NAMES = frozenset(field.name for field in FIELDS)
_LABELS = {field.name for field in FIELDS if "channel" not in field.axes} | {"reference"}


def open_dataset(path: str | Path, progress: Progress | None = None) -> Dataset:
    """Dataset of a folder, or of a single shard.

    Files of up to `READ_AT_ONCE` bytes together are read into memory. A larger dataset is a
    `StoredDataset`: only its manifest and first shard are read now, and columns when they are first
    used. Damage of another shard is seen when it is read.

    Args:
        path: folder of a dataset, or a single shard.
        progress: called with the number of shards read and of all shards, whenever shards are read.

    Raises:
        DataError: where files are missing, damaged, newer than this eitskin, or no dataset.
        ConfigurationError: for columns larger than the memory of this machine.

    Example:
        >>> import numpy as np
        >>> from eitskin.datasets import Dataset, open_dataset, save_dataset
        >>> _ = save_dataset(Dataset.from_arrays(np.full((4, 28), 600.0)), "opened")
        >>> open_dataset("opened").impedance.shape
        (4, 28)
    """
    path = Path(path)
    if path.is_file():
        return read_shard(path)
    manifest = read_manifest(path)
    try:
        size = sum((path / entry.name).stat().st_size for entry in manifest.shards)
    except OSError as error:
        raise DataError(
            f"cannot read {error.filename}, which the manifest names: {error.strerror}; copy it "
            "again, or generate with --resume"
        ) from error
    parts = _shards(path, manifest, progress)
    first = dataclasses.replace(next(parts), names=manifest.names)
    if size > READ_AT_ONCE:
        return StoredDataset.from_folder(path, manifest, first.select([]), progress)
    require_memory(path, manifest.frames * first.bytes_per_frame)
    data = Dataset.collect(itertools.chain((first,), parts), manifest.frames)
    note_known(manifest)
    return data


def read_shards(path: str | Path, progress: Progress | None = None) -> Iterator[Dataset]:
    """Datasets of all shards, one after the other, for datasets larger than the memory.

    A shard holds only the specimens that occur in it; `specimen_number` says which of the whole
    dataset they are. Arguments and DataError as for `open_dataset`.

    Example:
        >>> import numpy as np
        >>> from eitskin.datasets import Dataset, read_shards, save_dataset
        >>> _ = save_dataset(Dataset.from_arrays(np.full((4, 28), 600.0)), "in_parts", 2)
        >>> [len(part) for part in read_shards("in_parts")]
        [2, 2]
    """
    path = Path(path)
    if path.is_file():
        yield read_shard(path)
        return
    yield from _shards(path, read_manifest(path), progress)


def _shards(path: Path, manifest: Manifest, progress: Progress | None) -> Iterator[Dataset]:
    for number, entry in enumerate(manifest.shards, 1):
        yield read_entry(path, entry)
        if progress:
            progress(number, len(manifest.shards))


def save_dataset(data: Dataset, folder: str | Path, frames_per_shard: int = 4096) -> Manifest:
    """Write `data` into a new or empty folder; returns the manifest.

    Args:
        data: data at least one frame.
        folder: folder of the new dataset.
        frames_per_shard: number of frames in a file.

    Raises DataError without frames, ConfigurationError where the folder holds something, and
    PartialError where a file cannot be written.

    Example:
        >>> import numpy as np
        >>> from eitskin.datasets import Dataset, save_dataset
        >>> save_dataset(Dataset.from_arrays(np.full((4, 28), 600.0)), "saved").frames
        4
    """
    if not len(data):
        raise DataError("a dataset needs at least one frame, got none")
    require_count("frames_per_shard", frames_per_shard, 1, LIMITS["frame"])
    starts = range(0, len(data), frames_per_shard)
    return save_parts((data.select(slice(i, i + frames_per_shard)) for i in starts), folder)


def save_parts(
    parts: Iterable[Dataset], folder: str | Path, progress: Callable[[int], None] | None = None
) -> Manifest:
    """Write the parts of one dataset into a new or empty folder, a shard for each, in their order.

    There is at least one part. `progress` is called with the number of written shards. Raises
    ConfigurationError where the folder holds something, and PartialError where a file cannot be
    written; then nothing of it is left.
    """
    folder = Path(folder)
    require_empty(folder)
    entries: list[ShardEntry] = []
    first, names = 0, Names()
    with _as_configuration_errors(folder), new_contents(folder):
        for part in parts:
            names = names.merge(part.names)
            entries.append(write_entry(folder, len(entries), part, first))
            first += len(part)
            if progress:
                progress(len(entries))
        manifest = Manifest.from_shards(part.source, entries, part.recipe, part.seed, names)
        write_manifest(folder, manifest)
    return manifest


def new_folder(folder: Path) -> Path:
    """Create `folder`, or accept an empty one; raises ConfigurationError otherwise."""
    require_empty(folder)
    make_folder(folder)
    return folder


def require_empty(folder: Path) -> None:
    """Raise ConfigurationError unless `folder` is empty, or could be made."""
    with _as_configuration_errors(folder):
        if folder.exists() and any(folder.iterdir()):
            raise ConfigurationError(
                f"{folder} is not empty; choose another folder, or continue what lies there with "
                "--resume where it was generated"
            )


def make_folder(folder: Path) -> frozenset[str]:
    """Create `folder` unless it exists; returns the names of the files in it.

    Raises ConfigurationError where the folder cannot be created or read.
    """
    with _as_configuration_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
        return frozenset(path.name for path in folder.iterdir())


@contextmanager
def _as_configuration_errors(folder: Path) -> Iterator[None]:
    """Raise the system's errors as ConfigurationError, with a remedy."""
    try:
        yield
    except OSError as error:
        raise ConfigurationError(
            f"cannot use the folder {folder}: {error.strerror}; give permission, or choose another"
        ) from error


def read_entry(folder: Path, entry: ShardEntry) -> Dataset:
    """Dataset of a shard that the manifest names; raises DataError for any damage."""
    content = shard_content(folder, entry)
    data = parse_shard(content, folder / entry.name, entry.first_index, entry.known)
    if len(data) != entry.count:
        raise DataError(f"{folder / entry.name} must hold {entry.count} frames, got {len(data)}")
    return data


class ShardWriter(Closeable):
    """Writer of frames into a new folder, shard by shard, with a manifest after each shard.

    A crash loses the frames of the last, unfinished shard: the manifest lists the shards before.
    Values that are not finite are written as 0, with the status NOT_FINITE.

    Use as a context manager:

        with ShardWriter("run", reference) as writer:
            writer.append(frame)

    Attributes:
        folder: folder of the dataset.
        readable: number of frames in finished shards, which survive a crash.

    Example:
        >>> import numpy as np
        >>> from eitskin import Frame, Protocol
        >>> from eitskin.datasets import ShardWriter, open_dataset
        >>> writer = ShardWriter("monday")
        >>> writer.append(Frame(np.full(28, 600.0), Protocol.pairwise(8)))
        >>> writer.close()
        >>> len(open_dataset("monday"))
        1
    """

    def __init__(
        self,
        folder: str | Path,
        reference: NDArray[Any] | None = None,
        *,
        design: SensorDesign | None = None,
        source: str = "measured",
        frames_per_shard: int = 256,
    ) -> None:
        """Start a dataset in `folder`, which must be new or empty.

        Args:
            folder: folder of the dataset.
            reference: flat, untouched sensor, (C,) [ohm]; the first frame of the first shard with
                only finite values when omitted.
            design: design of the sensor, where known.
            source: "measured" or "simulated".
            frames_per_shard: number of frames in a file, at most lost in a crash.
        """
        self.folder = new_folder(Path(folder))
        self._reference = reference
        self._shared: dict[str, Any] = {"design": design, "source": source}
        self._frames_per_shard = frames_per_shard
        self.readable = 0
        self._rows: list[tuple[Frame, Mapping[str, Any]]] = []
        self._entries: list[ShardEntry] = []

    def append(
        self,
        frame: Frame,
        *,
        state: int = UNKNOWN_STATE,
        bend_angle_deg: float = np.nan,
        touches: Sequence[Touch] = (),
        touch_reference: NDArray[Any] | None = None,
    ) -> None:
        """Add one frame with its known labels; raises FrameError for another protocol."""
        protocol = self._shared.setdefault("protocol", frame.protocol)
        protocol.require_same(
            frame.protocol,
            "this dataset holds frames of",
            "the next frame has",
            "record each protocol into its own folder",
        )
        self._shared.setdefault("frequency", frame.frequency)
        labels: dict[str, Any] = {"state": state, "bend_angle_deg": bend_angle_deg}
        labels["touch_reference"] = (
            np.full(len(protocol), np.nan) if touch_reference is None else touch_reference
        )
        labels |= touch_columns(touches)
        self._rows.append((frame, labels))
        if len(self._rows) == self._frames_per_shard:
            self._finish_shard()

    def close(self) -> None:
        """Write the remaining frames; a writer without frames leaves no dataset."""
        if self._rows:
            self._finish_shard()
        elif self.readable < self._count:
            self._list_shards()  # which failed before

    def _finish_shard(self) -> None:
        frames = [frame for frame, _ in self._rows]
        labels = {name: np.array([row[name] for _, row in self._rows]) for name in self._rows[0][1]}
        with np.errstate(over="ignore"):  # what single precision cannot hold is not finite
            impedance = np.array([frame.impedance for frame in frames]).astype(np.complex64)
        status = np.array([frame.status for frame in frames])
        finite = np.isfinite(impedance)
        impedance[~finite] = 0.0
        status[~finite] |= np.uint8(Status.NOT_FINITE)
        if self._reference is None:
            self._reference = impedance[int(finite.all(axis=1).argmax())]
        data = Dataset.from_arrays(
            impedance,
            self._reference,
            time=np.array([frame.time for frame in frames]),
            status=status,
            episode=np.array([frame.session for frame in frames]),
            number=np.array([frame.number for frame in frames]),
            **labels,
            **self._shared,
        )
        entry = write_entry(self.folder, len(self._entries), data, self._count)
        self._rows.clear()
        self._entries.append(entry)
        self._list_shards()

    @property
    def _count(self) -> int:
        """Number of frames in finished shards, listed or not."""
        return sum(entry.count for entry in self._entries)

    def _list_shards(self) -> None:
        manifest = Manifest.from_shards(self._shared["source"], self._entries)
        write_manifest(self.folder, manifest)
        self.readable = self._count


def touch_columns(touches: Sequence[Touch]) -> dict[str, NDArray[np.float32]]:
    """Touch arrays of one frame, (4,) each; raises ConfigurationError for too many touches."""
    if len(touches) > MAX_TOUCHES:
        raise ConfigurationError(
            f"a dataset holds at most {MAX_TOUCHES} touches per frame, got {len(touches)}"
        )
    columns = np.full((4, MAX_TOUCHES), np.nan, dtype=np.float32)
    for number, touch in enumerate(touches):
        columns[:, number] = touch.x, touch.y, touch.force, touch.indenter.rims[1]
    return dict(zip(("touch_x", "touch_y", "touch_force", "touch_radius"), columns, strict=True))


@old_names(of_folder="from_folder")
class StoredDataset(Dataset):
    """Dataset of a folder, whose columns are read into memory when they are first used.

    All else is as in a `Dataset`. A pass over all shards reads the columns that are asked for and
    all labels; `read` takes one pass for several columns. Each file is checked in every pass. A
    part of the frames is read without the others by `select`.

    Example:
        >>> from eitskin.datasets import Dataset, StoredDataset
        >>> issubclass(StoredDataset, Dataset)
        True
    """

    __slots__ = ("_folder", "_head", "_held", "_manifest", "_progress")
    _folder: Path
    _manifest: Manifest
    _head: Dataset
    _progress: Progress | None
    _held: set[str]  # names of the columns in memory

    def __new__(cls, *values: Any, **known: Any) -> Any:
        """Dataset in memory, as `dataclasses.replace` asks for; `from_folder` makes the others."""
        return Dataset(*values, **known)

    @classmethod
    def from_folder(
        cls, folder: Path, manifest: Manifest, head: Dataset, progress: Progress | None = None
    ) -> "StoredDataset":
        """Dataset without any column in memory; `head` is one of its shards without frames."""
        dataset: StoredDataset = object.__new__(cls)
        known: dict[str, Any] = {name: getattr(head, name) for name in (*ORIGIN, "names")}
        known |= {"_folder": folder, "_manifest": manifest, "_head": head, "_progress": progress}
        for name, value in (known | {"_held": set()}).items():
            object.__setattr__(dataset, name, value)
        return dataset

    def __reduce__(self) -> Any:
        """Folder, without frames: another process reads its own."""
        return StoredDataset.from_folder, (self._folder, self._manifest, self._head)

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
        missing = {*names} - self._held
        if not missing:
            return
        missing |= _LABELS - self._held
        require_memory(self._folder, len(self) * frame_bytes(self.channels, missing))
        columns = ColumnCollector(self.channels, len(self), missing)
        parts = _shards(self._folder, self._manifest, self._progress)
        for entry, part in zip(self._manifest.shards, parts, strict=True):
            require_same_origin(self._head, part)
            columns.put(slice(entry.frames.start, entry.frames.stop), part.columns)
        for name, column in columns.whole().items():
            object.__setattr__(self, name, column)
        self._held.update(missing)
        object.__setattr__(self, "_manifest", note_known(self._manifest))

    def frame(self, index: int) -> Frame:
        self.read("impedance", "status")
        return super().frame(index)

    def select(self, indices: ArrayLike | slice) -> Dataset:
        rows = np.arange(len(self))[frame_numbers(indices)]
        self.read("reference")
        require_memory(self._folder, len(rows) * self.bytes_per_frame)
        columns = ColumnCollector(self.channels, len(rows), _NAMES)
        columns.references.add(self.specimen_number, self.reference)
        order = np.argsort(rows, kind="stable")
        starts = [entry.first_index for entry in self._manifest.shards]
        ends = [*np.searchsorted(rows[order], starts).tolist(), len(rows)]
        for entry, places in zip(self._manifest.shards, np.split(order, ends[1:-1]), strict=True):
            if len(places):
                part = read_entry(self._folder, entry)
                require_same_origin(self._head, part)
                columns.put(places, part.select(rows[places] - entry.first_index).columns)
        attributes: dict[str, Any] = {name: getattr(self, name) for name in ORIGIN}
        return Dataset(**attributes, **columns.whole(), names=self.names)


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
