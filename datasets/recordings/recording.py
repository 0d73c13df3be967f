"""Import of measured recordings, from any board and skin, as datasets."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from eitskin.bounds import LONGEST
from eitskin.datasets.recordings.readers import Tables, read_tables
from eitskin.datasets.store.dataset import Dataset
from eitskin.datasets.store.schema import MAX_TOUCHES
from eitskin.datasets.store.state import UNKNOWN_STATE, State
from eitskin.errors import ConfigurationError, DataError
from eitskin.protocol import Protocol

_POSITIONS: Final = ("touch_x", "touch_y")
_LABELS: Final = {"angle_deg": "bend_angle_deg", "t": "time"}


@dataclass(frozen=True, slots=True)
class RecordingNames:
    """Names of the tables in a file: of variables, or in a CSV file prefixes of columns.

    Attributes:
        values: measured values, frames by channels; "v" for CSV and "magnitudes" for OpenEIT when
            omitted.
        touch_reference: values of the same sensor untouched, frames by channels; none when omitted.
        positions: touch positions, frames by (x, y, ...) [m]; further columns are ignored. In a CSV
            file always the columns x and y.
    """

    values: str | None = None
    touch_reference: str | None = None
    positions: str | None = None


def read_recording(
    path: str | Path,
    names: RecordingNames | None = None,
    protocol: Protocol | None = None,
    frequency: float = 40e3,
) -> Dataset:
    """Dataset of a recording with any number of channels.

    Besides the tables of `names`, `state` (idle, touch, bend or their numbers), `angle_deg` [deg],
    `x`, `y` [m], `force` [N] and `t` [s] are taken where the file has them.

    Args:
        path: .csv with a header, .mat (version 5), .npz without pickled objects, or .txt with
            OpenEIT's "magnitudes : a , b , ..." lines.
        names: of the tables in the file.
        protocol: drive and sense pairs of the channels; None where unknown.
        frequency: of the excitation [Hz].

    Raises:
        DataError: where the file or its content cannot be used.
        ConfigurationError: for another kind of file, or names that are not in the file.
    """
    path, names = Path(path), names or RecordingNames()
    tables, default = read_tables(path)
    try:
        return _dataset(tables, names, default, protocol, frequency)
    except DataError as error:
        raise DataError(f"{path}: {error}") from error


def _dataset(
    tables: Tables,
    names: RecordingNames,
    default: str | None,
    protocol: Protocol | None,
    frequency: float,
) -> Dataset:
    values = _matrix(tables, names.values or default, "values")
    known: dict[str, Any] = {}
    reference = values[0]
    if names.touch_reference:
        touch_reference = _matrix(tables, names.touch_reference, "touch reference")
        if touch_reference.shape != values.shape:
            raise DataError(
                f"'{names.touch_reference}' must have the shape of the values, {values.shape}, "
                f"got {touch_reference.shape}"
            )
        known["touch_reference"] = touch_reference
        reference = touch_reference.mean(axis=0)
    known |= _labels(tables, names, len(values))
    return Dataset.from_arrays(
        values, reference, protocol=protocol, frequency=frequency, source="measured", **known
    )


def _labels(tables: Tables, names: RecordingNames, n: int) -> dict[str, NDArray[Any]]:
    """Labels of the `n` frames, under the names of `Dataset`'s attributes."""
    known: dict[str, NDArray[Any]] = {
        field: _column(tables, name, n) for name, field in _LABELS.items() if name in tables
    }
    if names.positions:
        positions = _matrix(tables, names.positions, "positions").real
        if len(positions) != n or positions.shape[1] < 2:
            raise DataError(
                f"'{names.positions}' must have x and y for each of {n} frames, got shape "
                f"{positions.shape}"
            )
        known |= {"touch_x": _first(positions[:, 0]), "touch_y": _first(positions[:, 1])}
    else:
        wanted = {"x": "touch_x", "y": "touch_y"}
        known |= {
            f: _first(_column(tables, name, n)) for name, f in wanted.items() if name in tables
        }
    _require_metres(known)
    if "force" in tables:
        known["touch_force"] = _first(_column(tables, "force", n))
    if "state" in tables:
        known["state"] = _states(tables["state"], n)
    elif "touch_x" in known:
        touched = np.isfinite(known["touch_x"][:, 0])
        known["state"] = np.where(touched, int(State.TOUCH), UNKNOWN_STATE)
    return known


def _matrix(tables: Tables, name: str | None, meaning: str) -> NDArray[Any]:
    """Table of `name` as numbers, frames by columns."""
    if name is None or name not in tables:
        said = "nothing was named" if name is None else f"there is no '{name}'"
        raise ConfigurationError(
            f"cannot find the {meaning}: {said}; the file holds {', '.join(tables) or 'nothing'}"
        )
    table = tables[name]
    if table.ndim != 2 or not np.issubdtype(table.dtype, np.number):
        raise DataError(
            f"'{name}' must be a matrix of numbers, frames by columns, got {table.dtype} of shape "
            f"{table.shape}"
        )
    return table


def _column(tables: Tables, name: str, n: int) -> NDArray[np.float64]:
    """Table of `name` as one real number per frame, (n,)."""
    try:
        column = np.ravel(tables[name]).astype(np.float64)
    except (ValueError, TypeError) as error:
        raise DataError(f"'{name}' must hold numbers: {error}") from error
    if len(column) != n:
        raise DataError(f"'{name}' must have one value for each of {n} frames, got {len(column)}")
    return column


def _require_metres(known: Mapping[str, NDArray[Any]]) -> None:
    """Raise DataError for positions too large for a skin, most likely in millimetres."""
    positions = np.array([known[field] for field in _POSITIONS if field in known])
    positions = positions[np.isfinite(positions)]
    if len(positions) and np.abs(positions).max() > LONGEST:
        raise DataError(
            f"positions must be in metres, up to {LONGEST:g} m, got {positions.min():g} to "
            f"{positions.max():g}; divide millimetres by 1000"
        )


def _first(column: NDArray[np.float64]) -> NDArray[np.float64]:
    """One touch per frame in the format's four columns, (n, 4)."""
    columns = np.full((len(column), MAX_TOUCHES), np.nan)
    columns[:, 0] = column
    return columns


def _states(given: NDArray[Any], n: int) -> NDArray[np.uint8]:
    """States from names or numbers, (n,); an empty cell is unknown."""
    known = {state.name.lower(): int(state) for state in State}
    known |= {str(int(state)): int(state) for state in State} | {"": UNKNOWN_STATE}
    cells = [str(cell).strip().lower().removesuffix(".0") for cell in np.ravel(given)]
    wrong = sorted(set(cells) - set(known))
    if wrong or len(cells) != n:
        raise DataError(
            f"'state' must be idle, touch, bend or 0, 1, 2 for each of {n} frames, got "
            f"{len(cells)} values" + (f" with {wrong[:3]}" if wrong else "")
        )
    return np.array([known[cell] for cell in cells], dtype=np.uint8)
