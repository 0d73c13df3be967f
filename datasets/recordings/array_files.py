"""Recordings as named arrays: MATLAB, NumPy and HDF5 files."""

from abc import abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import h5py
import numpy as np
from numpy.typing import NDArray

from eitskin.datasets.recordings.source import Source, Tables, Wanted
from eitskin.datasets.store.stored_arrays import require_stored
from eitskin.errors import DataError

_MATLAB_NUMBERS: Final = {"double", "single", "logical"} | {
    f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)
}
_MATLAB_COMPLEX: Final = ("real", "imag")


class ArraySource(Source):
    """File of named arrays, of which the measurements are read in blocks."""

    @abstractmethod
    def opened(self) -> Any:
        """Context manager of the open file, from which `array` reads."""

    @abstractmethod
    def array(self, file: Any, name: str) -> Any:
        """Array `name` of the open file: something with a shape that can be sliced."""

    def blocks(self, wanted: Wanted) -> Iterator[Tables]:
        with self.opened() as file:
            values = {
                name: _Matrix(self.array(file, name), name, wanted.transposed)
                for name in wanted.values
            }
            first = values[wanted.values[0]]
            rows = first.rows
            for name, matrix in values.items():
                if matrix.shape != first.shape:
                    raise DataError(
                        f"'{name}' must have the shape of the values, {first.shape}, got "
                        f"{matrix.shape}"
                    )
            labels = {
                name: _label(np.asarray(self.array(file, name)[()]), name, rows, wanted.paired)
                for name in wanted.labels
            }
            for start in range(0, rows, wanted.block_rows):
                chosen = slice(start, min(start + wanted.block_rows, rows))
                yield {name: matrix.read(chosen) for name, matrix in values.items()} | {
                    name: label[chosen] for name, label in labels.items()
                }


class NpzSource(ArraySource):
    """NumPy archive of plain arrays; pickled objects are never loaded."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        with self.opened() as file:
            self.names = tuple(file.files)

    @contextmanager
    def opened(self) -> Iterator[Any]:
        import zlib
        from zipfile import BadZipFile

        try:
            with np.load(self.path, allow_pickle=False) as file:
                if not isinstance(file, np.lib.npyio.NpzFile):
                    raise ValueError("a single array")
                yield file
        except DataError:
            raise
        except (  # encrypted or compressed otherwise, too: RuntimeError
            ValueError,
            BadZipFile,
            zlib.error,
            AttributeError,
            EOFError,
            RuntimeError,
        ) as error:
            raise DataError(
                f"not an .npz file of plain arrays: {error}; save it with numpy.savez"
            ) from error

    def array(self, file: Any, name: str) -> Any:
        return file[name]


class MatSource(ArraySource):
    """MATLAB file of version 5 to 7; cells, structures and objects are not read."""

    def __init__(self, path: Path) -> None:
        from scipy.io import whosmat

        super().__init__(path)
        with _as_data_errors("MATLAB file"), path.open("rb") as file:
            kinds = {name: kind for name, _, kind in whosmat(file)}
        self.names = tuple(name for name, kind in kinds.items() if kind in _MATLAB_NUMBERS)
        self.unread = {
            name: f"a MATLAB {kind}" for name, kind in kinds.items() if name not in self.names
        }

    @contextmanager
    def opened(self) -> Iterator[Any]:
        with self.path.open("rb") as file:
            yield file

    def array(self, file: Any, name: str) -> Any:
        from scipy.io import loadmat

        file.seek(0)
        with _as_data_errors("MATLAB file"):
            return loadmat(file, variable_names=[name])[name]


class Hdf5Source(ArraySource):
    """HDF5 file, MATLAB's of version 7.3 among them; links and data elsewhere are not read.

    A table with named fields, as pandas writes them, is read as one array per field.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        names: list[str] = []
        unread: dict[str, str] = {}
        with self.opened() as file:
            for name, array in _arrays(file, "", unread):
                fields = array.dtype.names or ()
                if array.dtype.kind == "O" and h5py.check_string_dtype(array.dtype) is None:
                    unread[name] = "an HDF5 array of objects or references"
                elif array.attrs.get("MATLAB_class", b"double") == b"char":
                    unread[name] = "a MATLAB text"
                elif fields and fields != _MATLAB_COMPLEX:
                    names += [f"{name}/{field}" for field in fields]
                else:
                    names.append(name)
        self.names, self.unread = tuple(names), unread

    @contextmanager
    def opened(self) -> Iterator[Any]:
        with _as_data_errors("HDF5 file"), h5py.File(self.path, "r") as file:
            yield file

    def array(self, file: Any, name: str) -> Any:
        if name in file:
            stored = file[name]
            require_stored(stored.id, name)
            if h5py.check_string_dtype(stored.dtype) is not None:
                return np.asarray(stored.asstr()[()], dtype=np.str_)
            return _Transposed(stored) if "MATLAB_class" in stored.attrs else stored
        path, _, field = name.rpartition("/")
        require_stored(file[path].id, path)
        return file[path].fields(field)[()]


class _Transposed:
    """View of an array that MATLAB stored with its axes in reverse order."""

    def __init__(self, stored: h5py.Dataset) -> None:
        self._stored = stored
        self.shape = stored.shape[::-1]
        self.ndim = stored.ndim

    def __getitem__(self, chosen: Any) -> NDArray[Any]:
        reversed_ = chosen[::-1] if isinstance(chosen, tuple) else chosen
        if isinstance(chosen, tuple) and not chosen:
            reversed_ = ()
        return np.asarray(self._stored[reversed_]).T


class _Matrix:
    """Matrix of measurements, frames by channels, read in blocks of frames."""

    def __init__(self, array: Any, name: str, transposed: bool) -> None:
        """Check the number of axes; raises DataError."""
        shape = tuple(array.shape)
        if len(shape) != 2 and not (transposed and len(shape) == 1):
            raise DataError(
                f"'{name}' must be a matrix of numbers, frames by columns, got shape {shape}; "
                "a single frame is read with --transpose"
            )
        self._array, self._transposed, self._name = array, transposed, name
        self.shape = (*([1] if len(shape) == 1 else []), *(shape[::-1] if transposed else shape))
        self.rows = self.shape[0]

    def read(self, rows: slice) -> NDArray[Any]:
        """Frames `rows` (frames, channels); raises DataError for anything but numbers."""
        if not self._transposed:
            return _numbers(np.asarray(self._array[rows, :]), self._name)
        if len(self._array.shape) == 1:
            return _numbers(np.asarray(self._array[()])[None], self._name)
        return _numbers(np.asarray(self._array[:, rows]).T, self._name)


def _label(array: NDArray[Any], name: str, rows: int, paired: bool) -> NDArray[Any]:
    """Labels (rows, columns) of a vector or matrix; raises DataError for another number of rows."""
    table = array[:, None] if array.ndim == 1 else array
    if table.ndim == 2 and len(table) == 1 and table.shape[1] in (rows, rows / 2):
        table = table.T
    if paired and table.ndim == 2 and 2 * len(table) == rows:
        table = np.repeat(table, 2, axis=0)
    if table.ndim != 2 or len(table) != rows:
        raise DataError(f"'{name}' must have one row for each of {rows} frames, got {array.shape}")
    return table.astype(np.str_) if table.dtype.kind == "S" else _numbers(table, name)


def _numbers(array: NDArray[Any], name: str) -> NDArray[Any]:
    """Numbers or text of an array; complex where MATLAB stored two fields."""
    if array.dtype.names == _MATLAB_COMPLEX:
        found: NDArray[Any] = array["real"] + 1j * array["imag"]
        return found
    if array.dtype.kind not in "biufcUM":
        raise DataError(f"'{name}' must hold plain numbers, got {array.dtype}")
    return array


def _arrays(
    group: h5py.Group, inside: str, unread: dict[str, str]
) -> Iterator[tuple[str, h5py.Dataset]]:
    """Arrays within the file by path; links and what lies elsewhere go to `unread`."""
    for key in group:
        name = inside + key
        if group.id.links.get_info(key.encode()).type != h5py.h5l.TYPE_HARD:
            unread[name] = "a link"
            continue
        item = group[key]
        if isinstance(item, h5py.Group):
            if not key.startswith("#"):  # MATLAB's cells
                yield from _arrays(item, f"{name}/", unread)
        elif isinstance(item, h5py.Dataset):
            if item.is_virtual or item.external:
                unread[name] = "stored in another file"
            else:
                yield name, item


@contextmanager
def _as_data_errors(kind: str) -> Iterator[None]:
    """Raise the errors of a file format's reader as DataError, absent files excepted."""
    try:
        yield
    except (DataError, FileNotFoundError, PermissionError):
        raise
    except Exception as error:  # readers' errors for damaged files have no common base
        raise DataError(f"not a {kind} that can be read: {error}") from error
