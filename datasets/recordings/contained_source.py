"""Sources whose files are read in a child, since readers of some formats crash on damage."""

import csv
import dataclasses
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

from eitskin.contained import Answer, Limits, contained
from eitskin.datasets.recordings.opening import known_ending, open_here
from eitskin.datasets.recordings.row_source import RowSource
from eitskin.datasets.recordings.source import Source, Tables, Wanted
from eitskin.errors import DataError
from eitskin.input_files import require_regular

MOST_BYTES: Final = 1 << 36
"""Largest size of a file of a recording [bytes]."""

SECONDS: Final = 30
"""Processor time for a block of the smallest of files [s]."""

_BYTES_PER_SECOND: Final = 100_000  # of a spreadsheet, the slowest to read
_MEMORY, _MEMORY_PER_BYTE = 400 << 20, 40  # [bytes]
_READER: Final = f"{__name__}:read_source"


def open_source(path: Path, sheet: str | None = None) -> Source:
    """Source of a file that is read in a child.

    Args:
        path: of the file.
        sheet: name of the sheet, for a file that has sheets.

    Raises:
        DataError: where the file is missing, no regular one, damaged, or takes too much to read.
        ConfigurationError: for another kind of file.
        ImportError: where the package that reads the file is not installed.
    """
    known_ending(path)
    size = path.stat().st_size
    require_regular(path, MOST_BYTES, DataError)
    reading = _Reading(path, sheet, size)
    (head,) = reading.answers()
    return _Rows(reading, head.data) if "header" in head.data else _Arrays(reading, head.data)


def read_source(argument: Any, content: bytes) -> Iterator[Answer]:  # noqa: ARG001
    """Read what a source says of itself, or blocks of it, as a reader for `contained`."""
    with _as_data_errors():
        source = open_here(Path(argument["path"]), argument["sheet"])
        if argument["wanted"] is None:
            yield Answer(_head(source))
            return
        wanted = Wanted(**argument["wanted"])
        if isinstance(source, RowSource):
            source.columns |= argument["columns"]
        for block in source.blocks(wanted):
            yield Answer(0, block)


@dataclasses.dataclass(frozen=True, slots=True)
class _Reading:
    """File to be read in a child."""

    path: Path
    sheet: str | None
    size: int

    def answers(
        self, wanted: Wanted | None = None, columns: dict[str, list[int]] | None = None
    ) -> Iterator[Answer]:
        """Head of the source, or blocks of the tables that are wanted."""
        argument = {
            "path": str(self.path.absolute()),
            "sheet": self.sheet,
            "wanted": wanted and dataclasses.asdict(wanted),
            "columns": columns,
        }
        limits = Limits(
            SECONDS + self.size // _BYTES_PER_SECOND, _MEMORY + _MEMORY_PER_BYTE * self.size
        )
        return contained(_READER, argument, b"", limits)


def _head(source: Source) -> dict[str, Any]:
    head = {
        "names": list(source.names),
        "unread": dict(source.unread),
        "usual": source.usual_values,
        "holds": source.holds(),
    }
    return head | ({"header": source.header} if isinstance(source, RowSource) else {})


class _Arrays(Source):
    """Source of named arrays in a child."""

    def __init__(self, reading: _Reading, head: dict[str, Any]) -> None:
        super().__init__(reading.path)
        self.names, self.unread = tuple(head["names"]), head["unread"]
        self.usual_values = head["usual"]
        self._reading = reading

    def blocks(self, wanted: Wanted) -> Iterator[Tables]:
        for answer in self._reading.answers(wanted):
            yield answer.arrays


class _Rows(RowSource):
    """Source of rows under a header in a child."""

    def __init__(self, reading: _Reading, head: dict[str, Any]) -> None:
        super().__init__(reading.path, head["header"])
        self._reading, self._holds = reading, str(head["holds"])

    def rows(self) -> Iterator[tuple[int, Sequence[str]]]:
        raise NotImplementedError  # the child reads them

    def blocks(self, wanted: Wanted) -> Iterator[Tables]:
        columns = {name: self.columns[name] for name in (*wanted.values, *wanted.labels)}
        for answer in self._reading.answers(wanted, columns):
            yield answer.arrays

    def holds(self) -> str:
        return self._holds


@contextmanager
def _as_data_errors() -> Iterator[None]:
    """Raise errors of files and their text as DataError."""
    try:
        yield
    except UnicodeDecodeError as error:
        raise DataError(f"cannot read it: {error}; save it as text in UTF-8") from error
    except (OSError, csv.Error) as error:
        raise DataError(f"cannot read it: {error}") from error
