"""Reading of shards: datasets, or single columns, of HDF5 files that are checked as they are read.

h5py's low-level interface is used throughout: it opens and checks the arrays of a small file in
half the time of the high-level one.
"""

import hashlib
import math
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from eitskin.config import parse_toml
from eitskin.contained import Answer, Limits, contained
from eitskin.datasets.store.dataset import Dataset, known_quantity
from eitskin.datasets.store.schema import (
    FIELDS,
    FORMAT,
    FORMAT_VERSION,
    LIMITS,
    MAX_TOUCHES,
    MAX_VALUES,
    MOST_SHARD_BYTES,
    Field,
    check_values,
)
from eitskin.datasets.store.shard import unsealed
from eitskin.datasets.store.stored_arrays import all_arrays, one_array
from eitskin.errors import DataError
from eitskin.files import MOST_TEXT, quoted, read_bytes
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.protocol import Protocol

Columns = dict[str, NDArray[Any]]

SECONDS = 5
"""Processor time for the smallest of shards of unknown origin [s]."""

_BYTES_PER_SECOND = 2 << 20
_MEMORY, _MEMORY_PER_BYTE = 400 << 20, 24  # [bytes]

_NAMES = [field.name for field in FIELDS]
_TYPES = {field.name: h5py.h5t.py_create(field.dtype, logical=True) for field in FIELDS}


def read_shard(path: str | Path) -> Dataset:
    """Dataset of one shard, checked; raises DataError for any violation of the format."""
    path = Path(path)
    return shard_of(read_bytes(path, MOST_SHARD_BYTES, DataError), path)


def shard_of(
    content: bytes, path: Path, first_index: int | None = None, known: bool = False
) -> Dataset:
    """Dataset of the shard whose file has this content; arguments as for `opened_shard`."""
    with opened_shard(content, path, first_index, known) as shard:
        return shard.dataset()


@contextmanager
def opened_shard(
    content: bytes, path: Path, first_index: int | None = None, known: bool = False
) -> "Iterator[OpenShard]":
    """Open shard whose file has this content.

    Args:
        content: of the file.
        path: of the file, for messages.
        first_index: expected number of the first frame within the whole dataset, where known.
        known: whether the content does no harm to HDF5. Else it is read in a child first, which
            damage may end or keep busy; what a child has read can be read here.

    Raises DataError for any violation of the format.
    """
    with _as_data_errors(path):
        image, _ = unsealed(content)
        if not known:
            limits = Limits(  # ten times of what most take
                SECONDS + len(image) // _BYTES_PER_SECOND, _MEMORY + _MEMORY_PER_BYTE * len(image)
            )
            for _ in contained(f"{__name__}:try_shard", None, image, limits):
                pass
        file = _opened(image)
        try:
            yield OpenShard(file, first_index)
        finally:
            file.close()


def try_shard(argument: None, content: bytes) -> Iterator[Answer]:  # noqa: ARG001
    """Read every array of a shard, as a reader for `contained`; raises what that raises."""
    with _as_data_errors():
        file = _opened(content)
        OpenShard(file, None).dataset()
        file.close()
    return iter(())


def _opened(image: bytes) -> h5py.h5f.FileID:
    """Open HDF5 file; raises DataError for what is none, where HDF5 itself names no reason."""
    try:
        return h5py.h5f.open_file_image(image)
    except (OSError, RuntimeError, ValueError) as error:
        raise DataError(
            "this is not a whole shard of an eitskin dataset: it is no HDF5 file, or a damaged one;"
            " make or copy it again"
        ) from error


class OpenShard:
    """Shard whose file is open: its arrays are checked when they are read."""

    def __init__(self, file: h5py.h5f.FileID, first_index: int | None) -> None:
        """Check format, version and number of the first frame; raises DataError."""
        self._file = file
        self._version = _checked_version(file)
        self._first, self._count = (int(_attribute(file, n)) for n in ("first_index", "count"))
        if not 0 <= self._count <= LIMITS["frame"]:
            raise DataError(f"expected at most {LIMITS['frame']} frames, got {self._count}")
        if first_index is not None and self._first != first_index:
            raise DataError(f"expected frames from {first_index} on, got {self._first}")

    def dataset(self) -> Dataset:
        """The whole shard, in which every array of the file is checked."""
        stored = dict(all_arrays(self._root))
        if sum(array.get_storage_size() for array in stored.values()) > self._file.get_filesize():
            raise DataError("its arrays claim more than the file holds; it is damaged")
        columns = self._columns(stored, stored["impedance"].shape[-1], _NAMES)
        return Dataset(**(self._origin(stored.get("protocol")) | columns))

    def origin(self) -> SimpleNamespace:
        """Attributes of `Dataset` that all shards of a dataset share."""
        channels = one_array(self._root, "impedance").shape[-1]
        protocol = one_array(self._root, "protocol", required=False)
        return SimpleNamespace(channels=channels, **self._origin(protocol))

    def columns(self, frames: int, channels: int, names: Collection[str]) -> Columns:
        """Some columns; arrays of the file that these do not need are not looked at.

        Args:
            frames: expected number of frames.
            channels: expected number of channels.
            names: attributes of `Dataset`. Values that are checked together must be named together:
                both coordinates of touches, and `specimen` with `reference`.

        Raises DataError for any violation of the format in these columns.
        """
        if self._count != frames:
            raise DataError(f"must hold {frames} frames, got {self._count}")
        wanted = (field for field in FIELDS if field.name in names)
        found = {
            field.path: one_array(self._root, field.path, required=self._holds(field))
            for field in wanted
        }
        stored = {path: array for path, array in found.items() if array is not None}
        columns = self._columns(stored, channels, names)
        check_values(columns)
        return columns

    def _holds(self, field: Field) -> bool:
        """Whether a file of this version must hold the array."""
        return field.since is not None and field.since <= self._version

    @property
    def _root(self) -> h5py.h5g.GroupID:
        return h5py.h5g.open(self._file, b"/")

    def _origin(self, protocol: h5py.h5d.DatasetID | None) -> dict[str, Any]:
        recipe, design, digest, source = (
            str(_attribute(self._file, name))
            for name in ("recipe", "design", "recipe_sha256", "source")
        )
        if hashlib.sha256(recipe.encode()).hexdigest() != digest:
            raise DataError("the recipe and its checksum disagree; make or copy the file again")
        return {
            "protocol": None if protocol is None else _read_protocol(protocol),
            "frequency": float(_attribute(self._file, "frequency")),
            "source": source,
            "recipe": recipe,
            "seed": int(_attribute(self._file, "seed")),
            "design": _read_design(design) if design else None,
            "quantity": known_quantity(str(_attribute(self._file, "quantity", "")), source),
        }

    def _columns(self, stored: Mapping[str, Any], channels: int, names: Collection[str]) -> Columns:
        """Columns of the arrays `stored`, with the values that older files leave out."""
        sizes = {"frame": self._count, "touch": MAX_TOUCHES, "channel": channels}
        if "reference" in stored:
            sizes["specimen"] = stored["reference"].shape[0]
        arrays: Columns = {}
        for field in (field for field in FIELDS if field.name in names):
            if field.path in stored or self._holds(field):
                arrays[field.name] = _values(stored[field.path], field, sizes)
            elif field.since is None:
                shape = tuple(sizes[axis] for axis in field.axes)
                arrays[field.name] = np.full(shape, field.missing, field.dtype)
        # Older files have no numbers of frames, and all specimens of the dataset: counts within the
        # dataset take the place of the numbers.
        first = self._first
        if "number" in names:
            arrays.setdefault("number", np.arange(first, first + self._count))
        if "specimen_number" in names:
            arrays.setdefault("specimen_number", np.arange(sizes["specimen"]))
        return arrays


@contextmanager
def _as_data_errors(path: Path | None = None) -> Iterator[None]:
    """Raise all errors of reading a file as DataError that begins with its name, if given."""
    name = "" if path is None else f"{path}: "
    try:
        yield
    except DataError as error:
        raise DataError(f"{name}{error}") from error
    except (OSError, KeyError, ValueError, TypeError, RuntimeError, AttributeError) as error:
        raise DataError(
            f"{name}this is not a whole shard of an eitskin dataset: {error}; make or copy it again"
        ) from error


def _checked_version(file: h5py.h5f.FileID) -> int:
    """Format version of a file; raises DataError for other formats and newer versions."""
    found = _attribute(file, "format", "") or None
    if found != FORMAT:
        raise DataError(
            f"expected format '{FORMAT}', got {quoted(found)}; this is another kind of file"
        )
    version = int(_attribute(file, "format_version"))
    if version > FORMAT_VERSION:
        raise DataError(
            f"format version {version} is newer than {FORMAT_VERSION}, the last that this eitskin "
            "reads; upgrade with pip install --upgrade eitskin"
        )
    if version < 1:
        raise DataError(
            f"expected format version 1 to {FORMAT_VERSION}, got {version}, which no eitskin has "
            "written; generate or copy it again"
        )
    return version


def _attribute(place: Any, name: str, default: Any = None) -> Any:
    """Attribute of a file or array: one number, or text; errors where it is missing or longer."""
    if default is not None and not h5py.h5a.exists(place, name.encode()):
        return default
    stored = h5py.h5a.open(place, name.encode())
    if math.prod(stored.shape) != 1 or stored.dtype.itemsize > MOST_TEXT:
        raise DataError(f"attribute '{name}' must be one number or text; it is damaged")
    values = np.empty(stored.shape, stored.dtype)
    stored.read(values)
    value = values.item()
    return value.decode() if isinstance(value, bytes) else value


def _values(stored: h5py.h5d.DatasetID, field: Field, sizes: Mapping[str, int]) -> NDArray[Any]:
    """One array, read after checks of the shape and type that the file states."""
    expected = tuple(sizes[axis] for axis in field.axes)
    if stored.shape != expected:
        raise DataError(f"'{field.path}' must have shape {expected}, got {stored.shape}")
    kind = stored.get_type()
    enumerated = isinstance(kind, h5py.h5t.TypeEnumID)
    # Not by numpy's type alone, which leaves out how the bits of a number are laid out.
    if (kind.get_super() if enumerated else kind) != _TYPES[field.name]:
        raise DataError(f"'{field.path}' must hold {field.dtype.name}, got {kind.dtype}")
    too_large = any(sizes[axis] > LIMITS[axis] for axis in field.axes)
    if too_large or math.prod(expected) > MAX_VALUES:
        raise DataError(f"'{field.path}' claims {expected} values, above the format's limits")
    values: NDArray[Any] = np.empty(expected, field.dtype)
    memory = kind if enumerated else _TYPES[field.name]
    stored.read(h5py.h5s.ALL, h5py.h5s.ALL, values, memory)
    return values


@lru_cache(maxsize=8)
def _read_design(text: str) -> SensorDesign:
    """Sensor design of a shard; cached, since all shards of a dataset hold the same."""
    return parse_toml(SensorDesign, text, "attribute 'design'")


def _read_protocol(stored: h5py.h5d.DatasetID) -> Protocol:
    shape = stored.shape
    if len(shape) != 2 or shape[1] != 4 or shape[0] > LIMITS["channel"]:
        raise DataError(f"'protocol' must have shape (channels, 4), got {shape}")
    if stored.dtype != np.dtype("<i2"):
        raise DataError(f"'protocol' must hold int16, got {stored.dtype}")
    rows = np.empty(shape, "<i2")
    stored.read(h5py.h5s.ALL, h5py.h5s.ALL, rows)
    return _protocol(rows.tobytes(), int(_attribute(stored, "n_electrodes")))


@lru_cache(maxsize=8)
def _protocol(rows: bytes, n_electrodes: int) -> Protocol:
    """Protocol of a shard; cached, since all shards of a dataset hold the same."""
    return Protocol.from_rows(np.frombuffer(rows, dtype="<i2").reshape(-1, 4), n_electrodes)
