"""Recordings as named arrays: MATLAB, NumPy and HDF5 files."""

import math
import re
from abc import abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import h5py
import numpy as np
from numpy.typing import NDArray

from eitskin.datasets.recordings.protocols import find_patterns, measurement_rows
from eitskin.datasets.recordings.reader import Contents, Reader, ReadRequest, Tables, as_data_errors
from eitskin.datasets.store.shard_reader import require_stored
from eitskin.errors import DataError

_MATLAB_NUMBERS: Final = {"double", "single", "logical"} | {
    f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)
}
_MATLAB_COMPLEX: Final = ("real", "imag")
_MATLAB_HDF5: Final = b"MATLAB 7.3"
_STIMULATION: Final = ("stim_pattern", "meas_pattern")


class ArrayReader(Reader):
    """Reader of a file of named arrays.

    Arrays with as many rows as the file says that there are measurements have frames as columns.
    """

    _measured = 0  # number of measurements, where tables of patterns say it

    @abstractmethod
    def array(self, name: str) -> Any:
        """Array `name` of the file; raises DataError."""

    def _find_patterns(self, shapes: Mapping[str, tuple[int, ...]]) -> None:
        """Take patterns and their measurements among arrays of these shapes, if there are any."""
        if found := find_patterns(shapes, self.array):
            self.contents = replace(self.contents, patterns=found[:2], usual_values=found[2])
            self._measured = math.prod(shapes[name][1] for name in found[:2])

    def tables(self, request: ReadRequest) -> Tables:
        arrays = {name: self.array(name) for name in request.values}
        first = next(iter(arrays.values())).shape
        measured = len(self.contents.measured) or self._measured
        transposed = request.transposed or (0 < measured == first[0] and first[1:] != first[:1])
        values = {name: _frames(array, name, transposed) for name, array in arrays.items()}
        shape = values[request.values[0]].shape
        for name, table in values.items():
            if table.shape != shape:
                raise DataError(
                    f"'{name}' must have the shape of the values, {shape}, got {table.shape}"
                )
        labels = {
            name: _columns(self.array(name), name, shape[0], request.paired)
            for name in request.labels
        }
        return values | labels


class NumpyReader(ArrayReader):
    """Reader of NumPy's files of plain arrays, one is named v; pickled objects are not loaded."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        with as_data_errors("file of plain arrays, as numpy.save and numpy.savez write it,"):
            read = np.load(path, allow_pickle=False)
            self._arrays = {"v": read} if isinstance(read, np.ndarray) else read
        self.contents = Contents(
            tuple(self._arrays), usual_values="v" if "v" in self._arrays else None
        )
        self._find_patterns({name: self.array(name).shape for name in self._arrays})

    def array(self, name: str) -> Any:
        with as_data_errors("file of plain arrays"):
            return self._arrays[name]


class MatReader(ArrayReader):
    """Reader of a MATLAB file of version 5 to 7: arrays, and those in structures as S/FIELD.

    Structures of EIDORS's stimulations say what was measured; cells and objects are not read.
    """

    def __init__(self, path: Path) -> None:
        from scipy.io import loadmat, whosmat

        super().__init__(path)
        with as_data_errors("MATLAB file"):
            shapes = {name: shape for name, shape, _ in whosmat(path)}
            kinds = {name: kind for name, _, kind in whosmat(path)}
        names = [name for name, kind in kinds.items() if kind in _MATLAB_NUMBERS]
        unread = {name: f"a MATLAB {kind}" for name, kind in kinds.items() if name not in names}
        structures = [name for name, kind in kinds.items() if kind in ("struct", "cell")]
        self._inside: dict[str, NDArray[Any]] = {}
        stimulations: list[Any] = []
        if structures:
            with as_data_errors("MATLAB file"):
                read = loadmat(path, variable_names=structures, simplify_cells=True)
            for name in structures:
                _collect_arrays(read[name], name, self._inside, stimulations)
        parts = [tuple(map(_dense, (each[k] for k in _STIMULATION))) for each in stimulations]
        self.contents = _eidors((*names, *self._inside), unread, parts)
        self._find_patterns({name: shapes[name] for name in names})

    def array(self, name: str) -> Any:
        from scipy.io import loadmat

        if name in self._inside:
            return self._inside[name]
        with as_data_errors("MATLAB file"):
            return loadmat(self.path, variable_names=[name])[name]


def _collect_arrays(
    value: Any, name: str, found: dict[str, NDArray[Any]], patterns: list[Any]
) -> None:
    """Collect the arrays of numbers in a structure, and EIDORS's stimulations."""
    cells = isinstance(value, list) or (isinstance(value, np.ndarray) and value.dtype.kind == "O")
    several = list(value) if cells else [value]
    dicts = [each for each in several if isinstance(each, dict)]
    if dicts and all(set(_STIMULATION) <= set(each) for each in dicts):
        patterns += [] if patterns else dicts
    elif dicts and dicts != [value]:  # one structure for each frame
        for key in dicts[0]:
            _collect_arrays([d.get(key) for d in dicts], f"{name}/{key}", found, patterns)
    elif isinstance(value, dict):
        for key, inner in value.items():
            _collect_arrays(inner, f"{name}/{key}", found, patterns)
    elif isinstance(value, np.ndarray) and value.dtype.kind in "biufc" and value.ndim:
        found[name] = value
    elif len({np.size(cell) for cell in several}) == 1 < len(several):
        rows = np.array([np.ravel(cell) for cell in several])
        found |= {name: rows} if rows.dtype.kind in "biufc" else {}


def _dense(matrix: Any) -> NDArray[Any]:
    return np.asarray(matrix.toarray() if hasattr(matrix, "toarray") else matrix)


def _eidors(
    names: tuple[str, ...], unread: dict[str, str], parts: list[tuple[NDArray[Any], ...]]
) -> Contents:
    """Contents of a MATLAB file, with what EIDORS's stimulations say of its readings."""
    try:
        rows, currents, electrodes = measurement_rows(parts)  # type: ignore[arg-type]
    except DataError:  # patterns of many electrodes are no protocol
        rows = []
    if not rows:
        return Contents(names, unread)
    usual = [n for n in names if re.fullmatch(r"(?:.*/)?(?:vi|data|meas|vv?|vh)(?:/meas)?", n)]
    order = ("vi/meas", "vi", "data/meas", "data", *usual)
    remark = f" (EIDORS, {len(rows)} measurements, frames as columns)"
    return Contents(
        names,
        unread,
        usual_values=next((name for name in order if name in names), None),
        remark=remark,
        measured=tuple(rows),
        currents=tuple(currents),
        electrodes=electrodes,
    )


class Hdf5Reader(ArrayReader):
    """Reader of an HDF5 file, as MATLAB 7.3 writes it, too; links to elsewhere are not followed.

    A table with named fields, as pandas writes them, is read as one array per field.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        names: list[str] = []
        unread: dict[str, str] = {}
        shapes: dict[str, tuple[int, ...]] = {}
        with as_data_errors("HDF5 file"), h5py.File(path) as file:
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
                    turn = -1 if "MATLAB_class" in array.attrs else 1
                    shapes[name] = array.shape[::turn] if array.dtype.kind in "iuf" else ()
            parts = _stimulations(file)
        self.contents = _eidors(tuple(names), unread, parts)
        self._find_patterns(shapes)

    def array(self, name: str) -> Any:
        with as_data_errors("HDF5 file"), h5py.File(self.path) as file:
            path, field = (name, "") if name in file else name.rsplit("/", 1)
            stored = file[path]
            require_stored(stored.id, path)
            if field:
                return stored.fields(field)[()]
            if h5py.check_string_dtype(stored.dtype) is not None:
                return np.asarray(stored.asstr()[()], dtype=np.str_)
            # MATLAB stores arrays with their axes in reverse order.
            return stored[()].T if "MATLAB_class" in stored.attrs else stored[()]


def open_mat(path: Path) -> Reader:
    """Reader of a MATLAB file of any version, from what its first bytes say."""
    with path.open("rb") as file:
        newest = file.read(len(_MATLAB_HDF5)) == _MATLAB_HDF5
    return Hdf5Reader(path) if newest else MatReader(path)


def _stimulations(file: h5py.File) -> list[tuple[NDArray[Any], ...]]:
    """Patterns of EIDORS's stimulations in a file of MATLAB 7.3: dense, sparse, or by reference."""
    groups: list[h5py.Group] = []

    def collect(name: str, item: Any) -> None:  # noqa: ARG001
        if isinstance(item, h5py.Group) and set(_STIMULATION) <= set(item):
            groups.append(item)

    file.visititems(collect)
    parts = []
    for name in _STIMULATION if groups else ():
        item = groups[0][name]
        several = isinstance(item, h5py.Dataset) and item.dtype == h5py.ref_dtype
        each = [file[reference] for reference in np.ravel(item[()])] if several else [item]
        parts.append([_matrix(matrix) for matrix in each])
    return list(zip(*parts, strict=True)) if parts else []


def _matrix(item: Any) -> NDArray[Any]:
    """Matrix that MATLAB 7.3 stored, dense or sparse by columns."""
    if isinstance(item, h5py.Dataset):
        return np.asarray(item[()]).T
    starts, rows = np.asarray(item["jc"]), np.asarray(item["ir"])
    matrix = np.zeros((int(item.attrs["MATLAB_sparse"]), len(starts) - 1))
    matrix[rows, np.repeat(np.arange(len(starts) - 1), np.diff(starts))] = item["data"]
    return matrix


def _frames(array: Any, name: str, transposed: bool) -> NDArray[Any]:
    """Table (frames, channels) of an array; raises DataError for one that is no matrix."""
    table = array[:, None] if array.ndim == 1 and transposed else array
    if table.ndim > 2:  # drive pairs by sense pairs
        frames = table.T if transposed else table
        return _numbers(frames.reshape(len(frames), -1), name)
    if table.ndim != 2:
        raise DataError(
            f"'{name}' must be a matrix of numbers, frames by columns, got shape {array.shape}; "
            "a single frame is read with --transpose"
        )
    return _numbers(table.T if transposed else table, name)


def _columns(array: Any, name: str, rows: int, paired: bool) -> NDArray[Any]:
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
        numbers: NDArray[Any] = array["real"] + 1j * array["imag"]
        return numbers
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
