"""Shards: HDF5 files of a dataset, built in memory, written atomically, checked when read."""

import hashlib
import json
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import cache, lru_cache
from importlib import metadata
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from eitskin.config import parse_toml
from eitskin.datasets.store.dataset import Dataset
from eitskin.datasets.store.schema import (
    FIELDS,
    FORMAT,
    FORMAT_VERSION,
    LIMITS,
    MAX_TOUCHES,
    MAX_VALUES,
    Field,
)
from eitskin.datasets.store.state import UNKNOWN_STATE, State
from eitskin.errors import DataError
from eitskin.files import write_file
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.protocol import Protocol

CHUNK_FRAMES = 1024
# Not lzf: the hash table of h5py's lzf is uninitialised, so equal data give different bytes.
STORAGE = {"compression": "gzip", "compression_opts": 4, "shuffle": True, "fletcher32": True}
STATES = {**{state.name.lower(): state.value for state in State}, "unknown": UNKNOWN_STATE}


def shard_name(index: int) -> str:
    """File name of shard `index` within its folder."""
    return f"shard-{index:06d}.h5"


def write_shard(path: Path, data: Dataset, first_index: int = 0) -> None:
    """Write `data` as one shard; equal data give equal bytes.

    Only specimens that occur in the frames are written.

    Args:
        path: of the file; an existing one is replaced atomically.
        data: frames of the shard.
        first_index: number of its first frame within the whole dataset.

    Raises PartialError where the file cannot be written.
    """
    write_file(Path(path), shard_bytes(data, first_index))


def read_shard(path: Path, first_index: int | None = None) -> Dataset:
    """Dataset of one shard, checked.

    Args:
        path: of the file.
        first_index: expected number of the first frame within the whole dataset, where known.

    Raises DataError for any violation of the format.
    """
    path = Path(path)
    with _as_data_errors(path), h5py.File(path, "r") as file:
        return _checked(file, first_index)


def shard_of(content: bytes, path: Path, first_index: int | None = None) -> Dataset:
    """Dataset of the shard whose file has this content; `path` and errors as for `read_shard`."""
    with _as_data_errors(path), h5py.File(h5py.h5f.open_file_image(content)) as file:
        return _checked(file, first_index)


@contextmanager
def _as_data_errors(path: Path) -> Iterator[None]:
    """Raise all errors of reading a file as DataError."""
    try:
        yield
    except DataError as error:
        raise DataError(f"{path}: {error}") from error
    except (OSError, KeyError, ValueError, TypeError, RuntimeError, AttributeError) as error:
        raise DataError(
            f"{path} is not a whole shard of an eitskin dataset: {error}; make or copy it again"
        ) from error


@cache
def package_versions() -> Mapping[str, str]:
    """Versions of the packages that influence the numbers in a dataset; cached."""
    versions = {}
    for package in ("eitskin", "h5py", "numpy", "scikit-fem", "scipy"):
        try:
            versions[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            versions[package] = "not installed"
    return versions


def shard_bytes(data: Dataset, first_index: int = 0) -> bytes:
    """Content of a shard's file, see `write_shard`; equal data give equal bytes."""
    data = data.own_specimens()
    # HDF5 refuses two open files of one name, even in memory, as threads would open them.
    name = f"shard-{threading.get_ident()}"
    with h5py.File(name, "w", driver="core", backing_store=False) as file:
        file.attrs.update(_root_attributes(data, first_index))
        for field in FIELDS:
            _write_field(file, field, getattr(data, field.name))
        if data.protocol is not None:
            table = np.array(data.protocol.table, dtype="<i2")
            _write_array(file, "protocol", table, ("channel", "electrode"))
            file["protocol"].attrs["n_electrodes"] = data.protocol.n_electrodes
            file["protocol"].attrs["units"] = "1"
            file["protocol"].attrs["description"] = "drive+, drive-, sense+, sense- of a channel"
        _attach_time(file)
        file.flush()
        image: bytes = file.id.get_file_image()
        return image


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
        "design": data.design.to_toml() if data.design else "",
        "packages": json.dumps(package_versions(), sort_keys=True),
    }


def _write_field(file: h5py.File, field: Field, values: NDArray[Any]) -> None:
    dtype = h5py.enum_dtype(STATES, basetype="u1") if field.name == "state" else field.dtype
    _write_array(file, field.path, values, field.axes, dtype)
    file[field.path].attrs["units"] = field.units
    file[field.path].attrs["description"] = field.description


def _write_array(
    file: h5py.File,
    path: str,
    values: NDArray[Any],
    axes: tuple[str, ...],
    dtype: np.dtype[Any] | None = None,
) -> None:
    chunks = (max(1, min(len(values), CHUNK_FRAMES)), *values.shape[1:])
    dataset = file.create_dataset(path, data=values, dtype=dtype, chunks=chunks, **STORAGE)
    # Without the flush, chunks are written when the last reference is released, which a profiler
    # may hold: another order, other bytes.
    dataset.flush()
    for axis, name in enumerate(axes):
        dataset.dims[axis].label = name


def _attach_time(file: h5py.File) -> None:
    """Attach `time` as the dimension scale of every frame axis."""
    file["time"].make_scale("time")
    for field in FIELDS:
        if field.axes[0] == "frame" and field.name != "time":
            file[field.path].dims[0].attach_scale(file["time"])


def _checked(file: h5py.File, first_index: int | None) -> Dataset:
    """Dataset of an open file; raises DataError for what the format does not allow."""
    _check_format(file)
    found = int(file.attrs["first_index"])
    if first_index is not None and found != first_index:
        raise DataError(f"expected frames from {first_index} on, got {found}")
    return _read(file, dict(_plain_arrays(file)))


def _check_format(file: h5py.File) -> None:
    """Raise DataError for other formats and newer versions."""
    found = file.attrs.get("format")
    if found != FORMAT:
        raise DataError(f"expected format '{FORMAT}', got {found!r}; this is another kind of file")
    version = int(file.attrs["format_version"])
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
    if not 0 <= int(file.attrs["count"]) <= LIMITS["frame"]:
        raise DataError(f"expected at most {LIMITS['frame']} frames, got {file.attrs['count']}")
    text = file.attrs["recipe"]
    if hashlib.sha256(text.encode()).hexdigest() != file.attrs["recipe_sha256"]:
        raise DataError("the recipe and its checksum disagree; make or copy the file again")


def _plain_arrays(group: h5py.Group, inside: str = "") -> Iterator[tuple[str, h5py.Dataset]]:
    """Arrays of a file by path; raises DataError for links, data elsewhere, foreign filters."""
    for name in group:
        if group.id.links.get_info(name.encode()).type != h5py.h5l.TYPE_HARD:
            raise DataError(f"'{name}' is a soft or external link, and only plain data are read")
        item = group[name]
        if isinstance(item, h5py.Group) and not inside:
            yield from _plain_arrays(item, f"{name}/")
        elif not isinstance(item, h5py.Dataset) or item.is_virtual or item.external:
            raise DataError(f"'{name}' is nested, virtual or elsewhere; only plain data are read")
        else:
            _check_filters(item)
            yield inside + name, item


def _check_filters(dataset: h5py.Dataset) -> None:
    known = {h5py.h5z.FILTER_DEFLATE, h5py.h5z.FILTER_SHUFFLE, h5py.h5z.FILTER_FLETCHER32}
    known.add(h5py.h5z.FILTER_LZF)
    properties = dataset.id.get_create_plist()
    for number in range(properties.get_nfilters()):
        code = properties.get_filter(number)[0]
        if code not in known:
            raise DataError(f"'{dataset.name}' uses filter {code}; expected gzip or lzf")


def _read(file: h5py.File, stored: Mapping[str, h5py.Dataset]) -> Dataset:
    version = int(file.attrs["format_version"])
    sizes = {"frame": int(file.attrs["count"]), "touch": MAX_TOUCHES}
    sizes["channel"] = stored["impedance"].shape[-1]
    sizes["specimen"] = stored["reference"].shape[0]
    arrays = {
        field.name: _read_field(stored[field.path], field, sizes)
        for field in FIELDS
        if field.path in stored or field.since <= version
    }
    # Older files have no numbers of frames, and all specimens of the dataset: counts within the
    # dataset take the place of the numbers.
    first = int(file.attrs["first_index"])
    arrays.setdefault("number", np.arange(first, first + sizes["frame"]))
    arrays.setdefault("specimen_number", np.arange(sizes["specimen"]))
    design = file.attrs["design"]
    return Dataset(
        **arrays,
        protocol=_read_protocol(stored["protocol"]) if "protocol" in stored else None,
        frequency=float(file.attrs["frequency"]),
        source=str(file.attrs["source"]),
        recipe=str(file.attrs["recipe"]),
        seed=int(file.attrs["seed"]),
        design=_read_design(design) if design else None,
    )


@lru_cache(maxsize=8)
def _read_design(text: str) -> SensorDesign:
    """Sensor design of a shard; cached, since all shards of a dataset hold the same."""
    return parse_toml(SensorDesign, text, "attribute 'design'")


def _read_field(stored: h5py.Dataset, field: Field, sizes: Mapping[str, int]) -> NDArray[Any]:
    """One array, read after checks of the shape and type that the file states."""
    expected = tuple(sizes[axis] for axis in field.axes)
    if stored.shape != expected:
        raise DataError(f"'{field.path}' must have shape {expected}, got {stored.shape}")
    if stored.dtype != field.dtype:
        raise DataError(f"'{field.path}' must hold {field.dtype.name}, got {stored.dtype}")
    if any(sizes[axis] > LIMITS[axis] for axis in field.axes) or stored.size > MAX_VALUES:
        raise DataError(f"'{field.path}' claims {expected} values, above the format's limits")
    values: NDArray[Any] = stored[()]
    return values


def _read_protocol(stored: h5py.Dataset) -> Protocol:
    if stored.ndim != 2 or stored.shape[1] != 4 or stored.shape[0] > LIMITS["channel"]:
        raise DataError(f"'protocol' must have shape (channels, 4), got {stored.shape}")
    if stored.dtype != np.dtype("<i2"):
        raise DataError(f"'protocol' must hold int16, got {stored.dtype}")
    return _protocol(stored[()].tobytes(), int(stored.attrs["n_electrodes"]))


@lru_cache(maxsize=8)
def _protocol(rows: bytes, n_electrodes: int) -> Protocol:
    """Protocol of a shard; cached, since all shards of a dataset hold the same."""
    return Protocol.from_rows(np.frombuffer(rows, dtype="<i2").reshape(-1, 4), n_electrodes)
