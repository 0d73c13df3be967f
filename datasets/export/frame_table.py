"""Frames of a dataset as an Arrow table: a row for each frame, every column typed."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eitskin.datasets.store.dataset import Dataset
from eitskin.datasets.store.schema import CLAMP_FIELDS, FIELDS
from eitskin.datasets.store.state import State
from eitskin.extras import require

TOUCH_FIELDS = ("x", "y", "force", "radius", "depth")
METADATA = b"eitskin"
"""Key of the schema's metadata: JSON of what is not said of single frames."""

_ROWS = {field.name: field for field in FIELDS}
_UNITS = {"impedance": "ohm", "magnitude": "ohm", "voltage": "V", "": "1"}
_TOUCH_TEXT = "places [m] on the flat sensor; force [N]; radius of the indenter and depth [m]"


@dataclass(frozen=True, slots=True)
class Column:
    """Column of the table.

    Attributes:
        name: of the column.
        kind: "text", "touches", or the name of an Arrow type.
        length: of the list in each row; 0 for a single value.
        units: SI, or "1".
        description: one line.
    """

    name: str
    kind: str
    length: int
    units: str
    description: str


def columns(data: Dataset) -> tuple[Column, ...]:
    """Columns of the frames of a dataset."""
    return tuple(_columns(data.channels, _UNITS[data.quantity]))


def _columns(channels: int, units: str) -> Iterator[Column]:
    said = {name: field.description for name, field in _ROWS.items()}
    yield Column("specimen", "int32", 0, "1", "number of the sensor within the dataset")
    yield Column("state", "text", 0, "1", "idle, touch or bend; null where unknown")
    yield Column("bend_angle_deg", "float32", 0, "degree", "bend; null where unknown")
    yield Column("touches", "touches", 0, "SI", f"{_TOUCH_TEXT}; null where unknown")
    for name in CLAMP_FIELDS:
        what = said[name].replace("NaN", "null")
        yield Column(name, "float32", 0, _ROWS[name].units, what)
    for name in ("impedance", "touch_reference", "reference"):
        for part in ("real", "imag"):
            what = f"{part} part: {said[name].replace('NaN', 'null')}"
            yield Column(f"{name}_{part}", "float32", channels, units, what)
    yield Column("status", "uint8", channels, "1", said["status"])
    yield Column("time", "float64", 0, "s", said["time"])
    yield Column("episode", "int64", 0, "1", said["episode"])
    yield Column("number", "int64", 0, "1", said["number"])


def frame_table(data: Dataset, told: str, split: NDArray[np.str_] | None = None) -> Any:
    """Table of the frames of a dataset, or of a part of one, (n rows).

    Unknown values are null; numbers that are finite are the dataset's own, to the last bit.

    Args:
        data: the frames.
        told: kept under `METADATA`.
        split: of each frame, (n,); adds a column where it is given.

    Raises ImportError naming the extra, where pyarrow is missing.
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
        "specimen_names": _by_text(data.names.specimens),
        "session_names": _by_text(data.names.sessions),
    }


def _by_text(names: Mapping[int, str]) -> dict[str, str] | None:
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
    known = np.isin(data.state, [int(state) for state in State]) | there.any(axis=1)
    # A touched frame without a place has touches that nobody noted.
    known &= (data.state != State.TOUCH) | there.any(axis=1)
    return arrow.ListArray.from_arrays(arrow.array(offsets), touches, mask=arrow.array(~known))
