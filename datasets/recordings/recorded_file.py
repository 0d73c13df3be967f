"""One file of a recording: its tables, and their rows as checked blocks of frames."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from eitskin.datasets.recordings.blocks import (
    Block,
    Complex,
    rows_during,
    without_bad_values,
)
from eitskin.datasets.recordings.contained_source import open_source
from eitskin.datasets.recordings.form import LENGTHS, RecordingForm, RecordingNames
from eitskin.datasets.recordings.labels import NAMES, find_labels, names_of_origin, read_labels
from eitskin.datasets.recordings.patterns import protocol_of_patterns
from eitskin.datasets.recordings.plausibility import origin_on, require_plausible
from eitskin.datasets.recordings.source import BLOCK_ROWS, Tables, Wanted
from eitskin.errors import ConfigurationError, DataError
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.protocol import Protocol


class RecordedFile:
    """File of a recording, from which frames are read in blocks.

    Attributes:
        path: of the file.
        protocol: drive and sense pairs of the channels; None where unknown.
        unused: tables of the file that are not read.
    """

    def __init__(
        self,
        path: Path,
        names: RecordingNames,
        protocol: Protocol | None,
        design: SensorDesign | None,
        form: RecordingForm,
        session: str = "",
    ) -> None:
        """Find the tables in the file; arguments and errors as for `Recording`.

        `session` is put before the names of sessions, which are distinct in several files then.
        """
        self.path, self.protocol = path, protocol
        self._names, self._form, self._design = names, form, design
        self._scale: NDArray[np.float64] | float = form.scale
        self._session = session
        self._origin = origin_on(design, form.origin)
        with self.named_errors():
            self._open()

    def blocks(self) -> Iterator[Block]:
        """Frames of the file, block by block, checked; raises DataError that names the file."""
        first = 0
        with self.named_errors():
            for tables in self._source.blocks(self._wanted):
                block = self._block(tables, first)
                first += len(next(iter(tables.values())))
                if len(block.values):
                    yield block

    @contextmanager
    def named_errors(self) -> Iterator[None]:
        """Begin the message of a DataError with the file, and raise its system's errors as such."""
        try:
            yield
        except DataError as error:
            raise DataError(f"{self.path}: {error}") from error
        except FileNotFoundError as error:
            raise DataError(f"there is no file {self.path}") from error
        except OSError as error:
            raise DataError(f"cannot read {self.path}: {error}") from error

    def _open(self) -> None:
        """Find the tables in the file."""
        names, form = self._names, self._form
        self._source = source = open_source(self.path, names.sheet)
        if names.values is None and source.usual_values is None:
            raise ConfigurationError(
                f"cannot find the values: nothing was named; {source.holds()}; name one of them "
                "with --values"
            )
        values = [source.require(names.values or source.usual_values or "", "values")]
        if names.touch_reference:
            values.append(source.require(names.touch_reference, "touch reference"))
        if form.rows != "frames" and names.touch_reference:
            raise ConfigurationError(
                "the readings before a press are either a table of their own or alternate with "
                "those during it; give --touch-reference or --rows, not both"
            )
        if form.keep_before and form.rows == "frames" and not names.touch_reference:
            raise ConfigurationError(
                "there are no readings before a press to keep; name them with --touch-reference, "
                "or say --rows before-during"
            )
        self._places = find_labels(source, names.columns, names.positions)
        labels = {place.table for place in self._places.values() if place.table}
        self._wanted = Wanted(
            tuple(values),
            tuple(sorted(labels)),
            form.transpose,
            form.rows != "frames",
            BLOCK_ROWS,
        )
        used = {*values, *labels, *(names.patterns or ())}
        self.unused = tuple(name for name in source.names if name not in used)
        if names.patterns:
            self._read_patterns(*names.patterns)

    def _read_patterns(self, drive: str, sense: str) -> None:
        if self.protocol is not None:
            raise ConfigurationError("give either a protocol or patterns of the file, got both")
        matrices = []
        for name in (drive, sense):
            wanted = Wanted((self._source.require(name, "patterns"),))
            matrices.append(np.concatenate([t[name] for t in self._source.blocks(wanted)]))
        self.protocol, currents = protocol_of_patterns(*matrices)
        self._scale = self._form.scale / currents

    def _block(self, tables: Tables, first: int) -> Block:
        """Frames of one block of tables, whose first row is row `first` of the file."""
        form = self._form
        values = self._measured(tables, self._wanted.values[0])
        before = None
        known = read_labels(tables, self._places, LENGTHS[form.length_unit])
        rows = len(values)
        specimens = self._origins(tables, NAMES[:2]) or ["0"] * rows
        sessions = self._origins(tables, NAMES[2:]) or [self._session or "0"] * rows
        if len(self._wanted.values) > 1:
            before = self._measured(tables, self._wanted.values[1])
            if before.shape != values.shape:
                raise DataError(
                    f"'{self._wanted.values[1]}' must have the shape of the values, "
                    f"{values.shape}, got {before.shape}"
                )
        elif form.rows != "frames":
            during = rows_during(len(values), form.rows, known)
            before, values = values[during ^ 1], values[during]
            known = {name: label[during] for name, label in known.items()}
            specimens, sessions = ([names[k] for k in during] for names in (specimens, sessions))
        if {"", "nan"} & {*specimens, *sessions}:
            raise DataError(
                "expected a specimen, sensor and session for every frame, got an empty cell; fill "
                "it, or leave the label out"
            )
        for name, shift in zip(("touch_x", "touch_y"), self._origin, strict=True):
            if name in known:
                known[name] = known[name] + shift
        require_plausible(known, self._design, self._origin)
        status = np.zeros(values.shape, dtype=np.uint8)
        block = Block(values, before, known, specimens, sessions, status)
        return without_bad_values(
            block, form.bad_values, first // (1 if form.rows == "frames" else 2)
        )

    def _measured(self, tables: Tables, name: str) -> Complex:
        """Values or readings before a touch, scaled, (rows, C); raises DataError."""
        table = tables[name]
        if not np.issubdtype(table.dtype, np.number):
            raise DataError(
                f"'{name}' must be a matrix of numbers, frames by columns, got {table.dtype}"
            )
        if self.protocol is not None and len(self.protocol) != table.shape[1]:
            raise DataError(self._wrong_count(table.shape))
        with np.errstate(over="ignore", invalid="ignore"):
            scaled: Complex = (table * self._scale).astype(np.complex64)
        return scaled

    def _wrong_count(self, shape: tuple[int, ...]) -> str:
        """Message for another number of channels than the protocol has."""
        n = self.protocol.n_electrodes if self.protocol else 0
        fitting = [
            f"{name}:{n}"
            for name in ("pairwise", "adjacent", "opposite", "skip:1", "skip:2", "skip:3")
            if _measurements(name, n) == shape[1]
        ]
        hint = f", such as {' or '.join(fitting)}" if fitting else ""
        if len(self.protocol or ()) == shape[0]:
            hint += "; the table has as many rows: read it with --transpose"
        return (
            f"the protocol has {len(self.protocol or ())} measurements, but the frames have "
            f"{shape[1]} channels; give the protocol they were measured with{hint}"
        )

    def _origins(self, tables: Tables, labels: Sequence[str]) -> list[str]:
        """Names of specimens or sessions of a block's rows; none where the file does not say."""
        told = [
            names_of_origin(tables, self._places, label)
            for label in labels
            if label in self._places
        ]
        if told and "session" in labels and self._session:
            told.insert(0, [self._session] * len(told[0]))
        return [" ".join(names).strip() for names in zip(*told, strict=True)]


def _measurements(name: str, n_electrodes: int) -> int:
    """Number of measurements of a named protocol; 0 where it does not exist."""
    try:
        return len(Protocol.named(name, n_electrodes))
    except ConfigurationError:
        return 0
