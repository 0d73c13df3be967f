"""Frames of a dataset as Arrow tables and Parquet files, and their splits by specimen."""

import hashlib
import itertools
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eitskin.datasets.store.dataset import Dataset
from eitskin.datasets.store.manifest import Names
from eitskin.datasets.store.schema import CLAMP_FIELDS, FIELDS, State
from eitskin.extras import require

SPLITS = ("train", "validation", "test")
_SHARES = (0.8, 0.1, 0.1)


def specimen_splits(numbers: Iterable[int], names: Names, seed: int) -> dict[int, str]:
    """Split of each specimen, by its number within the dataset.

    A specimen's split follows from SHA-256 of its name where it has one, else of the dataset's seed
    and its number, so that one sensor stays in one split whatever else is recorded or drawn. About
    80 % are in `train`, 10 % in each other. Where `train` would be empty, as it may be for one or
    two specimens, all are in `train`.
    """
    splits = {n: parse_split(names.specimens.get(n, f"{seed}:{n}")) for n in numbers}
    if SPLITS[0] not in splits.values():
        return dict.fromkeys(splits, SPLITS[0])
    return splits


def parse_split(key: str) -> str:
    """Split that the text `key` stands for."""
    digest = hashlib.sha256(f"eitskin split 1: {key}".encode()).digest()
    place = int.from_bytes(digest[:8], "big") / 2.0**64
    if place < _SHARES[0]:
        return SPLITS[0]
    return SPLITS[1] if place < _SHARES[0] + _SHARES[1] else SPLITS[2]


TOUCH_FIELDS = ("x", "y", "force", "radius", "depth")
METADATA = b"eitskin"
"""Key of the schema's metadata: JSON of what is not stated of single frames."""

FILE_BYTES = 1 << 28
"""Size in memory of the rows of one file [bytes]."""
GROUP_BYTES = 1 << 25
"""Size in memory of a group of rows [bytes]."""

_LENGTHS = [field.name for field in FIELDS if field.units == "m"]
_UNITS = {"impedance": "ohm", "magnitude": "ohm", "voltage": "V", "": "1"}
_TOUCH_TEXT = "places [m] on the flat sensor; force [N]; radius of the indenter and depth [m]"


@dataclass(frozen=True, slots=True)
class Column:
    """Column of the table.

    Attributes:
        name: name of the column.
        kind: "text", "touches", or the name of an Arrow type.
        length: length of the list in each row; 0 for a single value.
        units: SI, or "1".
        description: one line.
    """

    name: str
    kind: str
    length: int
    units: str
    description: str


def columns(data: Dataset) -> Iterator[Column]:
    """Columns of the frames of a dataset."""
    channels, units = data.channels, _UNITS[data.quantity]
    descriptions = {field.name: field.description.replace("NaN", "null") for field in FIELDS}
    yield Column("specimen", "int32", 0, "1", "number of the sensor within the dataset")
    yield Column("state", "text", 0, "1", "idle, touch or bend; null where unknown")
    yield Column("bend_angle_deg", "float32", 0, "degree", "bend; null where unknown")
    yield Column("touches", "touches", 0, "SI", f"{_TOUCH_TEXT}; null where unknown")
    for name in (*CLAMP_FIELDS, "support_gap"):
        yield Column(name, "float32", 0, "m" if name in _LENGTHS else "1", descriptions[name])
    for name in ("impedance", "touch_reference", "reference"):
        for part in ("real", "imag"):
            what = f"{part} part: {descriptions[name]}"
            yield Column(f"{name}_{part}", "float32", channels, units, what)
    yield Column("status", "uint8", channels, "1", descriptions["status"])
    yield Column("time", "float64", 0, "s", descriptions["time"])
    yield Column("episode", "int64", 0, "1", descriptions["episode"])
    yield Column("number", "int64", 0, "1", descriptions["number"])


def frame_table(data: Dataset, told: str, split: NDArray[np.str_] | None = None) -> Any:
    """Table of the frames of a dataset, or of a part of one, (n rows).

    Unknown values are null; numbers that are finite are the dataset's own, to the last bit. `told`
    is kept under `METADATA`; the `split` of each frame, (n,), is a column where it is given.
    """
    arrow = require("pyarrow", "recordings")
    arrays, fields = [], []
    for column in columns(data):
        array = _array(arrow, column, data)
        arrays.append(array)
        about = {"units": column.units, "description": column.description}
        fields.append(arrow.field(column.name, array.type, metadata=about))
    if split is not None:
        arrays.insert(0, arrow.array(split.tolist(), arrow.string()))
        fields.insert(0, arrow.field("split", arrow.string()))
    schema = arrow.schema(fields, metadata={METADATA: told.encode()})
    return arrow.Table.from_arrays(arrays, schema=schema)


def origin(data: Dataset) -> dict[str, Any]:
    """Facts that all frames of a dataset share, as plain data; None for what is unknown."""
    table = None if data.protocol is None else [list(row) for row in data.protocol.table]
    return {
        "source": data.source,
        "quantity": data.quantity or None,
        "frequency_hz": data.frequency,
        "seed": data.seed,
        "n_electrodes": None if data.protocol is None else data.protocol.n_electrodes,
        "protocol": table,
        "design": None if data.design is None else data.design.to_toml(),
        "specimen_names": _names_by_number(data.names.specimens),
        "session_names": _names_by_number(data.names.sessions),
    }


def _names_by_number(names: Mapping[int, str]) -> dict[str, str] | None:
    return {str(number): name for number, name in names.items()} or None


def _array(arrow: Any, column: Column, data: Dataset) -> Any:
    if column.kind == "touches":
        return _touches(arrow, data)
    if column.kind == "text":
        named = {int(state): state.name.lower() for state in State}
        return arrow.array([named.get(each) for each in data.state.tolist()], arrow.string())
    kind = getattr(arrow, column.kind)()
    values = _values(column.name, data)
    return (_lists if column.length else _nullable)(arrow, values, kind)


def _values(name: str, data: Dataset) -> NDArray[Any]:
    """Values of a column of numbers, (n,) or (n, C)."""
    if name == "specimen":
        return np.asarray(data.specimen_number[data.specimen])
    if not name.endswith(("_real", "_imag")):
        return np.asarray(getattr(data, name))
    name, _, part = name.rpartition("_")
    values = data.reference[data.specimen] if name == "reference" else getattr(data, name)
    return np.asarray(getattr(values, part))


def _nullable(arrow: Any, values: NDArray[Any], kind: Any) -> Any:
    """Array whose values that are not finite are null."""
    return arrow.array(values.astype(kind.to_pandas_dtype()), kind, mask=~np.isfinite(values))


def _lists(arrow: Any, values: NDArray[Any], kind: Any) -> Any:
    """Lists of equal length; null where no value of the row is finite."""
    flat = arrow.array(np.ascontiguousarray(values).reshape(-1), kind)
    unknown = arrow.array(~np.isfinite(values).any(axis=1))
    return arrow.FixedSizeListArray.from_arrays(flat, values.shape[1], mask=unknown)


def _touches(arrow: Any, data: Dataset) -> Any:
    """Lists of touches; null where neither a place nor the state is known."""
    there = np.isfinite(data.touch_x)
    offsets = np.concatenate([[0], np.cumsum(there.sum(axis=1))]).astype(np.int32)
    parts = [
        _nullable(arrow, getattr(data, f"touch_{name}")[there], arrow.float32())
        for name in TOUCH_FIELDS
    ]
    touches = arrow.StructArray.from_arrays(parts, list(TOUCH_FIELDS))
    has_label = np.isin(data.state, [int(state) for state in State]) | there.any(axis=1)
    # A touched frame without a place has touches that nobody noted.
    has_label &= (data.state != State.TOUCH) | there.any(axis=1)
    return arrow.ListArray.from_arrays(arrow.array(offsets), touches, mask=arrow.array(~has_label))


def write_parquet(
    tables: Iterator[Any], folder: Path, stem: str, file_bytes: int = FILE_BYTES
) -> int:
    """Write the rows of tables to files `STEM-00000-of-00003.parquet`; returns their size [bytes].

    Sizes are those in memory, of which a file holds `file_bytes`, and a group of rows `GROUP_BYTES`
    at most. Equal tables give equal bytes, with the same pyarrow.
    """
    arrow = require("pyarrow.dataset", "recordings")
    first, size = next(tables), 0

    def batches() -> Iterator[Any]:
        nonlocal size
        for table in itertools.chain((first,), tables):
            size += table.nbytes
            yield from table.to_batches()

    rows, group = (
        max(1, most * first.num_rows // first.nbytes) for most in (file_bytes, GROUP_BYTES)
    )
    parquet = arrow.ParquetFileFormat()
    arrow.write_dataset(
        batches(),
        folder,
        schema=first.schema,
        format=parquet,
        file_options=parquet.make_write_options(compression="zstd"),
        basename_template=f"{stem}-{{i}}.part",
        max_rows_per_file=rows,
        min_rows_per_group=min(rows, group),
        max_rows_per_group=min(rows, group),
        existing_data_behavior="overwrite_or_ignore",
        use_threads=False,
    )
    count = len(list(folder.glob(f"{stem}-*.part")))
    for number in range(count):
        name = f"{stem}-{number:05d}-of-{count:05d}.parquet"
        (folder / f"{stem}-{number}.part").rename(folder / name)
    return size
