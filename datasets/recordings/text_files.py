"""Recordings in text files: columns with or without a header, and OpenEIT's lines."""

import csv
import itertools
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final

import numpy as np

from eitskin.datasets.recordings.row_source import RowSource, is_number
from eitskin.datasets.recordings.source import Source, Tables, Wanted
from eitskin.errors import ConfigurationError, DataError

OPENEIT: Final = "magnitudes"
_DELIMITERS: Final = ",;\t"
_COMMENTS: Final = ("#", "%")


class CsvSource(RowSource):
    """Text with cells between commas, semicolons, tabs or blanks; decimal commas with semicolons.

    Lines that begin with # or % are comments. The columns of a file without a header are named by
    the last comment before the numbers, where that has as many names, else c0, c1 ...
    """

    def __init__(self, path: Path) -> None:
        first, comment = self._first_line(path)
        self._delimiter = max(_DELIMITERS, key=first.count)
        if self._delimiter not in first:
            self._delimiter = " "
        header, said = self._cells(first), self._cells(comment)
        self._headless = bool(header) and all(is_number(cell) for cell in header)
        if self._headless:
            numbered = [f"c{column}" for column in range(len(header))]
            header = said if len(said) == len(header) else numbered
        super().__init__(path, header)
        if next(self.rows(), None) is None:
            raise DataError("expected a header and at least one row, got no row")

    def rows(self) -> Iterator[tuple[int, Sequence[str]]]:
        commas = self._delimiter == ";"
        with self.path.open(newline="", encoding="utf-8-sig") as file:
            reader = csv.reader(file, delimiter=self._delimiter, skipinitialspace=True)
            lines = (row for row in reader if any(row) and not row[0].startswith(_COMMENTS))
            if not self._headless:
                next(lines, None)
            for row in lines:
                cells = [cell.replace(",", ".") for cell in row] if commas else row
                if self._delimiter == " " and not cells[-1]:
                    cells.pop()  # blanks at the end of the line
                if len(cells) != len(self.header):
                    raise DataError(
                        f"row {reader.line_num}: expected {len(self.header)} cells, got "
                        f"{len(cells)}"
                    )
                yield reader.line_num, cells

    def holds(self) -> str:
        named = "" if not self._headless else " (the file has no header, so columns are numbered)"
        return super().holds() + named

    def _first_line(self, path: Path) -> tuple[str, str]:
        """First line that is no comment, and the last comment before it, without its sign."""
        comment = ""
        with path.open(newline="", encoding="utf-8-sig") as file:
            for line in file:
                if line.strip() and not line.startswith(_COMMENTS):
                    return line.rstrip(), comment
                comment = line.lstrip("".join(_COMMENTS)).strip() if line.strip() else comment
        return "", comment

    def _cells(self, line: str) -> list[str]:
        reader = csv.reader([line], delimiter=self._delimiter, skipinitialspace=True)
        decimal = "," if self._delimiter == ";" else "."
        return [cell.strip().replace(decimal, ".") for cell in next(reader, [])]


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
        while block := list(itertools.islice(frames, wanted.block_rows)):
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
