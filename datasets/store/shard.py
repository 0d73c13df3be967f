"""Shards: HDF5 files of a dataset, built in memory, sealed, and written atomically.

`shard_reader` reads them. A seal is a SHA-256 of everything before it, in a line at the end of the
file. HDF5 checks the values of arrays and not its own tables, where a flipped bit may turn values
into zeros, keep a reader busy for ever or end the process. A seal is compared before HDF5 looks at
the file. HDF5 passes over what follows the end that it has noted, and a program that changes the
file cuts the seal off, so that a file without one is old or was changed on purpose.
"""

import hashlib
import json
import re
import struct
import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from eitskin.datasets.store.dataset import Dataset
from eitskin.datasets.store.manifest import ShardEntry
from eitskin.datasets.store.schema import (
    ENGINE,
    FIELDS,
    FORMAT,
    FORMAT_VERSION,
    FRAME_FIELDS,
    UNKNOWN_STATE,
    State,
)
from eitskin.errors import DataError
from eitskin.files import write_file
from eitskin.provenance import package_versions

CHUNK_FRAMES = 1024
PACKAGES = ("eitskin", "h5py", "numpy", "scikit-fem", "scipy")
"""Packages that influence the numbers in a dataset."""

# Not lzf: the hash table of h5py's lzf is uninitialised, so equal data give different bytes.
STORAGE = {"compression": "gzip", "compression_opts": 4, "shuffle": True, "fletcher32": True}
_SEAL = re.compile(rb"\neitskin seal 1 sha256 ([0-9a-f]{64})\n")
_LENGTH = len("\neitskin seal 1 sha256 \n") + 64
_SUPERBLOCK = b"\x89HDF\r\n\x1a\n\x00"  # of version 0, which h5py writes; then sizes, and addresses
_END = struct.Struct("<40xQ")
STATES = {**{state.name.lower(): state.value for state in State}, "unknown": UNKNOWN_STATE}


def shard_name(index: int) -> str:
    """File name of shard `index` within its folder."""
    return f"shard-{index:06d}.h5"


def write_shard(path: Path, data: Dataset, first_index: int = 0) -> None:
    """Write `data` as one shard; equal data give equal bytes.

    Only specimens that occur in the frames are written.

    Args:
        path: path of the file; an existing one is replaced atomically.
        data: frames of the shard.
        first_index: number of its first frame within the whole dataset.

    Raises PartialError where the file cannot be written.

    Example:
        >>> import numpy as np
        >>> from pathlib import Path
        >>> from eitskin.datasets import Dataset, read_shard, write_shard
        >>> write_shard(Path("written.h5"), Dataset.from_arrays(np.full((4, 28), 600.0)))
        >>> read_shard("written.h5").impedance.shape
        (4, 28)
    """
    write_file(Path(path), shard_bytes(data, first_index))


def write_entry(
    folder: Path,
    number: int,
    data: Dataset,
    first_index: int,
    write: Callable[[Path, bytes], object] = write_file,
) -> ShardEntry:
    """Write shard `number` of a dataset into `folder`; returns its entry in the manifest."""
    content, name = shard_bytes(data, first_index), shard_name(number)
    write(folder / name, content)
    return ShardEntry(name, first_index, len(data), hashlib.sha256(content).hexdigest())


def shard_bytes(data: Dataset, first_index: int = 0) -> bytes:
    """Content of a shard's file, see `write_shard`; equal data give equal bytes."""
    data = data.own_specimens()
    # HDF5 refuses two open files of one name, even in memory, as threads would open them.
    name = f"shard-{threading.get_ident()}"
    with h5py.File(name, "w", driver="core", backing_store=False) as file:
        file.attrs.update(_root_attributes(data, first_index))
        for field in FIELDS:
            values = getattr(data, field.name)
            if field.since is not None or not np.isnan(values).all():
                is_state = field.name == "state"
                dtype = h5py.enum_dtype(STATES, basetype="u1") if is_state else field.dtype
                about: dict[str, Any] = {"units": field.units, "description": field.description}
                _write_array(file, field.path, values, field.axes, dtype, about)
        if data.protocol is not None:
            about = {
                "n_electrodes": data.protocol.n_electrodes,
                "units": "1",
                "description": "drive+, drive-, sense+, sense- of a channel",
            }
            table = np.array(data.protocol.table, dtype="<i2")
            _write_array(file, "protocol", table, ("channel", "electrode"), table.dtype, about)
        file["time"].make_scale("time")  # the dimension scale of every frame axis
        for field in FRAME_FIELDS:
            if field.name != "time" and field.path in file:
                file[field.path].dims[0].attach_scale(file["time"])
        file.flush()
        image: bytes = file.id.get_file_image()
    return append_checksum(image)


def _root_attributes(data: Dataset, first_index: int) -> dict[str, Any]:
    return {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "source": data.source,
        "recipe": data.recipe,
        "recipe_sha256": hashlib.sha256(data.recipe.encode()).hexdigest(),
        "seed": data.seed,
        "first_index": first_index,
        "count": len(data),
        "frequency": data.frequency,
        "quantity": data.quantity,
        "design": data.design.to_toml() if data.design else "",
        "engine": ENGINE,
        "packages": json.dumps(package_versions(PACKAGES), sort_keys=True),
    }


def _write_array(
    file: h5py.File,
    path: str,
    values: NDArray[Any],
    axes: tuple[str, ...],
    dtype: np.dtype[Any],
    about: Mapping[str, Any],
) -> None:
    chunks = (max(1, min(len(values), CHUNK_FRAMES)), *values.shape[1:])
    dataset = file.create_dataset(path, data=values, dtype=dtype, chunks=chunks, **STORAGE)
    # Without the flush, chunks are written when the last reference is released, which a profiler
    # may hold: another order, other bytes.
    dataset.flush()
    for axis, name in enumerate(axes):
        dataset.dims[axis].label = name
    dataset.attrs.update(about)


def append_checksum(image: bytes) -> bytes:
    """Content of a file: an HDF5 file and its seal."""
    return image + b"\neitskin seal 1 sha256 " + hashlib.sha256(image).hexdigest().encode() + b"\n"


def verify_checksum(content: bytes) -> tuple[bytes, bool]:
    """HDF5 file of a content, and whether it was sealed; raises DataError for a broken seal."""
    image, tail = content[:-_LENGTH], content[-_LENGTH:]
    if match := _SEAL.fullmatch(tail):
        if hashlib.sha256(image).hexdigest() != match[1].decode():
            raise DataError(
                "this is not a whole shard: its content is not the one that was sealed; make or "
                "copy it again"
            )
        return image, True
    if content.startswith(_SUPERBLOCK) and len(content) > _END.size:
        (end,) = _END.unpack_from(content)
        if len(content) > end:
            raise DataError(
                f"this is not a whole shard: expected its end or a whole seal after {end} bytes, "
                f"got {len(content) - end} other bytes; make or copy it again"
            )
    return content, False
