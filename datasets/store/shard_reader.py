"""Reading of shards: datasets of HDF5 files that are checked as they are read.

h5py's low-level interface is used throughout: it opens and checks the arrays of a small file in
half the time of the high-level one.
"""

import hashlib
import itertools
import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from eitskin.config import parse_toml
from eitskin.datasets.store.dataset import Dataset
from eitskin.datasets.store.schema import (
    FIELDS,
    LIMITS,
    MAX_SHARD_BYTES,
    MAX_TOUCHES,
    MAX_VALUES,
    Field,
    require_format,
)
from eitskin.datasets.store.shard import verify_checksum
from eitskin.errors import DataError
from eitskin.files import MAX_TEXT, read_bytes
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.protocol import Protocol
from eitskin.reader_process import Answer, Limits, read_in_subprocess

SECONDS = 5
"""Processor time for the smallest of shards of unknown origin [s]."""

_BYTES_PER_SECOND = 2 << 20
_MEMORY, _MEMORY_PER_BYTE = 400 << 20, 24  # [bytes]

_TYPES = {field.name: h5py.h5t.py_create(field.dtype, logical=True) for field in FIELDS}


def read_shard(path: str | Path) -> Dataset:
    """Dataset of one shard, checked; raises DataError for any violation of the format.

    Example:
        >>> import numpy as np
        >>> from pathlib import Path
        >>> from eitskin.datasets import Dataset, read_shard, write_shard
        >>> write_shard(Path("one.h5"), Dataset.from_arrays(np.full((4, 28), 600.0)))
        >>> len(read_shard("one.h5"))
        4
    """
    path = Path(path)
    return parse_shard(read_bytes(path, MAX_SHARD_BYTES, DataError), path)


def read_engine(path: Path) -> int:
    """Number of the simulation that made a sound shard; 1 where none is stored, 0 for no number."""
    with h5py.File(path) as file:
        engine = file.attrs.get("engine", 1)
    return int(engine) if np.ndim(engine) == 0 and engine in range(1, 1 << 16) else 0


def parse_shard(
    content: bytes, path: Path, first_index: int | None = None, known: bool = False
) -> Dataset:
    """Dataset of the shard at `path` whose file has this content.

    Where the number of its first frame within the whole dataset is known, it is compared. Content
    that is `known` does no harm to HDF5. Else it is read in a child first, which damage may end or
    keep busy; what a child has read can be read here. Raises DataError for any violation of the
    format.
    """
    with _as_data_errors(path):
        image, _ = verify_checksum(content)
        if not known:
            limits = Limits(  # ten times of what most take
                SECONDS + len(image) // _BYTES_PER_SECOND, _MEMORY + _MEMORY_PER_BYTE * len(image)
            )
            for _ in read_in_subprocess(f"{__name__}:try_shard", None, image, limits):
                pass
        return _read(image, first_index)


def try_shard(argument: None, content: bytes) -> Iterator[Answer]:  # noqa: ARG001
    """Read every array of a shard, for `read_in_subprocess`, whose errors it raises."""
    with _as_data_errors():
        _read(content)
    return iter(())


def _read(image: bytes, first_index: int | None = None) -> Dataset:
    """Dataset of an HDF5 file, in which every array is checked."""
    try:
        file = h5py.h5f.open_file_image(image)
    except (OSError, RuntimeError, ValueError) as error:  # HDF5 itself names no reason
        raise DataError(
            "this is not a whole shard of an eitskin dataset: it is no HDF5 file, or a damaged one;"
            " make or copy it again"
        ) from error
    try:
        version = require_format(
            _attribute(file, "format", "") or None, _attribute(file, "format_version", 0)
        )
        _attribute(file, "engine", 1)  # which `read_engine` reads in this process
        first, count = (int(_attribute(file, name)) for name in ("first_index", "count"))
        if not 0 <= count <= LIMITS["frame"]:
            raise DataError(f"expected at most {LIMITS['frame']} frames, got {count}")
        if first_index is not None and first != first_index:
            raise DataError(f"expected frames from {first_index} on, got {first}")
        stored = dict(all_arrays(h5py.h5g.open(file, b"/")))
        if sum(array.get_storage_size() for array in stored.values()) > file.get_filesize():
            raise DataError("its arrays claim more than the file holds; it is damaged")
        columns = _read_columns(stored, version, first, count)
        return Dataset(**(_read_origin(file, stored.get("protocol")) | columns))
    finally:
        file.close()


def _read_origin(file: h5py.h5f.FileID, protocol: h5py.h5d.DatasetID | None) -> dict[str, Any]:
    """Attributes of `Dataset` that all shards of a dataset share."""
    recipe, design, digest, source = (
        str(_attribute(file, name)) for name in ("recipe", "design", "recipe_sha256", "source")
    )
    if hashlib.sha256(recipe.encode()).hexdigest() != digest:
        raise DataError("the recipe and its checksum disagree; make or copy the file again")
    return {
        "protocol": None if protocol is None else _read_protocol(protocol),
        "frequency": float(_attribute(file, "frequency")),
        "source": source,
        "recipe": recipe,
        "seed": int(_attribute(file, "seed")),
        "design": _read_design(design) if design else None,
        "quantity": str(_attribute(file, "quantity", "")),
    }


def _read_columns(
    group: Mapping[str, Any], version: int, first: int, count: int
) -> dict[str, NDArray[Any]]:
    """Columns by name; those that a file of this version need not hold only where it does."""
    sizes = {"frame": count, "touch": MAX_TOUCHES, "channel": group["impedance"].shape[-1]}
    sizes["specimen"] = group["reference"].shape[0]
    columns = {
        field.name: _values(group[field.path], field, sizes)
        for field in FIELDS
        if field.path in group or (field.since is not None and field.since <= version)
    }
    # Older files have no numbers of frames: counts within the dataset take their place.
    columns.setdefault("number", np.arange(first, first + count))
    return columns


@contextmanager
def _as_data_errors(path: Path | None = None) -> Iterator[None]:
    """Raise all errors of reading a file as DataError that begins with its name, if given."""
    name = "" if path is None else f"{path}: "
    try:
        yield
    except DataError as error:
        raise DataError(f"{name}{error}") from error
    except (
        OSError,
        LookupError,
        ValueError,
        TypeError,
        RuntimeError,
        AttributeError,
        ArithmeticError,
    ) as error:
        raise DataError(
            f"{name}this is not a whole shard of an eitskin dataset: {error}; make or copy it again"
        ) from error


def _attribute(place: Any, name: str, default: Any = None) -> Any:
    """Attribute of a file or array: one number, or text; errors where it is missing or longer."""
    if default is not None and not h5py.h5a.exists(place, name.encode()):
        return default
    stored = h5py.h5a.open(place, name.encode())
    if math.prod(stored.shape) != 1 or stored.dtype.itemsize > MAX_TEXT:
        raise DataError(f"attribute '{name}' must be one number or text; it is damaged")
    values = np.empty(stored.shape, stored.dtype)
    stored.read(values)
    value = values.item()
    return value.decode() if isinstance(value, bytes) else value


def _values(dataset_id: h5py.h5d.DatasetID, field: Field, sizes: Mapping[str, int]) -> NDArray[Any]:
    """One array, read after checks of the shape and type that the file states."""
    expected = tuple(sizes[axis] for axis in field.axes)
    if dataset_id.shape != expected:
        raise DataError(f"'{field.path}' must have shape {expected}, got {dataset_id.shape}")
    kind = dataset_id.get_type()
    enumerated = isinstance(kind, h5py.h5t.TypeEnumID)
    # Not by numpy's type alone, which leaves out how the bits of a number are laid out.
    if (kind.get_super() if enumerated else kind) != _TYPES[field.name]:
        raise DataError(f"'{field.path}' must hold {field.dtype.name}, got {kind.dtype}")
    too_large = any(sizes[axis] > LIMITS[axis] for axis in field.axes)
    if too_large or math.prod(expected) > MAX_VALUES:
        raise DataError(f"'{field.path}' claims {expected} values, above the format's limits")
    values: NDArray[Any] = np.empty(expected, field.dtype)
    memory = kind if enumerated else _TYPES[field.name]
    dataset_id.read(h5py.h5s.ALL, h5py.h5s.ALL, values, memory)
    return values


@lru_cache(maxsize=8)
def _read_design(text: str) -> SensorDesign:
    """Sensor design of a shard; cached, since all shards of a dataset hold the same."""
    return parse_toml(SensorDesign, text, "attribute 'design'")


def _read_protocol(dataset_id: h5py.h5d.DatasetID) -> Protocol:
    shape = dataset_id.shape
    if len(shape) != 2 or shape[1] != 4 or shape[0] > LIMITS["channel"]:
        raise DataError(f"'protocol' must have shape (channels, 4), got {shape}")
    if dataset_id.dtype != np.dtype("<i2"):
        raise DataError(f"'protocol' must hold int16, got {dataset_id.dtype}")
    rows = np.empty(shape, "<i2")
    dataset_id.read(h5py.h5s.ALL, h5py.h5s.ALL, rows)
    return _protocol(rows.tobytes(), int(_attribute(dataset_id, "n_electrodes")))


@lru_cache(maxsize=8)
def _protocol(rows: bytes, n_electrodes: int) -> Protocol:
    """Protocol of a shard; cached, since all shards of a dataset hold the same."""
    return Protocol.from_rows(np.frombuffer(rows, dtype="<i2").reshape(-1, 4), n_electrodes)


_MAX_EXPANSION = 1100  # deflate makes at most 1,032 bytes of one
_FILTERS = {
    h5py.h5z.FILTER_DEFLATE,
    h5py.h5z.FILTER_SHUFFLE,
    h5py.h5z.FILTER_FLETCHER32,
    h5py.h5z.FILTER_LZF,
}


def all_arrays(group: h5py.h5g.GroupID, inside: str = "") -> Iterator[tuple[str, Any]]:
    """Arrays of a file by path; raises DataError for links, data elsewhere, foreign filters."""
    for raw in group:
        item, name = _plain(group, raw), raw.decode()
        if not isinstance(item, h5py.h5g.GroupID):
            _check_chunks(item, inside + name)
            yield inside + name, item
        elif inside:
            raise DataError(f"'{name}' is nested, virtual or elsewhere; only plain data are read")
        else:
            yield from all_arrays(item, f"{name}/")


def _plain(group: h5py.h5g.GroupID, name: bytes) -> Any:
    """Group or array whose values lie in the file itself, behind known filters."""
    if group.links.get_info(name).type != h5py.h5l.TYPE_HARD:
        raise DataError(
            f"'{name.decode()}' is a soft or external link, and only plain data are read"
        )
    item = h5py.h5o.open(group, name)
    if isinstance(item, h5py.h5g.GroupID):
        return item
    properties = item.get_create_plist() if isinstance(item, h5py.h5d.DatasetID) else None
    if (
        properties is None
        or properties.get_layout() == h5py.h5d.VIRTUAL
        or properties.get_external_count()
    ):
        raise DataError(
            f"'{name.decode()}' is nested, virtual or elsewhere; only plain data are read"
        )
    _check_claims(item, properties, name.decode())
    return item


def _check_claims(array: h5py.h5d.DatasetID, properties: Any, name: str) -> None:
    """Raise DataError for filters and sizes that a file of this format never has.

    HDF5 asks for the memory of a whole chunk, and fills arrays without chunks with one value: a
    file of a few kilobytes could claim gigabytes.
    """
    codes = [properties.get_filter(number)[0] for number in range(properties.get_nfilters())]
    for code in codes:
        if code not in _FILTERS:
            raise DataError(f"'{name}' uses filter {code}; expected gzip or lzf")
    if len(set(codes)) < len(codes):
        raise DataError(f"'{name}' uses a filter twice; expected gzip or lzf once")
    shape = array.shape
    if properties.get_layout() == h5py.h5d.CHUNKED and any(
        step > max(size, 1) for step, size in zip(properties.get_chunk(), shape, strict=True)
    ):
        raise DataError(f"'{name}' has chunks larger than itself; it is damaged")
    require_stored(array, name)


def require_stored(array: h5py.h5d.DatasetID, name: str) -> None:
    """Raise DataError for an array that claims more than any compression leaves of it."""
    claimed = math.prod(array.shape) * array.get_type().get_size()
    if claimed > _MAX_EXPANSION * array.get_storage_size():
        raise DataError(
            f"'{name}' claims {claimed} bytes and stores {array.get_storage_size()}, fewer than "
            "any compression leaves; it is damaged"
        )


def _check_chunks(array: h5py.h5d.DatasetID, path: str) -> None:
    """Raise DataError where a flipped bit of the file's tables would change values unnoticed.

    Tables have no checksum. Where the list of filters is lost, or a chunk is marked as one to which
    some were not applied, compressed bytes would pass for values; where a chunk is listed at
    another place, values would be missing.
    """
    properties = array.get_create_plist()
    if properties.get_layout() != h5py.h5d.CHUNKED:
        return
    chunks: list[Any] = []
    array.chunk_iter(chunks.append)
    shape = properties.get_chunk()
    grid = [range(0, size, step) for size, step in zip(array.shape, shape, strict=True)]
    complete = len(chunks) == math.prod(map(len, grid)) and {
        chunk.chunk_offset for chunk in chunks
    } == set(itertools.product(*grid))
    size = math.prod(shape) * array.get_type().get_size()
    raw = not properties.get_nfilters()
    sound = all(not chunk.filter_mask and (not raw or chunk.size == size) for chunk in chunks)
    if chunks and not (complete and sound):
        raise DataError(f"'{path}' is stored in other chunks than its filters make; it is damaged")
