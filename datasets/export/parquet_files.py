"""Parquet files of one table, numbered and bounded in size."""

import contextlib
from pathlib import Path
from typing import Any

from eitskin.extras import require

FILE_BYTES = 1 << 28
"""Size in memory of the rows of one file [bytes]."""
GROUP_BYTES = 1 << 25
"""Size in memory of the rows that are kept before they are written [bytes]."""


class ParquetFiles:
    """Writer of the rows of one table to files `STEM-00000-of-00003.parquet`.

    No more than `GROUP_BYTES` and one table are kept in memory. Equal tables give equal bytes, with
    the same pyarrow. The files get their names when the writer is closed.

    Attributes:
        rows: number of rows so far.
        size: of these rows in memory [bytes].
    """

    def __init__(self, folder: Path, stem: str, file_bytes: int = FILE_BYTES) -> None:
        """Begin without files.

        Args:
            folder: of the files; it exists.
            stem: beginning of their names.
            file_bytes: size in memory of the rows of one file, beyond which the next one begins.
        """
        self.rows = self.size = 0
        self._folder, self._stem, self._file_bytes = folder, stem, file_bytes
        self._group_bytes = min(GROUP_BYTES, file_bytes)
        self._kept: list[Any] = []
        self._parts: list[Path] = []
        self._writer: Any = None
        self._in_file = 0

    def write(self, table: Any) -> None:
        """Append the rows of a table; all tables have one schema."""
        self._kept.append(table)
        self.rows += table.num_rows
        self.size += table.nbytes
        if sum(each.nbytes for each in self._kept) >= self._group_bytes:
            self._flush()

    def close(self) -> list[Path]:
        """Write what is kept, and give all files their names; returns their paths."""
        self._flush()
        self._end_file()
        paths = []
        for number, part in enumerate(self._parts):
            name = f"{self._stem}-{number:05d}-of-{len(self._parts):05d}.parquet"
            paths.append(part.rename(self._folder / name))
        return paths

    def abandon(self) -> None:
        """Close an unfinished file, whose folder is about to be removed."""
        if self._writer is not None:
            with contextlib.suppress(OSError):  # a full disk has been told already
                self._writer.close()
            self._writer = None

    def _flush(self) -> None:
        if not self._kept:
            return
        arrow, parquet = require("pyarrow", "recordings"), require("pyarrow.parquet", "recordings")
        table = arrow.concat_tables(self._kept)
        self._kept = []
        most = max(1, self._group_bytes * table.num_rows // max(table.nbytes, 1))
        for start in range(0, table.num_rows, most):
            piece = table.slice(start, most)
            if self._writer is None:
                self._parts.append(self._folder / f"{self._stem}-{len(self._parts):05d}.part")
                self._writer = parquet.ParquetWriter(
                    self._parts[-1], table.schema, compression="zstd"
                )
            self._writer.write_table(piece, row_group_size=piece.num_rows)
            self._in_file += piece.nbytes
            if self._in_file >= self._file_bytes:
                self._end_file()

    def _end_file(self) -> None:
        if self._writer is not None:
            self._writer.close()
        self._writer, self._in_file = None, 0
