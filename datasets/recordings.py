"""Measured recordings of other people's boards and skins, brought into this format."""

import csv
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from eitskin.bounds import LONGEST
from eitskin.datasets.store.dataset import Dataset
from eitskin.datasets.store.schema import MAX_TOUCHES
from eitskin.datasets.store.state import UNKNOWN_STATE, State
from eitskin.errors import ConfigurationError, DataError
from eitskin.protocol import Protocol

Tables = Mapping[str, NDArray[Any]]

OPENEIT: Final = "magnitudes"
CSV_VALUES: Final = "v"
_PLACES: Final = ("touch_x", "touch_y")
_LABELS: Final = {"angle_deg": "bend_angle_deg", "t": "time"}


@dataclass(frozen=True, slots=True)
class RecordingNames:
    """Where in a file things are: names of variables, in a CSV file the beginnings of columns.

    Attributes:
        values: measured, frames by channels; "v" for CSV and "magnitudes" for OpenEIT when
            omitted.
        touch_reference: the same sensor, just not touched, frames by channels; none when omitted.
        positions: frames by (x, y, ...) [m], where each frame is touched; more columns are left
            aside. In a CSV file always the columns x and y.
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
    """Read a recording of any number of channels.

    Besides what `names` says, `state` (idle, touch, bend or their numbers), `angle_deg` [deg],
    `x`, `y` [m], `force` [N] and `t` [s] are taken where the file has them.

    Args:
        path: .csv with a header, .mat (version 5), .npz without pickled objects, or .txt with
            OpenEIT's "magnitudes : a , b , ..." lines.
        names: where in the file things are.
        protocol: what the channels were measured at; None where that is unknown.
        frequency: of the excitation [Hz].

    Raises:
        DataError: where the file, or what is in it, cannot be used.
        ConfigurationError: for another kind of file, or names that it does not hold.
    """
    path, names = Path(path), names or RecordingNames()
    try:
        read, default = _READERS[path.suffix.lower()]
    except KeyError:
        raise ConfigurationError(
            f"cannot tell what {path.name} is from its ending; expected {', '.join(_READERS)}"
        ) from None
    try:
        tables = read(path)
    except FileNotFoundError as error:
        raise DataError(f"there is no file {path}") from error
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"cannot read {path}: {error}") from error
    try:
        return _dataset(tables, names, default, protocol, frequency)
    except DataError as error:
        raise DataError(f"{path}: {error}") from error


def parse_protocol(text: str) -> Protocol:
    """The protocol that "pairwise:8" and the like stand for."""
    match = re.fullmatch(r"pairwise:(\d{1,3})", text)
    if match is None or int(match[1]) < 2:
        raise ConfigurationError(
            f"expected a protocol as pairwise:N with the number of electrodes, got '{text}'"
        )
    return Protocol.pairwise(int(match[1]))


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
    """Labels of the file's `n` frames, under the names of `Dataset`."""
    known: dict[str, NDArray[Any]] = {
        field: _column(tables, name, n) for name, field in _LABELS.items() if name in tables
    }
    if names.positions:
        places = _matrix(tables, names.positions, "positions").real
        if len(places) != n or places.shape[1] < 2:
            raise DataError(
                f"'{names.positions}' must have x and y for each of {n} frames, got shape "
                f"{places.shape}"
            )
        known |= {"touch_x": _first(places[:, 0]), "touch_y": _first(places[:, 1])}
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


def _matrix(tables: Tables, name: str | None, what: str) -> NDArray[Any]:
    """The table of `name` as numbers, frames by columns."""
    if name is None or name not in tables:
        said = "nothing was named" if name is None else f"there is no '{name}'"
        raise ConfigurationError(
            f"cannot find the {what}: {said}; the file holds {', '.join(tables) or 'nothing'}"
        )
    table = tables[name]
    if table.ndim != 2 or not np.issubdtype(table.dtype, np.number):
        raise DataError(
            f"'{name}' must be a matrix of numbers, frames by columns, got {table.dtype} of shape "
            f"{table.shape}"
        )
    return table


def _column(tables: Tables, name: str, n: int) -> NDArray[np.float64]:
    """The table of `name` as one real number per frame."""
    try:
        column = np.ravel(tables[name]).astype(np.float64)
    except (ValueError, TypeError) as error:
        raise DataError(f"'{name}' must hold numbers: {error}") from error
    if len(column) != n:
        raise DataError(f"'{name}' must have one value for each of {n} frames, got {len(column)}")
    return column


def _require_metres(known: Mapping[str, NDArray[Any]]) -> None:
    """Refuse positions that no skin has, which are millimetres most likely."""
    places = np.array([known[field] for field in _PLACES if field in known])
    places = places[np.isfinite(places)]
    if len(places) and np.abs(places).max() > LONGEST:
        raise DataError(
            f"positions must be in metres, up to {LONGEST:g} m, got {places.min():g} to "
            f"{places.max():g}; divide millimetres by 1000"
        )


def _first(column: NDArray[np.float64]) -> NDArray[np.float64]:
    """One touch per frame in the format's four columns."""
    columns = np.full((len(column), MAX_TOUCHES), np.nan)
    columns[:, 0] = column
    return columns


def _states(given: NDArray[Any], n: int) -> NDArray[np.uint8]:
    """States from names or numbers; an empty cell is unknown."""
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


def _read_csv(path: Path) -> Tables:
    """Columns by name; columns v0, v1 ... vN together as one complex table v."""
    with path.open(newline="", encoding="utf-8-sig") as file:
        rows = [row for row in csv.reader(file, skipinitialspace=True) if row]
    if len(rows) < 2:
        raise DataError(f"{path} must have a header and at least one row, got {len(rows)} lines")
    header = [name.strip() for name in rows[0]]
    for number, row in enumerate(rows[1:], start=2):
        if len(row) != len(header):
            raise DataError(f"{path}, row {number}: expected {len(header)} cells, got {len(row)}")
    columns = dict(zip(header, zip(*rows[1:], strict=True), strict=True))
    tables: dict[str, NDArray[Any]] = {}
    for prefix in dict.fromkeys(name[:-1] for name in header if re.fullmatch(r".*\D0", name)):
        width = 0
        while f"{prefix}{width}" in columns:
            width += 1
        cells = [columns.pop(f"{prefix}{number}") for number in range(width)]
        tables[prefix] = np.array(_numbers(path, prefix, cells)).T
    for name, column in columns.items():
        cells_or_nan = column if name == "state" else [cell.strip() or "nan" for cell in column]
        tables[name] = np.array(cells_or_nan)
    return tables


def _numbers(path: Path, prefix: str, columns: list[tuple[str, ...]]) -> list[list[complex]]:
    try:
        return [[complex(cell.strip()) for cell in column] for column in columns]
    except ValueError as error:
        raise DataError(f"{path}, columns {prefix}0 and on: {error}") from error


def _read_mat(path: Path) -> Tables:
    from scipy.io import loadmat

    try:
        with path.open("rb") as file:
            content = loadmat(file)
    except OSError:
        raise
    except NotImplementedError as error:
        raise DataError(f"{path} is a MATLAB file of version 7.3; save it with '-v7'") from error
    except Exception as error:  # scipy has no base of its own for what damaged files raise
        raise DataError(f"{path} is not a MATLAB file that can be read: {error}") from error
    return {name: np.asarray(value) for name, value in content.items() if name[:2] != "__"}


def _read_npz(path: Path) -> Tables:
    from zipfile import BadZipFile

    try:
        with np.load(path, allow_pickle=False) as content:
            return {name: content[name] for name in content.files}
    except (ValueError, BadZipFile, AttributeError, EOFError) as error:
        raise DataError(
            f"{path} is not an .npz file of plain arrays: {error}; save it with numpy.savez"
        ) from error


def _read_openeit(path: Path) -> Tables:
    """Frames of OpenEIT's serial output; lines that are no frames are passed over."""
    frames: list[list[float]] = []
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1):
        label, _, numbers = line.partition(":")
        if label.strip() != OPENEIT:
            continue
        try:
            frames.append([float(cell) for cell in numbers.strip().rstrip(",").split(",")])
        except ValueError as error:
            raise DataError(f"{path}, line {number}: {error}") from error
        if len(frames[-1]) != len(frames[0]):
            raise DataError(
                f"{path}, line {number}: expected {len(frames[0])} values as in the first frame, "
                f"got {len(frames[-1])}; take the broken line out"
            )
    if not frames:
        raise DataError(f"{path} holds no line that begins with '{OPENEIT} :'")
    return {OPENEIT: np.array(frames)}


_READERS: Final[Mapping[str, tuple[Callable[[Path], Tables], str | None]]] = {
    ".csv": (_read_csv, CSV_VALUES),
    ".mat": (_read_mat, None),
    ".npz": (_read_npz, None),
    ".txt": (_read_openeit, OPENEIT),
}
