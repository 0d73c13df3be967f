"""Recordings as rows with a header: CSV, spreadsheets, Parquet, and OpenEIT's lines."""

import csv
import itertools
import re
from abc import abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from eitskin.datasets.recordings.source import BLOCK_ROWS, Source, Tables, Wanted
from eitskin.errors import ConfigurationError, DataError
from eitskin.extras import require

OPENEIT: Final = "magnitudes"
_NUMBERED: Final = re.compile(r"(.*\D)(\d+)")
_DELIMITERS: Final = ",;\t"


class RowSource(Source):
    """File of rows under a header, whose numbered columns make one table together.

    Columns v0, v1 ... or v1, v2 ... are the table v. FIRST..LAST is the table of the columns from
    one name to another in the order of the file.
    """

    usual_values = "v"

    def __init__(self, path: Path, header: Sequence[str]) -> None:
        """Group the columns of `header`; arguments and errors as for `Source`."""
        super().__init__(path)
        self.header = [name.strip() for name in header]
        _check_header(path, self.header)
        self.columns = _grouped(self.header)
        self.names = tuple(self.columns)

    @abstractmethod
    def rows(self) -> Iterator[tuple[int, Sequence[str]]]:
        """Rows of cells as text after the header, each with its number in the file from 1."""

    def require(self, name: str, meaning: str) -> str:
        first, dots, last = name.partition("..")
        if dots and first in self.header and last in self.header:
            start, stop = self.header.index(first), self.header.index(last)
            self.columns[name] = list(range(start, stop + 1))
            if start <= stop:
                return name
            raise ConfigurationError(f"'{first}' stands after '{last}'; write {last}..{first}")
        _require_no_gap(self.header, self.columns, name)
        return super().require(name, meaning)

    def blocks(self, wanted: Wanted) -> Iterator[Tables]:
        if wanted.transposed:
            raise ConfigurationError(
                f"{self.path.name} has frames as rows, which cannot be transposed; leave "
                "--transpose out"
            )
        rows = self.rows()
        while block := list(itertools.islice(rows, BLOCK_ROWS)):
            yield self._tables(wanted, block)

    def _tables(self, wanted: Wanted, block: list[tuple[int, Sequence[str]]]) -> Tables:
        tables: dict[str, NDArray[Any]] = {}
        for name in (*wanted.values, *wanted.labels):
            columns = self.columns[name]
            cells = [[row[column] for column in columns] for _, row in block]
            if name in wanted.values:
                tables[name] = self._numbers(name, cells, [number for number, _ in block])
            else:
                tables[name] = np.array(cells, dtype=np.str_)
        return tables

    def _numbers(self, name: str, cells: list[list[str]], numbers: list[int]) -> NDArray[Any]:
        """Cells as real or complex numbers, NaN where empty; raises DataError."""
        for kind in (np.float64, np.complex128):
            try:
                return np.array(cells, dtype=kind)
            except ValueError:
                continue
        found = np.full((len(cells), len(cells[0])), np.nan, dtype=np.complex128)
        for row, line in enumerate(cells):
            for column, cell in enumerate(line):
                try:
                    found[row, column] = complex(cell.replace(" ", "") or "nan")
                except ValueError:
                    title = self.header[self.columns[name][column]]
                    raise DataError(
                        f"row {numbers[row]}, column {title}: expected a number such as 530.1 or "
                        f"530.1-2j, got '{cell}'"
                    ) from None
        return found


class CsvSource(RowSource):
    """Text with cells between commas, semicolons or tabs; decimal commas beside semicolons."""

    def __init__(self, path: Path) -> None:
        with path.open(newline="", encoding="utf-8-sig") as file:
            first = next((line for line in file if line.strip()), "")
        self._delimiter = max(_DELIMITERS, key=first.count)
        header = next(csv.reader([first], delimiter=self._delimiter, skipinitialspace=True), [])
        super().__init__(path, header)
        if next(self.rows(), None) is None:
            raise DataError("expected a header and at least one row, got no row")

    def rows(self) -> Iterator[tuple[int, Sequence[str]]]:
        with self.path.open(newline="", encoding="utf-8-sig") as file:
            reader = csv.reader(file, delimiter=self._delimiter, skipinitialspace=True)
            lines = (row for row in reader if row)
            next(lines)
            for row in lines:
                if len(row) != len(self.header):
                    raise DataError(
                        f"row {reader.line_num}: expected {len(self.header)} cells, got {len(row)}"
                    )
                decimal = "," if self._delimiter == ";" else "."
                yield reader.line_num, [cell.strip().replace(decimal, ".") for cell in row]


class SpreadsheetSource(RowSource):
    """First sheet, or a named one, of an Excel file; values of formulas, as they were saved."""

    def __init__(self, path: Path, sheet: str | None = None) -> None:
        """Read the header.

        Args:
            path: of the file.
            sheet: name of the sheet; the first one when omitted.
        """
        self._excel = require("openpyxl", "xlsx")
        self._sheet = sheet
        self.path = path
        first = next(self._lines(), None)
        header = ["" if cell is None else str(cell) for cell in first or ()]
        while header and not header[-1].strip():
            header.pop()
        super().__init__(path, header)
        if next(self.rows(), None) is None:
            raise DataError("expected a header and at least one row, got no row")

    def rows(self) -> Iterator[tuple[int, Sequence[str]]]:
        width = len(self.header)
        for number, line in enumerate(self._lines(), start=1):
            cells = ["" if cell is None else str(cell).strip() for cell in line]
            if number == 1 or not any(cells):
                continue
            if any(cells[width:]):
                raise DataError(f"row {number}: expected {width} cells, got {len(cells)}")
            yield number, cells[:width] + [""] * (width - len(cells))

    def _lines(self) -> Iterator[tuple[Any, ...]]:
        """Cells of the sheet, row by row."""
        try:
            book = self._excel.load_workbook(self.path, read_only=True, data_only=True)
        except FileNotFoundError:
            raise
        except Exception as error:  # openpyxl's errors for damaged files have no common base
            raise DataError(f"not an Excel file that can be read: {error}") from error
        try:
            names = book.sheetnames
            if self._sheet is not None and self._sheet not in names:
                raise ConfigurationError(
                    f"there is no sheet '{self._sheet}'; the file has {', '.join(names)}"
                )
            yield from book[self._sheet or names[0]].iter_rows(values_only=True)
        finally:
            book.close()


class ParquetSource(RowSource):
    """Parquet file; a column of lists of equal length is a table."""

    def __init__(self, path: Path) -> None:
        parquet = require("pyarrow.parquet", "parquet")
        try:
            self._file = parquet.ParquetFile(path)
        except FileNotFoundError:
            raise
        except (OSError, ValueError) as error:  # pyarrow's errors derive from these
            raise DataError(f"not a Parquet file that can be read: {error}") from error
        super().__init__(path, self._file.schema_arrow.names)
        if not self._file.metadata.num_rows:
            raise DataError("expected at least one row, got none")

    def rows(self) -> Iterator[tuple[int, Sequence[str]]]:
        raise NotImplementedError  # columns are read as arrays

    def blocks(self, wanted: Wanted) -> Iterator[Tables]:
        if wanted.transposed:
            raise ConfigurationError("a Parquet file has frames as rows; leave --transpose out")
        names = (*wanted.values, *wanted.labels)
        columns = sorted({self.header[column] for name in names for column in self.columns[name]})
        done = 0
        for batch in self._file.iter_batches(BLOCK_ROWS, columns=columns):
            arrays = {name: _parquet_column(batch.column(name), name, done) for name in columns}
            done += batch.num_rows
            yield {
                name: np.concatenate(
                    [arrays[self.header[column]] for column in self.columns[name]], axis=1
                )
                for name in names
            }


class OpenEitSource(Source):
    """OpenEIT's serial output: frames in lines "magnitudes : a , b , ..."; others are skipped."""

    usual_values = OPENEIT

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self.names = (OPENEIT,)
        if next(self._frames(), None) is None:
            raise DataError(f"the file holds no line that begins with '{OPENEIT} :'")

    def blocks(self, wanted: Wanted) -> Iterator[Tables]:
        if wanted.transposed:
            raise ConfigurationError("OpenEIT's lines are frames; leave --transpose out")
        frames = self._frames()
        while block := list(itertools.islice(frames, BLOCK_ROWS)):
            yield {OPENEIT: np.array(block)}

    def _frames(self) -> Iterator[list[float]]:
        expected = 0
        with self.path.open(encoding="utf-8") as file:
            for number, line in enumerate(file, start=1):
                label, _, numbers = line.partition(":")
                if label.strip() != OPENEIT:
                    continue
                try:
                    frame = [float(cell) for cell in numbers.strip().rstrip(",").split(",")]
                except ValueError as error:
                    raise DataError(f"line {number}: {error}") from error
                expected = expected or len(frame)
                if len(frame) != expected:
                    raise DataError(
                        f"line {number}: expected {expected} values as in the first frame, "
                        f"got {len(frame)}; remove the broken line"
                    )
                yield frame


def _parquet_column(column: Any, name: str, first: int) -> NDArray[Any]:
    """Column of a batch as a table (rows, columns); text where it is text, NaN where absent."""
    values = column.to_numpy(zero_copy_only=False)
    if values.dtype != object:
        return np.asarray(values).reshape(len(values), -1)
    if any(isinstance(value, np.ndarray) for value in values):
        widths = [np.size(value) if value is not None else 0 for value in values]
        if len(set(widths)) > 1:
            row = first + next(i for i, width in enumerate(widths) if width != widths[0])
            raise DataError(
                f"row {row} of '{name}': expected {widths[0]} values as in the first row, got "
                f"{widths[row - first]}"
            )
        return np.stack([np.asarray(value, dtype=np.float64) for value in values])
    return np.array([["" if value is None else str(value)] for value in values], dtype=np.str_)


def _check_header(path: Path, header: Sequence[str]) -> None:
    """Raise DataError for names that repeat, and for numbers where names are due."""
    if not header:
        raise DataError(f"{path.name} must have a header and at least one row, got nothing")
    twice = sorted({name for name in header if header.count(name) > 1 and name})
    if twice:
        raise DataError(f"expected columns of different names, got '{twice[0]}' more than once")
    if all(re.fullmatch(r"[-+.\d]+(e[-+]?\d+)?", name) for name in header):
        raise DataError(
            f"expected names of columns in the first row, got numbers ({', '.join(header[:3])}); "
            "add a header such as v0,v1,v2"
        )


def _grouped(header: Sequence[str]) -> dict[str, list[int]]:
    """Numbers of the columns of each table, by its name."""
    numbered: dict[str, dict[int, int]] = {}
    for column, name in enumerate(header):
        if match := _NUMBERED.fullmatch(name):
            numbered.setdefault(match[1], {})[int(match[2])] = column
    tables: dict[str, list[int]] = {}
    for prefix, columns in numbered.items():
        first = min(columns)
        run = list(itertools.takewhile(columns.__contains__, itertools.count(first)))
        if first == 0 or (first == 1 and len(run) > 1):
            tables[prefix] = [columns[number] for number in run]
    taken = {column for columns in tables.values() for column in columns}
    tables |= {name: [column] for column, name in enumerate(header) if column not in taken}
    return tables


def _require_no_gap(header: Sequence[str], tables: Mapping[str, list[int]], name: str) -> None:
    """Raise DataError where numbered columns of a table are missing between others."""
    beyond = [h for h in header if (m := _NUMBERED.fullmatch(h)) and m[1] == name and h in tables]
    if name in tables and beyond:
        last = header[tables[name][-1]]
        raise DataError(
            f"the columns of '{name}' must be numbered without a gap, but after {last} comes "
            f"{beyond[0]}; name them by --values FIRST..LAST where none is missing"
        )
