"""Base of the readers of files of recordings: tables by name, read in blocks of rows."""

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from numpy.typing import NDArray

from eitskin.errors import ConfigurationError, DataError

Tables = Mapping[str, NDArray[Any]]
"""Tables of equally many rows by name, each (rows, columns)."""

BLOCK_ROWS: Final = 8192


@dataclass(frozen=True, slots=True)
class ReadRequest:
    """Tables to read from a file.

    Attributes:
        values: tables of measurements; the first one says how many rows there are.
        labels: tables with a row for each row of the values.
        columns: numbers of each table's columns, in files of columns.
        transposed: whether the measurements have frames along their second axis.
        paired: whether a table of labels may have one row for each pair of rows of the values.
        block_rows: number of rows of a block; even, so that readings before and during a press stay
            together.
        loses_cells: whether cells of values that are no numbers are lost, not refused.
        drops_rows: whether rows of another number of cells are left out, not refused.
    """

    values: tuple[str, ...]
    labels: tuple[str, ...] = ()
    columns: Mapping[str, list[int]] = field(default_factory=dict)
    transposed: bool = False
    paired: bool = False
    block_rows: int = BLOCK_ROWS
    loses_cells: bool = False
    drops_rows: bool = False


@dataclass(frozen=True, slots=True)
class Contents:
    """Contents of a file.

    Attributes:
        names: tables that can be read; none in a file of columns.
        unread: tables that cannot be read, each with its kind.
        header: names of the columns in a file of columns.
        usual_values: name of the measurements in such files; None where there is none.
        remark: remark on the names, for messages.
        measured: drive+, drive-, sense+ and sense- of each measurement, where the file says so.
        currents: currents of the measurements [A], where the values are voltages and the file says
            so.
        electrodes: number of them.
        order: order of the readings, as `RecordingForm` has it.
        driven: whether readings of driven electrodes are among them, to be left out.
        patterns: tables with the drive and the sense patterns of the measurements; none elsewhere.
    """

    names: tuple[str, ...] = ()
    unread: Mapping[str, str] = field(default_factory=dict)
    header: tuple[str, ...] = ()
    usual_values: str | None = None
    remark: str = ""
    measured: tuple[tuple[int, int, int, int], ...] = ()
    currents: tuple[float, ...] = ()
    electrodes: int = 0
    order: str = ""
    driven: bool = False
    patterns: tuple[str, ...] = ()


class Reader(ABC):
    """Reader of one kind of file."""

    contents: Contents

    def __init__(self, path: Path) -> None:
        """Begin with the file at `path`; a subclass reads its contents, or raises DataError."""
        self.path = path

    @abstractmethod
    def tables(self, request: ReadRequest) -> Tables:
        """Whole tables that are wanted, of equally many rows; raises DataError."""

    def blocks(self, request: ReadRequest) -> Iterator[Tables]:
        """Tables of consecutive rows, `request.block_rows` in all but the last."""
        tables = self.tables(request)
        for start in range(0, len(tables[request.values[0]]), request.block_rows):
            yield {name: each[start : start + request.block_rows] for name, each in tables.items()}


@contextmanager
def as_data_errors(kind: str) -> Iterator[None]:
    """Raise the errors of a file format's reader as DataError, absent files excepted."""
    try:
        yield
    except (ConfigurationError, DataError, FileNotFoundError, ImportError, PermissionError):
        raise
    except Exception as error:  # readers' errors for damaged files have no common base
        raise DataError(f"not a {kind} that can be read: {error}") from error
