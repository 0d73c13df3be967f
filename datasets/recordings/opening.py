"""Opening a recording's file by its ending."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Final

from eitskin.datasets.recordings.array_files import Hdf5Source, MatSource, NpzSource
from eitskin.datasets.recordings.source import Source
from eitskin.datasets.recordings.table_files import ParquetSource, SpreadsheetSource
from eitskin.datasets.recordings.text_files import OPENEIT, CsvSource, OpenEitSource
from eitskin.errors import ConfigurationError, DataError

_HDF5_MARK: Final = b"MATLAB 7.3"


def open_here(path: Path, sheet: str | None = None) -> Source:
    """Source of the file, read in this process; see `contained_source`.

    Args:
        path: of the file.
        sheet: name of the sheet, for a file that has sheets.

    Raises:
        DataError: where the file is missing, cannot be read, or is damaged.
        ConfigurationError: for another kind of file.
    """
    ending = known_ending(path)
    if ending in _SHEETS:
        return SpreadsheetSource(path, sheet)
    if sheet is not None:
        raise ConfigurationError(
            f"{path.name} has no sheets; leave --sheet out, which is for {', '.join(_SHEETS)}"
        )
    return _SOURCES[ending](path)


def known_ending(path: Path) -> str:
    """Ending of a file, in lower case; raises ConfigurationError for another kind of file."""
    ending = path.suffix.lower()
    if ending not in _SOURCES:
        raise ConfigurationError(
            f"cannot tell the format of {path.name} from its ending; expected {', '.join(_SOURCES)}"
        )
    return ending


def _open_mat(path: Path) -> Source:
    """MATLAB file of any version, from what its first bytes say."""
    with path.open("rb") as file:
        newest = file.read(len(_HDF5_MARK)) == _HDF5_MARK
    return Hdf5Source(path) if newest else MatSource(path)


def _open_text(path: Path) -> Source:
    """OpenEIT's lines where there are any, else columns."""
    try:
        return OpenEitSource(path)
    except DataError:
        with path.open(encoding="utf-8") as file:
            if any(line.lstrip().startswith(OPENEIT) for line in file):
                raise
        return CsvSource(path)


_SHEETS: Final = (".xlsx", ".xlsm")
_SOURCES: Final[Mapping[str, Callable[[Path], Source]]] = {
    ".csv": CsvSource,
    ".tsv": CsvSource,
    ".xlsx": SpreadsheetSource,
    ".xlsm": SpreadsheetSource,
    ".parquet": ParquetSource,
    ".mat": _open_mat,
    ".npz": NpzSource,
    ".h5": Hdf5Source,
    ".hdf5": Hdf5Source,
    ".txt": _open_text,
    ".dat": CsvSource,
}
