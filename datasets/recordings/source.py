"""Files of recordings by their endings, read in a child, since readers of some formats crash."""

import csv
import dataclasses
import difflib
import itertools
import re
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from inspect import signature
from pathlib import Path
from typing import Any, Final

import msgspec
from numpy.typing import NDArray

from eitskin.datasets.recordings.arrays import Hdf5Reader, NumpyReader, open_mat
from eitskin.datasets.recordings.field_files import FIELD, FieldReader, field_reader
from eitskin.datasets.recordings.parts import (
    complex_values,
    electrode_columns,
    electrodes_of_name,
    is_phase,
    is_reading,
    pair_columns,
    phase_unit,
    protocol_of_names,
)
from eitskin.datasets.recordings.reader import Contents, Reader, ReadRequest, Tables
from eitskin.datasets.recordings.tables import (
    JsonReader,
    ParquetReader,
    SpreadsheetReader,
    TextReader,
    is_number,
)
from eitskin.errors import ConfigurationError, DataError
from eitskin.files import require_regular
from eitskin.reader_process import Answer, Limits, read_in_subprocess

MAX_BYTES: Final = 1 << 36
"""Largest size of a file of a recording [bytes]."""

MAX_LABELS: Final = 12
"""Most columns of numbers before the values, in a file without names."""

MAX_NAMES: Final = 20
"""Number of names in a message."""

SECONDS: Final = 30
"""Processor time for a block of the smallest of files [s]."""

_BYTES_PER_SECOND: Final = 100_000  # of a spreadsheet, the slowest to read
_MEMORY, _MEMORY_PER_BYTE = 400 << 20, 40  # [bytes]
_NUMBERED_NAME: Final = re.compile(
    r"(.*?[^\d\[(])[\[(]?(\d{1,9})[\])]?(?:\s*[\[(][^\d\])]*[\])]|\s*/\s*[^\d\s]+)?"
)
"""Name of a numbered column, perhaps with a unit; longer numbers are names."""

_READERS: Final[Mapping[str, Callable[..., Reader]]] = {
    **dict.fromkeys((".csv", ".tsv"), TextReader),
    **dict.fromkeys((".xlsx", ".xlsm"), SpreadsheetReader),
    ".parquet": ParquetReader,
    ".mat": open_mat,
    **dict.fromkeys((".npz", ".npy"), NumpyReader),
    **dict.fromkeys((".jsonl", ".ndjson", ".json"), JsonReader),
    **dict.fromkeys((".h5", ".hdf5"), Hdf5Reader),
    **dict.fromkeys((".txt", ".dat", ".log", ".asc", ".ohm"), TextReader),
}


class Source:
    """File of a recording, which a child reads.

    In a file of columns, numbered ones are one table: v0, v1 ... or v1, v2 ... are the table v, and
    FIRST..LAST is the table of the columns from one name to another in the order of the file, and
    FIRST,SECOND are two tables with the parts of complex values.

    Attributes:
        path: path of the file.
        contents: contents of the file, as its reader says.
        names: tables in the file that can be read.
        usual_values: name of the measurements in files of this kind; None where there is none.
    """

    def __init__(self, path: Path, sheet: str | None = None, header_row: int | None = None) -> None:
        """Read the names of the tables.

        Raises DataError where the file is missing, no regular one, damaged, or takes too much to
        read, ConfigurationError for another kind of file, and ImportError where the package that
        reads the file is not installed.
        """
        _known_ending(path)
        files = sorted(path.glob("*.eit")) if path.is_dir() else [path]
        self.path, self._size = path, sum(file.stat().st_size for file in files)
        self._options = {"sheet": sheet, "header_row": header_row}
        for file in files:
            require_regular(file, MAX_BYTES, DataError)
        (head,) = self._answers(None)
        self.contents = msgspec.convert(head.data, Contents)
        self._columns: dict[str, list[int]] = {}
        if not self.contents.names:
            unread = "; ".join(f"'{name}' is {kind}" for name, kind in self.contents.unread.items())
            if unread:
                raise DataError(f"expected arrays of plain numbers, but {unread}")
            _check_header(path, self.contents.header)
            self._columns = _group_columns(self.contents.header)
        self.names = self.contents.names or tuple(self._columns)
        self.usual_values = self.contents.usual_values
        self._joined: dict[str, tuple[str, str]] = {}
        pair = ",".join(pair_columns(self.contents.header))
        if not pair and len(whole := pair_columns(self.names, 1)) == 2:
            pair = ",".join(self.names[numbers[0]] for numbers in whole.values())
        if pair and self.usual_values not in self.names:
            self.usual_values = pair

    def usual(self, count: int) -> str | None:
        """Table of the values where none is named: the usual one, or the only one of `count`.

        In a file without names the last `count` columns behind a few others, and columns that are
        named by electrodes;
        else the one with more than half of the columns.
        None where there is nothing to choose.
        """
        usual, header = self.usual_values, self.contents.header
        if not usual or usual in self.names or "," in usual:
            return usual
        if quad := electrode_columns(self.names):
            readings = [n for n in self.names if n not in quad and is_reading(n)]
            return readings[0] if len(readings) == 1 else usual
        numbered = [header[column] for column in self._columns.get("c", ())]
        if self.contents.remark and numbered:
            few = 0 < count <= len(numbered) <= count + MAX_LABELS
            return f"{numbered[-count]}..{numbered[-1]}" if few else "c"
        for width in (4, 2):
            named = [name for name in header if len(electrodes_of_name(name)) == width]
            if len(named) > 1 and protocol_of_names(named):
                return f"{named[0]}..{named[-1]}"
        fitting = [name for name, columns in self._columns.items() if len(columns) == count > 1]
        many = [n for n, columns in self._columns.items() if 2 * len(columns) > len(header) > 4]
        return (fitting if len(fitting) == 1 else [*many, usual])[0]

    def blocks(self, request: ReadRequest, unit: str = "") -> Iterator[Tables]:
        """Tables of consecutive rows, as `Reader.blocks` gives them; `unit` of phases."""
        values = tuple(part for name in request.values for part in self._joined.get(name, (name,)))
        request = dataclasses.replace(request, values=values)
        if self._columns:
            if request.transposed and request.labels:
                raise ConfigurationError(
                    f"{self.path.name}: columns are frames with --transpose, so that none holds "
                    f"{', '.join(request.labels)}; leave one of both out"
                )
            columns = {name: self._columns[name] for name in (*values, *request.labels)}
            request = dataclasses.replace(request, columns=columns)
        return self._with_parts(request, unit)

    def _with_parts(self, request: ReadRequest, unit: str) -> Iterator[Tables]:
        """Blocks of the tables that are wanted, and complex ones of tables in two parts."""
        for answer in self._answers(request):
            tables: dict[str, NDArray[Any]] = dict(answer.arrays)
            for name, (first, second) in self._joined.items():
                polar = is_phase(second)
                if polar:
                    unit = phase_unit(unit, (second, *self.titles(second)), tables[second])
                titles = self.titles(second) or [second]
                sign = -1.0 if all(title.startswith("-") for title in titles) else 1.0  # -Im(Z)
                parts = tables[first], sign * tables[second]
                tables[name] = complex_values(*parts, unit if polar else "")
            yield tables

    def titles(self, name: str) -> list[str]:
        """Names of the columns of a table in a file of columns; of the second part of two."""
        columns = self._columns.get(self._joined.get(name, (name, name))[1], ())
        return [self.contents.header[column] for column in columns]

    def unused_tables(self, used: Collection[str]) -> tuple[str, ...]:
        """Tables that are not among the used ones, nor share a column with them."""
        columns = {column for name in used for column in self._columns.get(name, ())}
        return tuple(
            name
            for name in self.names
            if name not in used and not columns & set(self._columns.get(name, ()))
        )

    def require(self, name: str, meaning: str) -> str:
        """Return `name`, the table with that meaning; raises ConfigurationError for no such one."""
        first, dots, last = name.partition("..")
        header = self.contents.header
        if dots and first in header and last in header:
            start, stop = header.index(first), header.index(last)
            if start > stop:
                raise ConfigurationError(f"'{first}' stands after '{last}'; write {last}..{first}")
            self._columns[name] = list(range(start, stop + 1))
            return name
        first, comma, second = (part.strip() for part in name.partition(","))
        if comma and name not in self.names:
            if is_phase(second) is None:
                raise ConfigurationError(
                    f"expected two parts of the {meaning} as magnitude,phase or real,imag, got "
                    f"'{name}'"
                )
            self._joined[name] = self.require(first, meaning), self.require(second, meaning)
            return name
        slashed = name.replace(".", "/")  # as MATLAB writes fields
        name = slashed if not header and slashed in self.names else name
        _require_no_gap(header, self._columns, name)
        if name in self.names:
            return name
        if kind := self.contents.unread.get(name):
            raise DataError(f"'{name}' is {kind}; expected an array of plain numbers or text")
        near = [each for each in self.names if each.casefold() == name.casefold()]
        near = near or difflib.get_close_matches(name, self.names, 1)
        hint = f"; did you mean '{near[0]}'?" if near else ""
        if meaning == "values" and not near and self._columns:
            likely = max(self._columns, key=lambda key: (len(self._columns[key]), is_reading(key)))
            hint = f"; try --values {likely}"
        raise ConfigurationError(
            f"cannot find the {meaning}: there is no '{name}'; {self.holds()}{hint}"
        )

    def holds(self) -> str:
        """Content of the file in words."""
        more = f" and {len(self.names) - MAX_NAMES} more" if len(self.names) > MAX_NAMES else ""
        tables = ", ".join(self.names[:MAX_NAMES]) + more or "no table that can be read"
        return f"the file holds {tables}{self.contents.remark}"

    def _answers(self, request: ReadRequest | None) -> Iterator[Answer]:
        """Contents of the file, or blocks of the tables that are wanted."""
        argument = {
            "path": str(self.path.absolute()),
            "options": self._options,
            "wanted": request and dataclasses.asdict(request),
        }
        limits = Limits(
            SECONDS + self._size // _BYTES_PER_SECOND, _MEMORY + _MEMORY_PER_BYTE * self._size
        )
        return read_in_subprocess(f"{__name__}:read_source", argument, b"", limits)


def read_source(argument: Any, content: bytes) -> Iterator[Answer]:  # noqa: ARG001
    """Read the contents of a file, or blocks of its tables, for `read_in_subprocess`."""
    try:
        reader = open_reader(Path(argument["path"]), **argument["options"])
        if argument["wanted"] is None:
            yield Answer(msgspec.to_builtins(reader.contents))
            return
        for block in reader.blocks(ReadRequest(**argument["wanted"])):
            yield Answer(0, block)
    except (OSError, UnicodeError, csv.Error) as error:
        raise DataError(f"cannot read it: {error}") from error


def open_reader(path: Path, sheet: str | None = None, header_row: int | None = None) -> Reader:
    """Reader of a file in this process; arguments and errors as for `Source`."""
    reader = _READERS.get(_known_ending(path), FieldReader)
    given = {"sheet": sheet, "header_row": header_row}
    options = {option: value for option, value in given.items() if value is not None}
    for option in options:
        kinds = [e for e, kind in _READERS.items() if option in signature(kind).parameters]
        if option not in signature(reader).parameters:
            raise ConfigurationError(
                f"{path.name} has no {option.replace('_', ' ')}; leave "
                f"--{option.replace('_', '-')} out, which is for {', '.join(kinds)}"
            )
    return field_reader(path) or reader(path, **options)


def _known_ending(path: Path) -> str:
    """Ending of a file, in lower case; raises ConfigurationError for another kind of file."""
    ending = ".eit" if path.is_dir() else path.suffix.lower()
    if ending not in (*_READERS, *FIELD):
        raise ConfigurationError(
            f"cannot recognise the format of {path.name} from its ending; expected "
            f"{', '.join((*_READERS, *FIELD))}, or a folder of .eit"
        )
    return ending


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


def _group_columns(header: Sequence[str]) -> dict[str, list[int]]:
    """Numbers of the columns of each table, by its name."""
    numbered: dict[str, dict[int, int]] = {}
    for column, name in enumerate(header):
        if match := _NUMBERED_NAME.fullmatch(name):
            numbered.setdefault(match[1], {})[int(match[2])] = column
    tables: dict[str, list[int]] = {}
    for prefix, columns in numbered.items():
        first = min(columns)
        run = list(itertools.takewhile(columns.__contains__, itertools.count(first)))
        if first == 0 or (first == 1 and len(run) > 1):
            tables[prefix] = [columns[number] for number in run]
    tables = pair_columns(header) | tables
    grouped = {column for columns in tables.values() for column in columns}
    single = ((name, column) for column, name in enumerate(header) if column not in grouped)
    tables |= {name: [column] for name, column in single if name}
    return tables


def _require_no_gap(header: Sequence[str], tables: Mapping[str, list[int]], name: str) -> None:
    """Raise DataError where numbered columns of a table are missing between others."""
    beyond = [
        h for h in header if (m := _NUMBERED_NAME.fullmatch(h)) and m[1] == name and h in tables
    ]
    if name in tables and beyond:
        last = header[tables[name][-1]]
        raise DataError(
            f"the columns of '{name}' must be numbered without a gap, but after {last} comes "
            f"{beyond[0]}; name them by --values FIRST..LAST where none is missing"
        )
