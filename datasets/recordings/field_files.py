"""Files of other instruments and programs: Sciospec, Draeger, Goe, pyGIMLi, and EIDORS's patterns.

Each says what was measured with which electrodes, and readers turn readings into ohm where the file
has the current.
"""

import re
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from eitskin.datasets.recordings.arrays import ArrayReader
from eitskin.datasets.recordings.reader import Contents, Reader
from eitskin.errors import DataError
from eitskin.protocol import Protocol, Row

Tables = dict[str, NDArray[Any]]
FIELD: Final = (".eit", ".get")
"""Endings of files of instruments only."""

_DRAEGER_END: Final = b"**\r\n\r\n\r\n"  # of the text before the frames
_DRAEGER_FRAME: Final = np.dtype(
    {
        "names": ["first", "second"],
        "formats": [("<f8", 208), ("<f8", 208)],
        "offsets": [16, 2592],
        "itemsize": 5495,
    }
)
_DRAEGER_OHM: Final = (0.00098242, 0.00019607)  # of both parts, estimated by A. Adler for EIDORS


class FieldReader(ArrayReader):
    """Reader of a file whose few tables are held in memory."""

    def __init__(self, path: Path, read: "Callable[[Path], tuple[Tables, Contents]]") -> None:
        super().__init__(path)
        self._tables, self.contents = read(path)

    def array(self, name: str) -> Any:
        return self._tables[name]


def field_reader(path: Path) -> Reader | None:
    """Reader of a file of an instrument, by its ending and content; None for another file."""
    ending = ".eit" if path.is_dir() else path.suffix.lower()
    if ending == ".get":
        return FieldReader(path, _read_get)
    if ending in (".dat", ".ohm") and _gimli_lines(path):
        return FieldReader(path, _read_gimli)
    if ending != ".eit":
        return None
    files = sorted(path.glob("*.eit")) if path.is_dir() else [path]
    if not files:
        raise DataError("expected files .eit in the folder, got none")
    with files[0].open("rb") as file:
        start = file.read(4096)
    if re.match(rb"\d{1,2}\r?\n", start):
        return FieldReader(path, lambda _: _read_sciospec(files))
    if len(files) > 1 or int.from_bytes(start[:4], "little") not in (31, 32, 51):
        raise DataError(
            "expected a file .eit of Sciospec, which begins with the number of its header's lines, "
            "or one of a Draeger PulmoVista; export another instrument's readings as a table"
        )
    return FieldReader(path, _read_draeger)


def _contents(tables: Tables, rows: Iterable[Row], n: int, remark: str, **known: Any) -> Contents:
    """Contents of tables, the first of which has the values."""
    return Contents(
        tuple(tables),
        usual_values=next(iter(tables)),
        remark=f" ({remark})",
        measured=tuple(rows),
        electrodes=n,
        **known,
    )


def _read_sciospec(files: Sequence[Path]) -> tuple[Tables, Contents]:
    """Frames of Sciospec, one in each file: an injection's electrodes, and a line per frequency.

    Lines hold the real and imaginary parts of all channels' voltages, one channel after the other.
    Neighbouring channels are subtracted, and divided by the current.
    """
    frames = [_sciospec_frame(file) for file in files]
    rows, channels, values = frames[0]
    for file, frame in zip(files, frames, strict=True):
        if frame[0] != rows or frame[2].shape != values.shape:
            raise DataError(f"{file.name}: expected the injections of {files[0].name}, got others")
    tables = {f"f{k}": np.array([frame[2][k] for frame in frames]) for k in range(len(values))}
    remark = f"Sciospec, one table for each of {len(values)} frequencies, in ohm"
    return tables, _contents(tables, rows, channels, remark)


def _sciospec_frame(file: Path) -> tuple[list[Row], int, NDArray[Any]]:
    """Rows, number of electrodes, and values (frequencies, measurements) [ohm] of one frame."""
    lines = file.read_text(encoding="utf-8", errors="replace").splitlines()
    try:
        head, lines = (
            lines[: int(lines[0])],
            [line for line in lines[int(lines[0]) :] if line.strip()],
        )
        old = len(head) < 11  # without a line for the version
        count, current = int(float(head[7 - old])), float(head[8 - old])
        named = next((each for each in head if each.startswith("MeasurementChannels:")), "")
        channels = [int(each) for each in re.findall(r"\d+", named)]
        blocks = [lines[k : k + 1 + count] for k in range(0, len(lines), 1 + count)]
        drives = [tuple(map(int, re.findall(r"\d+", block[0]))) for block in blocks]
        parts = np.array([[np.array(x.split(), float) for x in block[1:]] for block in blocks])
    except (ValueError, IndexError) as error:
        raise DataError(f"{file.name} is no whole frame of Sciospec: {error}") from error
    volts = np.moveaxis(parts[..., ::2] + 1j * parts[..., 1::2], 1, 0)
    channels = channels or list(range(1, volts.shape[2] + 1))
    columns = channels if volts.shape[2] >= max(channels) else range(1, len(channels) + 1)
    volts = volts[..., np.array(columns) - 1] / current
    n = len(channels)
    places = {channel: place for place, channel in enumerate(channels)}
    rows: list[Row] = []
    values = []
    for number, drive in enumerate(drives):
        a, b = (places.get(electrode, -1) for electrode in drive)
        for c in range(n):
            pair = (c, (c + 1) % n)
            if not {a, b, -1} & set(pair):
                rows.append((a, b, *pair))
                values.append(volts[:, number, pair[0]] - volts[:, number, pair[1]])
    return rows, n, np.array(values).T


def _read_draeger(path: Path) -> tuple[Tables, Contents]:
    """Frames of a PulmoVista: 208 differences of neighbours, from behind each drive pair on."""
    content = path.read_bytes()
    start = int.from_bytes(content[4:8], "little")
    version = int.from_bytes(content[:4], "little")
    if version != 51 or content[start : start + 8] != _DRAEGER_END:
        raise DataError(
            f"expected format 51 of Draeger, got {version}; export it with the instrument's program"
        )
    body = content[start + len(_DRAEGER_END) :]
    frames = np.frombuffer(body, _DRAEGER_FRAME, len(body) // _DRAEGER_FRAME.itemsize)
    first, second = _DRAEGER_OHM
    tables = {"v": first * frames["first"] - second * frames["second"]}
    if rate := re.search(rb"Framerate \[Hz\]:\s*([\d.]+)", content[:start]):
        tables["t"] = np.arange(len(frames)) / float(rate[1])
    rows = Protocol.adjacent(16).table
    return tables, _contents(tables, rows, 16, "Draeger, in ohm about", order="rotated")


def _read_get(path: Path) -> tuple[Tables, Contents]:
    """Frames of 16 x 16 readings in single precision, those of driven electrodes among them."""
    content = path.read_bytes()
    if not content or len(content) % 1024:
        raise DataError(f"expected frames of 1024 bytes, got {len(content)} bytes")
    tables: Tables = {"v": np.frombuffer(content, "<f4").reshape(-1, 256)}
    rows = Protocol.adjacent(16, shared=True).table
    return tables, _contents(tables, rows, 16, "16 x 16 readings of Goe", driven=True)


def _gimli_lines(path: Path) -> list[list[str]]:
    """Lines below the sensors of a unified data file of pyGIMLi, names first; none for another."""
    with path.open(encoding="utf-8-sig", errors="replace") as file:
        lines = [line.split() for line in file]
    lines = [line for line in lines if line]
    plain = [k for k, line in enumerate(lines) if not line[0].startswith("#")]
    if not plain or not lines[plain[0]][0].rstrip("#").isdigit():
        return []
    count = int(lines[plain[0]][0].rstrip("#"))
    data = plain[count + 1 :]
    if not data or not lines[data[0]][0].isdigit() or len(data) <= int(lines[data[0]][0]):
        return []
    names = [each.strip("#") for line in lines[data[0] + 1 : data[1]] for each in line]
    size = int(lines[data[0]][0])
    chosen = [lines[k] for k in data[1 : 1 + size]]
    names = [name for name in names if name]
    return [names, *chosen] if {"a", "b", "m", "n"} <= set(names) else []


def _read_gimli(path: Path) -> tuple[Tables, Contents]:
    """One frame: a row for each measurement, electrodes from 1, r, u / i, or rhoa / k."""
    names, *lines = _gimli_lines(path)
    try:
        numbers = np.array([line[: len(names)] for line in lines], float).T
    except ValueError as error:
        raise DataError(f"expected numbers below {' '.join(names)}: {error}") from error
    columns = {}
    for name, column in zip(names, numbers, strict=True):
        name, _, unit = name.partition("/")  # noqa: PLW2901
        columns[name.lower()] = column * (1e-3 if unit.startswith("m") else 1.0)
    for name, other in (("r", ""), ("u", "i"), ("rhoa", "k")):
        if name in columns and (not other or other in columns):
            values = columns[name] / (columns[other] if other else 1.0)
            break
    else:
        raise DataError(f"expected columns r, u and i, or rhoa and k, got {', '.join(names)}")
    rows = np.array([columns[each] for each in "abmn"]).T.astype(int) - 1
    if rows.min() < 0:
        raise DataError("expected four electrodes for each measurement, got one at infinity (0)")
    tables = {"r": values[None]}
    known = [tuple(row) for row in rows.tolist()]
    return tables, _contents(tables, known, int(rows.max()) + 1, "pyGIMLi, one frame, in ohm")
