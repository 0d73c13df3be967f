"""Frames of a dataset as Arrow tables and Parquet files, and their splits by specimen."""

import contextlib
import hashlib
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
"""Size in memory of the rows that are kept before they are written [bytes]."""

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
    for name in CLAMP_FIELDS:
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


class ParquetFiles:
    """Writer of the rows of one table to files `STEM-00000-of-00003.parquet`.

    No more than `GROUP_BYTES` and one table are kept in memory. Equal tables give equal bytes, with
    the same pyarrow. The files get their names when the writer is closed.

    Attributes:
        size: size of the rows so far in memory [bytes].
    """

    def __init__(self, folder: Path, stem: str, file_bytes: int = FILE_BYTES) -> None:
        """Begin without files, each of which is to hold rows of `file_bytes` in memory."""
        self.size = self._in_file = 0
        self._folder, self._stem, self._file_bytes = folder, stem, file_bytes
        self._group_bytes = min(GROUP_BYTES, file_bytes)
        self._tables: list[Any] = []
        self._parts: list[Path] = []
        self._writer: Any = None

    def write(self, table: Any) -> None:
        """Append the rows of a table; all tables have one schema."""
        self._tables.append(table)
        self.size += table.nbytes
        if sum(table.nbytes for table in self._tables) >= self._group_bytes:
            self._flush()

    def close(self) -> None:
        """Write what is kept, and give all files their names."""
        self._flush()
        self._end_file()
        for number, part in enumerate(self._parts):
            name = f"{self._stem}-{number:05d}-of-{len(self._parts):05d}.parquet"
            part.rename(self._folder / name)

    def abandon(self) -> None:
        """Close an unfinished file, whose folder is about to be removed."""
        with contextlib.suppress(OSError):  # a full disk has been reported already
            self._end_file()

    def _flush(self) -> None:
        arrow, parquet = require("pyarrow", "recordings"), require("pyarrow.parquet", "recordings")
        if not self._tables:
            return
        table = arrow.concat_tables(self._tables)
        self._tables = []
        most = max(1, self._group_bytes * table.num_rows // max(table.nbytes, 1))
        for start in range(0, table.num_rows, most):
            piece = table.slice(start, most)
            if self._writer is None:
                path = self._folder / f"{self._stem}-{len(self._parts):05d}.part"
                self._writer = parquet.ParquetWriter(path, table.schema, compression="zstd")
                self._parts.append(path)
            self._writer.write_table(piece, row_group_size=piece.num_rows)
            self._in_file += piece.nbytes
            if self._in_file >= self._file_bytes:
                self._end_file()

    def _end_file(self) -> None:
        writer, self._writer, self._in_file = self._writer, None, 0
        if writer is not None:
            writer.close()
