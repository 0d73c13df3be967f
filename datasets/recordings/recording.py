"""Import of measured recordings, from any board and skin, as datasets."""

import csv
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from eitskin.datasets.recordings.blocks import (
    Block,
    rows_during,
    with_before,
    without_bad_values,
)
from eitskin.datasets.recordings.form import LENGTHS, RecordingForm, RecordingNames
from eitskin.datasets.recordings.labels import NAMES, find_labels, names_of_origin, read_labels
from eitskin.datasets.recordings.opening import open_source
from eitskin.datasets.recordings.patterns import protocol_of_patterns
from eitskin.datasets.recordings.plausibility import origin_on, require_plausible
from eitskin.datasets.recordings.references import ReferenceMeans, numbered
from eitskin.datasets.recordings.source import Tables, Wanted
from eitskin.datasets.store.dataset import Dataset
from eitskin.datasets.store.schema import LIMITS
from eitskin.datasets.store.state import State
from eitskin.errors import ConfigurationError, DataError
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.protocol import Protocol

Complex = NDArray[np.complex64]

_MOST_EPISODES: Final = 1 << 32


def read_recording(
    path: str | Path,
    names: RecordingNames | None = None,
    protocol: Protocol | None = None,
    frequency: float = 40e3,
    design: SensorDesign | None = None,
    form: RecordingForm | None = None,
) -> Dataset:
    """Dataset of a recording with any number of channels.

    Arguments and errors as for `Recording`.
    """
    recording = Recording(path, names, protocol, frequency, design, form)
    return Dataset.collect(recording.parts(), recording.frames)


class Recording:
    """Recording in a file, read twice in blocks: for its references, then for its frames.

    Besides the tables of `names`, `state` (idle, touch, bend or their numbers), `angle_deg` [deg],
    `x`, `y`, `depth`, `radius` [m], `force` [N], `t` [s], `specimen`, `sensor` and `session`
    (numbers or names) are taken where the file has them.

    Attributes:
        frames: number of frames.
        protocol: drive and sense pairs of the channels; None where unknown.
        unused: tables of the file that are not read.
        specimens: number of each specimen by its name in the file.
        sessions: number of each session by its name in the file.
    """

    def __init__(
        self,
        path: str | Path,
        names: RecordingNames | None = None,
        protocol: Protocol | None = None,
        frequency: float = 40e3,
        design: SensorDesign | None = None,
        form: RecordingForm | None = None,
    ) -> None:
        """Read the file once, and check all of it.

        Args:
            path: .csv, .tsv, .dat or .txt with columns, .xlsx, .parquet, .mat, .npz without pickled
                objects, .h5, or .txt with OpenEIT's "magnitudes : a , b , ..." lines.
            names: of the tables in the file.
            protocol: drive and sense pairs of the channels; None where unknown.
            frequency: of the excitation [Hz].
            design: of the sensor; None where unknown.
            form: arrangement of the rows, and units.

        Raises:
            DataError: where the file or its content cannot be used.
            ConfigurationError: for another kind of file, or names that are not in the file.
            ImportError: where the package that reads the file is not installed.
        """
        self.path, self.protocol = Path(path), protocol
        self._names, self._form = names or RecordingNames(), form or RecordingForm()
        self._shared = {"design": design, "frequency": frequency, "source": "measured"}
        self._shared |= {"quantity": self._form.quantity}
        self._scale: NDArray[np.float64] | float = self._form.scale
        self._origin = origin_on(design, self._form.origin)
        with _named_errors(self.path):
            self._open()
            self._survey()

    def parts(self) -> Iterator[Dataset]:
        """Frames in parts of a few thousand, with all specimens of each part."""
        numbers = np.array(sorted(self.specimens.values()), dtype=np.uint32)
        named = {number: name for name, number in self.specimens.items()}
        reference = self._references.collected([named[number] for number in numbers.tolist()])
        first = 0
        with _named_errors(self.path):
            for block in self._blocks():
                rows = [self.specimens[name] for name in block.specimens]
                known = dict(block.known)
                if block.before is not None:
                    known["touch_reference"] = block.before
                yield Dataset.from_arrays(
                    block.values,
                    reference,
                    specimen=np.searchsorted(numbers, rows),
                    specimen_number=numbers,
                    episode=np.array([self.sessions[name] for name in block.sessions]),
                    number=np.arange(first, first + len(rows)),
                    status=block.status,
                    protocol=self.protocol,
                    **known,
                    **self._shared,
                ).own_specimens()
                first += len(rows)

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
            tuple(values), tuple(sorted(labels)), form.transpose, form.rows != "frames"
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

    def _survey(self) -> None:
        """Count the frames, and find specimens, sessions and references."""
        self.frames, self._references = 0, ReferenceMeans()
        sessions: dict[str, None] = {}
        for block in self._blocks():
            self.frames += len(block.values)
            sessions |= dict.fromkeys(block.sessions)
            state = block.known.get("state", np.zeros(0, dtype=np.uint8))
            angle = block.known.get("bend_angle_deg", np.zeros(len(block.values)))
            if block.before is None:
                untouched = np.where(block.status != 0, np.nan, block.values)
                known = state == State.IDLE if len(state) else np.zeros(len(angle), dtype=np.bool_)
            else:
                untouched = block.before
                known = np.isfinite(untouched).any(axis=1)
            bent = np.isfinite(angle) & (angle != 0)
            self._references.add(block.specimens, untouched, np.asarray(known), bent)
        if not self.frames:
            raise DataError("expected at least one frame, got none")
        self.specimens = numbered(self._references.names, LIMITS["specimen"])
        self.sessions = numbered(sessions, _MOST_EPISODES)

    def _blocks(self) -> Iterator[Block]:
        """Frames of the recording, block by block, checked."""
        first, last = 0, None
        for tables in self._source.blocks(self._wanted):
            block = self._block(tables, first)
            first += len(next(iter(tables.values())))
            if self._form.keep_before and len(block.values):
                last, block = block, with_before(block, last)
            if len(block.values):
                yield block

    def _block(self, tables: Tables, first: int) -> Block:
        """Frames of one block of tables, whose first row is row `first` of the file."""
        form = self._form
        values = self._measured(tables, self._wanted.values[0])
        before = None
        known = read_labels(tables, self._places, LENGTHS[form.length_unit])
        origins = [self._origins(tables, labels, len(values)) for labels in (NAMES[:2], NAMES[2:])]
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
            origins = [[names[row] for row in during] for names in origins]
        for name, shift in zip(("touch_x", "touch_y"), self._origin, strict=True):
            if name in known:
                known[name] = known[name] + shift
        require_plausible(known, self._shared["design"], self._origin)  # type: ignore[arg-type]
        status = np.zeros(values.shape, dtype=np.uint8)
        block = Block(values, before, known, origins[0], origins[1], status)
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

    def _origins(self, tables: Tables, labels: Sequence[str], rows: int) -> list[str]:
        """Names of specimens or sessions of a block's rows; "0" where the file does not say."""
        told = [
            names_of_origin(tables, self._places, label)
            for label in labels
            if label in self._places
        ]
        return [" ".join(names) for names in zip(*told, strict=True)] if told else ["0"] * rows


def _measurements(name: str, n_electrodes: int) -> int:
    """Number of measurements of a named protocol; 0 where it does not exist."""
    try:
        return len(Protocol.named(name, n_electrodes))
    except ConfigurationError:
        return 0


@contextmanager
def _named_errors(path: Path) -> Iterator[None]:
    """Begin the message of a DataError with the file, and raise its system's errors as such."""
    try:
        yield
    except DataError as error:
        raise DataError(f"{path}: {error}") from error
    except FileNotFoundError as error:
        raise DataError(f"there is no file {path}") from error
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise DataError(f"cannot read {path}: {error}") from error
