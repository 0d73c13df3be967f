"""Readers of recordings: tables of numbers by name, from CSV, MATLAB, NumPy and OpenEIT files."""

import csv
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from eitskin.errors import ConfigurationError, DataError

Tables = Mapping[str, NDArray[Any]]

OPENEIT: Final = "magnitudes"
CSV_VALUES: Final = "v"


def read_tables(path: Path) -> tuple[Tables, str | None]:
    """Tables of a file by name, and the usual name of the measured values in files of its kind.

    Raises:
        DataError: where the file is missing, cannot be read, or is damaged.
        ConfigurationError: for another kind of file.
    """
    try:
        read, values = _READERS[path.suffix.lower()]
    except KeyError:
        raise ConfigurationError(
            f"cannot tell the format of {path.name} from its ending; expected {', '.join(_READERS)}"
        ) from None
    try:
        return read(path), values
    except FileNotFoundError as error:
        raise DataError(f"there is no file {path}") from error
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"cannot read {path}: {error}") from error


def _read_csv(path: Path) -> Tables:
    """Columns of a CSV file by name; columns v0, v1 ... vN together as one complex table v."""
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
    """Cells of columns as complex numbers; raises DataError."""
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
    except Exception as error:  # scipy's errors for damaged files have no common base
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
    """Frames of OpenEIT's serial output; other lines are skipped."""
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
                f"got {len(frames[-1])}; remove the broken line"
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
