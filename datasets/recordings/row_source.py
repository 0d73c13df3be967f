"""Sources whose files have a header and rows of cells, of which columns make tables."""

import itertools
import re
from abc import abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from eitskin.datasets.recordings.source import Source, Tables, Wanted
from eitskin.errors import ConfigurationError, DataError
from eitskin.input_files import shortened

_TEXT_ROWS: Final = 256  # held as text at a time, which takes ten times the memory of numbers
_NUMBERED: Final = re.compile(r"(.*\D)(\d{1,9})")  # longer ones are names


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
        rows, names = self.rows(), (*wanted.values, *wanted.labels)
        while True:
            block = itertools.islice(rows, wanted.block_rows)
            pieces: list[Tables] = []
            while cells := list(itertools.islice(block, _TEXT_ROWS)):
                pieces.append(self._tables(wanted, cells))
            if not pieces:
                return
            yield {name: np.concatenate([piece[name] for piece in pieces]) for name in names}

    def _tables(self, wanted: Wanted, block: list[tuple[int, Sequence[str]]]) -> Tables:
        tables: dict[str, NDArray[Any]] = {}
        for name in (*wanted.values, *wanted.labels):
            columns = self.columns[name]
            cells = [[row[column] for column in columns] for _, row in block]
            if name in wanted.values:
                tables[name] = self._numbers(name, cells, [number for number, _ in block])
            else:
                tables[name] = np.char.strip(np.array(cells, dtype=np.str_))
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
                        f"530.1-2j, got '{shortened(cell.strip())}'"
                    ) from None
        return found


def _check_header(path: Path, header: Sequence[str]) -> None:
    """Raise DataError for names that repeat, and for numbers where names are due."""
    if not header:
        raise DataError(f"{path.name} must have a header and at least one row, got nothing")
    twice = sorted({name for name in header if header.count(name) > 1 and name})
    if twice:
        raise DataError(f"expected columns of different names, got '{twice[0]}' more than once")
    if all(is_number(name) for name in header):
        raise DataError(
            f"expected names of columns in the first row, got numbers ({', '.join(header[:3])}); "
            "add a header such as v0, v1, v2"
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


def is_number(text: str) -> bool:
    """Whether a cell is a real number."""
    try:
        float(text)
    except ValueError:
        return False
    return True
