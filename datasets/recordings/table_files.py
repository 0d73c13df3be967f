"""Recordings in Excel and Parquet files."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eitskin.datasets.recordings.row_source import RowSource
from eitskin.datasets.recordings.source import Tables, Wanted
from eitskin.errors import ConfigurationError, DataError
from eitskin.extras import require


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
        for batch in self._file.iter_batches(wanted.block_rows, columns=columns):
            arrays = {name: _parquet_column(batch.column(name), name, done) for name in columns}
            done += batch.num_rows
            yield {
                name: np.concatenate(
                    [arrays[self.header[column]] for column in self.columns[name]], axis=1
                )
                for name in names
            }


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
