"""Sources of recordings: tables of numbers or text by name, read in blocks of rows."""

import difflib
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from numpy.typing import NDArray

from eitskin.errors import ConfigurationError, DataError

Tables = Mapping[str, NDArray[Any]]
"""Tables of equally many rows by name, each (rows, columns)."""

BLOCK_ROWS: Final = 8192


@dataclass(frozen=True, slots=True)
class Wanted:
    """Tables to read from a source.

    Attributes:
        values: tables of measurements; the first one says how many rows there are.
        labels: tables with a row for each row of the values.
        transposed: whether the measurements have frames along their second axis.
        paired: whether a table of labels may have one row for each pair of rows of the values.
        block_rows: number of rows of a block; even, so that readings before and during a press stay
            together.
    """

    values: tuple[str, ...]
    labels: tuple[str, ...] = ()
    transposed: bool = False
    paired: bool = False
    block_rows: int = BLOCK_ROWS


class Source(ABC):
    """File of a recording.

    Attributes:
        path: of the file.
        names: tables in the file that can be read.
        unread: tables in the file that cannot be read, each with its kind.
        usual_values: name of the measurements in files of this kind; None where there is none.
    """

    usual_values: str | None = None

    def __init__(self, path: Path) -> None:
        """Read the names of the tables.

        Args:
            path: of the file.

        Raises:
            DataError: where the file cannot be read.
        """
        self.path = path
        self.names: tuple[str, ...] = ()
        self.unread: Mapping[str, str] = {}

    @abstractmethod
    def blocks(self, wanted: Wanted) -> Iterator[Tables]:
        """Tables of consecutive rows, `wanted.block_rows` in all but the last ones.

        Raises:
            DataError: where the content cannot be used.
        """

    def require(self, name: str, meaning: str) -> str:
        """Return `name`, the table with that meaning; raises ConfigurationError for no such one."""
        if name in self.names:
            return name
        if name in self.unread:
            raise DataError(
                f"'{name}' is {self.unread[name]}; expected an array of plain numbers or text"
            )
        near = [each for each in self.names if each.casefold() == name.casefold()]
        near = near or difflib.get_close_matches(name, self.names, 1)
        hint = f"; did you mean '{near[0]}'?" if near else ""
        raise ConfigurationError(
            f"cannot find the {meaning}: there is no '{name}'; {self.holds()}{hint}"
        )

    def holds(self) -> str:
        """Content of the file in words."""
        return f"the file holds {', '.join(self.names) or 'no table that can be read'}"
