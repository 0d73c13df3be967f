"""Recordings as tables with a column for each channel and label: text, Excel and Parquet files."""

import codecs
import csv
import io
import itertools
import re
from abc import abstractmethod
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from eitskin.datasets.recordings.reader import Contents, Reader, ReadRequest, Tables, as_data_errors
from eitskin.errors import ConfigurationError, DataError
from eitskin.extras import require
from eitskin.files import shorten_text

if TYPE_CHECKING:
    import pandas as pd

EXTRA: Final = "recordings"
_DELIMITERS: Final = ",;\t"
MIN_NUMBERED: Final = 3  # columns that are named by numbers in turn
_BLOCK_BYTES: Final = 1 << 20
_SAMPLE: Final = 1000  # lines, among which the header is
_BRACKETS: Final = re.compile(r"\s*[\[{(<]+([^\[\](){}<>]*)[\])}>]*\s*[,;]?\s*")
_REMARK: Final = re.compile(r"\s+(?:#|//)\s.*")
_LABEL: Final = re.compile(
    r"\s*(?:\d{4}-\d\d-\d\d[ T][\d:.,]+\W+(?:[A-Z]+\W+)?)?"
    r"(?:([A-Za-z_][\w -]{0,40}?)\s*[:=]|\d{1,2}:\d\d:\d\d(?:[.,]\d+)?\s*->)\s*(?=[-+\d.\[({])"
)
"""Beginning of a line of numbers: "magnitudes : ", or the time that a terminal puts there."""
_DECIMAL_COMMA: Final = re.compile(r"\d,\d")
_UNITS: Final = re.compile(r"[\[(][^\d]{1,8}[\])]|[mu]?s|k?ohm|[mu]?[VA]|[cm]?m|N|deg", re.I)
_HEXADECIMAL: Final = re.compile(r"0x[\da-f]+|(?=.*\d)[\da-f]{4,}", re.IGNORECASE)
HEXADECIMAL: Final = "hexadecimal numbers, whose sign is unknown, are not read: write decimal ones"
_COMMENTS: Final = ("#", "%")
_EMPTY: Final = ("", "nan", "NaN", "NAN", "NA", "N/A", "n/a", "null", "NULL", "None")


class TableReader(Reader):
    """Reader of a file with one row of cells for each frame, below names of columns."""

    @abstractmethod
    def cells(self, columns: Sequence[int], request: ReadRequest) -> "pd.DataFrame":
        """Cells of some columns by number; row numbers are the index."""

    def tables(self, request: ReadRequest) -> Tables:
        columns = request.columns
        chosen = sorted({number for numbers in columns.values() for number in numbers})
        frame = self.cells(chosen, request)
        tables = {
            name: self._table(frame[columns[name]], name in request.values, request.loses_cells)
            for name in (*request.values, *request.labels)
        }
        if request.transposed:
            tables |= {name: tables[name].T for name in request.values}
        return tables

    def _table(self, cells: "pd.DataFrame", numeric: bool, loses: bool) -> NDArray[Any]:
        """Cells as a table (rows, columns) of numbers, or of text where it need not be numeric."""
        columns, rows = [], cells.index.tolist()
        for number in cells:
            array = _array(cells[number], rows, self.contents.header[number])
            if numeric and array.dtype.kind not in "iufc":
                array = _numbers(array, rows, self.contents.header[number], loses)
            columns.append(array)
        if len({array.dtype.kind == "U" for array in columns}) > 1:
            columns = [array.astype(np.str_) for array in columns]
        return np.concatenate(columns, axis=1)


class TextReader(TableReader):
    """Text with cells between commas, semicolons, tabs or blanks, and decimal points or commas.

    Lines that begin with # or % are comments; brackets around a line and separators behind it are
    left out, as are a preamble of fewer cells, and units below the header. The columns of a file
    without a header are named by the last comment before the numbers, where that has as many names,
    else c0, c1 ... Where the longest line begins with a label, as "magnitudes : a , b, ..." of
    OpenEIT, all others are left out, and the label names the columns.
    """

    def __init__(self, path: Path, header_row: int | None = None) -> None:
        super().__init__(path)
        self._encoding = _encoding(path)
        self._first = 0
        self._label: str | None = None
        sample = list(itertools.islice(self._lines(), _SAMPLE))
        widest = max((line for _, line in sample), key=_most_cells, default="")
        if label := _LABEL.match(widest):
            self._label = _label_word(label)
            sample = list(itertools.islice(self._lines(), _SAMPLE))
            widest = max((line for _, line in sample), key=_most_cells)
        self._delimiter, self._decimal = _separators(widest)
        rows = [self._cells(line) for _, line in sample]
        begin = find_header(rows, [number for number, _ in sample], header_row)
        rows = rows[begin:]
        widths = [len(_without_empty_end(row)) for row in rows]
        width = max(widths, default=0)
        header, remark = rows[0][:width] if rows else [], ""
        if _are_values(header):  # the first line may have lost its beginning
            width = max(widths, key=widths.count)
            header = rows[widths.index(width)][:width]
        if self._label:
            header = [f"{self._label}{column}" for column in range(len(header))]
        elif _are_values(header):
            remark = " (the file has no header, so columns are numbered)"
            names = self._cells(self._last_comment())
            numbered = [
                f"c{column}" if is_number(cell) or not cell else f"text{column}"
                for column, cell in enumerate(header)
            ]
            header = names if len(names) == len(header) else numbered
        else:
            if all(map(_HEXADECIMAL.fullmatch, header)) and any(c[0].isdigit() for c in header):
                raise DataError(f"row {sample[begin][0]} has no names of columns; {HEXADECIMAL}")
            header = [f"v{cell}" if cell.isdecimal() else cell for cell in header]
            begin += 1
            begin += bool(rows[1:]) and all(map(_UNITS.fullmatch, filter(None, rows[1])))
        self._first = sample[begin][0] if begin < len(sample) else 0
        if not self._first:
            raise DataError("expected a header and at least one row, got no row")
        usual = self._label or "v"
        self.contents = Contents(header=tuple(header), usual_values=usual, remark=remark)

    def cells(self, columns: Sequence[int], request: ReadRequest) -> "pd.DataFrame":
        import pandas as pd

        numeric = {number for name in request.values for number in request.columns[name]}
        width = len(self.contents.header)
        lines = {n: self._cut(line, width) for n, line in self._lines() if n >= self._first}
        for number, line in list(lines.items()):
            if (count := self._count(line)) != width:
                if request.drops_rows:
                    del lines[number]
                    continue
                raise DataError(
                    f"row {number}: expected {width} cells, got {count}: "
                    f"'{shorten_text(line)}'; --header-row names the row of the columns' names, "
                    "and --bad-values drop leaves such rows out"
                )
        frame = pd.read_csv(
            io.StringIO("\n".join(lines.values())),
            sep=r"\s+" if self._delimiter == " " else self._delimiter,
            decimal=self._decimal,
            header=None,
            names=list(range(width)),
            usecols=list(columns),
            dtype=dict.fromkeys(set(columns) - set(numeric), str),
            keep_default_na=False,
            na_values=dict.fromkeys(numeric, _EMPTY),
            skipinitialspace=True,
            low_memory=False,
        )
        if len(frame) != len(lines):
            raise DataError(
                "a quotation mark is not closed in its line; expected an even number in each"
            )
        if self._decimal == ",":
            text = frame.select_dtypes("str")
            frame[text.columns] = text.replace(",", ".", regex=True)
        return frame.set_axis(list(lines))

    def _lines(self) -> Iterator[tuple[int, str]]:
        """Lines that hold cells, each with its number in the file from 1."""
        with self.path.open(encoding=self._encoding) as file:
            for number, line in enumerate(file, 1):
                text = line.rstrip("\r\n")
                if self._label is not None:
                    label = _LABEL.match(text)
                    same = label is not None and _label_word(label) == self._label
                    text = text[label.end() :] if label and same else ""
                text = _REMARK.sub("", text)
                if brackets := _BRACKETS.fullmatch(text):
                    text = brackets[1]
                if text.strip(f'{_DELIMITERS}" ') and not text.startswith(_COMMENTS):
                    yield number, text

    def _last_comment(self) -> str:
        """Last comment before the first cells, without its sign."""
        with self.path.open(encoding=self._encoding) as file:
            lines = (line.strip() for line in file)
            above = list(itertools.takewhile(lambda line: not line or line[0] in "#%", lines))
        return next((line.lstrip("#%").strip() for line in reversed(above) if line), "")

    def _cells(self, line: str) -> list[str]:
        if self._delimiter == " ":
            line = line.strip()
        reader = csv.reader([line], delimiter=self._delimiter, skipinitialspace=True)
        return [cell.strip().replace(self._decimal, ".") for cell in next(reader, [])]

    def _cut(self, line: str, width: int) -> str:
        """Line without the separators behind its last cell."""
        while self._count(line) > width and line.rstrip(" ").endswith(self._delimiter):
            line = line.rstrip(" ")[:-1]
        return line

    def _count(self, line: str) -> int:
        """Number of cells of a line."""
        if '"' in line:
            return len(self._cells(line))
        return len(line.split()) if self._delimiter == " " else line.count(self._delimiter) + 1


class HeldReader(TableReader):
    """Reader of a file whose cells are held in memory, rows as they are numbered in the file."""

    _rows: "pd.DataFrame"

    def cells(self, columns: Sequence[int], request: ReadRequest) -> "pd.DataFrame":  # noqa: ARG002
        return self._rows.set_axis(range(self._rows.shape[1]), axis=1)[list(columns)]


class SpreadsheetReader(HeldReader):
    """First sheet of an Excel file, or named ones side by side; values of formulas, as saved."""

    def __init__(self, path: Path, sheet: str | None = None, header_row: int | None = None) -> None:
        """Read the header of a sheet, the first one when omitted."""
        import pandas as pd

        super().__init__(path)
        require("openpyxl", EXTRA)
        with as_data_errors("Excel file"), pd.ExcelFile(path, engine="openpyxl") as book:
            sheets = book.sheet_names[:1] if sheet is None else [sheet]
            if sheet is not None and sheet not in book.sheet_names:
                sheets = [each.strip() for each in sheet.split(",")]
            for each in sheets:
                if each not in book.sheet_names:
                    raise ConfigurationError(
                        f"there is no sheet '{each}'; the file has {', '.join(book.sheet_names)}"
                    )
            pages = [book.parse(sheet, header=None, dtype=str, na_filter=False) for sheet in sheets]
        if len({len(page) for page in pages}) > 1:
            raise DataError(
                "expected sheets with equal numbers of rows, got "
                f"{', '.join(f'{len(p)} in {n}' for p, n in zip(pages, sheets, strict=True))}"
            )
        cells = pd.concat(pages, axis=1, ignore_index=True).map(str.strip)
        cells.index += 1
        begin = find_header(
            cells[:_SAMPLE].to_numpy().tolist(), range(1, len(cells) + 1), header_row
        )
        header = _without_empty_end(cells.iloc[begin].tolist() if len(cells) else [])
        cells = cells.iloc[begin + 1 :]
        cells = cells[(cells != "").any(axis=1)]
        beyond = (cells.iloc[:, len(header) :] != "").any(axis=1)
        if beyond.any():
            raise DataError(f"row {beyond.idxmax()}: expected {len(header)} cells, got more")
        if cells.empty:
            others = ", ".join(each for each in book.sheet_names if each not in sheets)
            more = f"; other sheets, for --sheet, are {others}" if others else ""
            raise DataError(f"expected a header and at least one row, got no row{more}")
        self._rows = cells
        self.contents = Contents(header=tuple(header), usual_values="v")


class JsonReader(HeldReader):
    """JSON: an object with the same names in each line, or an array of such objects."""

    def __init__(self, path: Path) -> None:
        import pandas as pd

        super().__init__(path)
        with as_data_errors("JSON file of one object for each frame"):
            encoding = _encoding(path)
            whole = path.suffix.lower() == ".json" and path.read_text(encoding)[:1] == "["
            read = pd.read_json(path, lines=not whole, convert_dates=False, encoding=encoding)
            inner = [cell for cell in read.iloc[0] if isinstance(cell, list)]
            if len(read) == 1 and len(inner) == 1 and all(isinstance(e, dict) for e in inner[0]):
                read = pd.DataFrame(inner[0])  # {"frames": [{...}, {...}]}
            elif len(read) == 1 and any(isinstance(e[0], list) for e in inner if e):
                read = pd.DataFrame({k: c for k, (c,) in read.items() if isinstance(c, list)})
            self._rows = read.map(lambda cell: np.array(cell) if isinstance(cell, list) else cell)
        self._rows.index += 1
        self.contents = Contents(header=tuple(map(str, read.columns)), usual_values="v")


class ParquetReader(TableReader):
    """Parquet file; a column of lists of equal length is a table."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        parquet = require("pyarrow.parquet", EXTRA)
        with as_data_errors("Parquet file"):
            self._file = parquet.ParquetFile(path)
        self.contents = Contents(header=tuple(self._file.schema_arrow.names), usual_values="v")
        if not self._file.metadata.num_rows:
            raise DataError("expected at least one row, got none")

    def cells(self, columns: Sequence[int], request: ReadRequest) -> "pd.DataFrame":  # noqa: ARG002
        names = [self.contents.header[number] for number in columns]
        with as_data_errors("Parquet file"):
            return self._file.read(names).to_pandas().set_axis(list(columns), axis=1)


def find_header(rows: list[list[str]], numbers: Sequence[int], row: int | None = None) -> int:
    """Place of the row with the names of the columns, or of the first one of a file without.

    Rows of a preamble have at most half as many cells as the widest row. `row` is the row's
    number in the file, of `numbers`; raises DataError where it holds no cells.
    """
    if row is not None and row not in numbers:
        raise DataError(
            f"there are no names of columns in row {row}; the first rows with cells are "
            f"{', '.join(map(str, numbers[:3]))}: correct --header-row"
        )
    if row is not None:
        return numbers.index(row)
    filled = [sum(map(bool, row)) for row in rows]
    wide = [place for place, n in enumerate(filled) if 2 * n > max(filled)]
    above = list(itertools.takewhile(lambda place: not _are_values(rows[place]), wide))
    named = (place for place in above if len({*filter(None, rows[place])}) == filled[place])
    return next(named, (wide or [0])[0])


def _encoding(path: Path) -> str:
    """Encoding of a text file: by its byte order mark, UTF-8, or Latin-1 where it is neither."""
    with path.open("rb") as file:
        start = file.read(2)
        if start in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE):
            return "utf-16"
        if len(start) == 2 and 0 in start and any(start):
            return "utf-16-be" if start[0] == 0 else "utf-16-le"
        file.seek(0)
        decoder = codecs.getincrementaldecoder("utf-8")()
        try:
            while block := file.read(_BLOCK_BYTES):
                decoder.decode(block)
        except UnicodeDecodeError:
            return "latin-1"
    return "utf-8-sig"


def _are_values(row: Sequence[str]) -> bool:
    """Whether most cells of a row are numbers, other than 0, 1, 2 ... or 1, 2, 3 ... as names."""
    cells = [cell for cell in row if cell]
    numbers = [cell for cell in cells if is_number(cell)]
    counted = [str(number) for number in range(len(numbers) + 1)]
    return 2 * len(numbers) > len(cells) and (
        len(numbers) < MIN_NUMBERED or numbers not in (counted[:-1], counted[1:])
    )


def _without_empty_end(row: list[str]) -> list[str]:
    """Cells up to the last one that is not empty."""
    return row[: max((place for place, cell in enumerate(row, 1) if cell), default=0)]


def _label_word(label: re.Match[str]) -> str:
    """Word of a label, without a number that counts the lines."""
    return re.sub(r"[\W\d]+", "", label[1] or "")


def _most_cells(line: str) -> tuple[int, bool]:
    """Number of separators of the most frequent kind; and whether there are decimal commas."""
    separators = max(*map(line.count, _DELIMITERS + "|"), len(line.split()) - 1)
    return separators, bool(_DECIMAL_COMMA.search(line))


def _separators(line: str) -> tuple[str, str]:
    """Separator of cells and decimal mark of a line; a comma is either, and a cell has one mark."""
    commas, sign = line.count(","), "," if _DECIMAL_COMMA.search(line) else "."
    bars = "" if re.search(r"\|\s*[,;\t]|[,;\t]\s*\|", line) else "|"  # |Z0|, |Z1| are names
    for delimiter in ";\t" + bars:
        if line.count(delimiter) and line.count(delimiter) + 1 >= commas:
            return delimiter, "," if delimiter == ";" else sign
    cells = line.split()
    numbers = [cell.replace(",", ".") for cell in cells]
    if commas and not (len(cells) > 1 and all(map(is_number, numbers)) and sign == ","):
        return ",", "."
    return " ", sign


def is_number(text: str) -> bool:
    """Whether a cell is a real number."""
    try:
        float(text)
    except ValueError:
        return False
    return True


def _array(cells: "pd.Series[Any]", rows: Sequence[int], title: str) -> NDArray[Any]:
    """Numbers, times or text of a column, (rows, 1), or its lists of numbers, (rows, length)."""
    kind = cells.dtype.kind
    if kind in "biufcM":
        return np.asarray(cells.to_numpy("datetime64[us]" if kind == "M" else None))[:, None]
    lists = [cell for cell in cells if isinstance(cell, np.ndarray)]
    if not lists:
        return np.char.strip(cells.fillna("").to_numpy(np.str_))[:, None]
    for row, cell in zip(rows, cells, strict=True):
        if np.size(cell) != len(lists[0]):
            raise DataError(
                f"row {row} of '{title}': expected {len(lists[0])} values as in the first row, got "
                f"{0 if cell is None else np.size(cell)}"
            )
    return np.stack(lists).astype(np.float64)


def _numbers(
    cells: NDArray[Any], rows: Sequence[int], title: str, loses: bool = False
) -> NDArray[Any]:
    """Text as real or complex numbers, NaN where empty; raises DataError."""
    numbers = np.full(cells.shape, np.nan, dtype=np.complex128)
    for place, cell in np.ndenumerate(cells):
        text = re.sub(r"[ *]", "", str(cell)).replace("+-", "-").replace("i", "j")
        if text.count(",") == 1 and "." not in text:
            text = text.replace(",", ".")  # in a cell of its own, as spreadsheets keep it
        try:
            numbers[place] = complex(re.sub(r"(?<=\d)[dD](?=[-+\d])", "e", text) or "nan")
        except ValueError:
            hexadecimal = _HEXADECIMAL.fullmatch(text)
            if loses and not (hexadecimal and text.startswith("0x")):
                continue
            remedy = HEXADECIMAL if hexadecimal else "--bad-values mark or drop takes it for lost"
            raise DataError(
                f"row {rows[place[0]]}, column {title}: expected a number such as 530.1 or "
                f"530.1-2j, got '{shorten_text(str(cell))}'; {remedy}"
            ) from None
    return numbers if numbers.imag.any() else numbers.real
