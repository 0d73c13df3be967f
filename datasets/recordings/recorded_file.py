"""One file of a recording: its form, its tables, and their rows as checked blocks of frames."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final, Literal, get_args, get_type_hints

import numpy as np
from numpy.typing import NDArray

from eitskin.datasets.recordings.blocks import (
    Block,
    Complex,
    add_baselines,
    pair_matrices,
    pair_rows,
    require_no_baselines,
    without_bad_values,
)
from eitskin.datasets.recordings.labels import (
    NAMES,
    Clock,
    find_labels,
    names_of_origin,
    origin_position,
    read_labels,
    require_plausible,
)
from eitskin.datasets.recordings.parts import (
    PhaseUnit,
    counts_from_one,
    electrode_columns,
    protocol_of_names,
    protocol_of_rows,
    require_protocol_of_names,
    unit_factor,
)
from eitskin.datasets.recordings.protocols import (
    Order,
    in_order,
    protocol_of_patterns,
    require_order,
)
from eitskin.datasets.recordings.reader import BLOCK_ROWS, ReadRequest, Tables
from eitskin.datasets.recordings.source import Source
from eitskin.errors import ConfigurationError, DataError
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.protocol import Protocol

Rows = Literal["frames", "before-during", "during-before"]
TimeUnit = Literal["", "s", "ms", "us", "ns"]
LengthUnit = Literal["m", "cm", "mm", "um"]
Quantity = Literal["", "impedance", "magnitude", "voltage"]
BadValues = Literal["refuse", "mark", "drop"]

TIMES: Final[Mapping[str, float]] = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
LENGTHS: Final[Mapping[str, float]] = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6}


@dataclass(frozen=True, slots=True)
class RecordingNames:
    """Names of the tables in a file: of variables, or of columns.

    Numbered columns such as v0, v1 ... are one table, v; FIRST..LAST is the table of the columns
    from one name to another, and FIRST,SECOND are two tables with magnitudes and phases or real and
    imaginary parts, by the second name.

    Attributes:
        values: measured values, frames by channels; "v" for files of columns, or two parts
            detected by the names of columns, and "magnitudes" for OpenEIT when omitted.
        touch_reference: values of the same sensor untouched, frames by channels; none when omitted.
        positions: touch positions, frames by (x, y, ...) [m]; further columns are ignored. The
            columns x and y when omitted.
        columns: position of a label that has another name, by label: NAME, NAME:COLUMN of a
            matrix counted from 0, NAME*FACTOR for another unit, or a number for all touches.
        patterns: drive and sense patterns, electrodes by patterns, instead of a protocol.
        sheet: sheet of an Excel file; the first one when omitted.
        header_row: row with the names of the columns, from 1; detected where omitted.

    Example:
        >>> from eitskin.datasets import RecordingNames
        >>> RecordingNames("ch", columns={"x": "px", "y": "py"}).values
        'ch'
    """

    values: str | None = None
    touch_reference: str | None = None
    positions: str | None = None
    columns: Mapping[str, str] = field(default_factory=dict)
    patterns: tuple[str, str] | None = None
    sheet: str | None = None
    header_row: int | None = None


@dataclass(frozen=True, slots=True)
class RecordingForm:
    """Arrangement of a recording's rows and units of its numbers.

    Attributes:
        rows: whether each row of the values is a frame, or rows before and during a touch
            alternate.
        keep_before: readings before a touch are frames of the untouched sensor, too.
        transpose: the values have frames along their second axis.
        length_unit: length unit of positions, depths and radii.
        origin: origin of the positions on the design: "corner", "centre" or "X,Y" [m].
        quantity: kind of the values; empty where unknown.
        scale: factor that makes ohm, or volt, of the values.
        bad_values: values that are empty or not finite are refused, marked in the frame's status,
            or their frames are dropped.
        phase_unit: unit of phases in columns of their own; as names or values have it where empty.
        time_unit: time unit of t where it is a number; seconds that can be none are refused where
            empty.
        driven: readings with a driven electrode, which the protocol has as well, are left out.
        differences: the values are differences from the touch reference, which is added; without
            one, from the rows of baselines among them, of which the first row is one.
        order: order of the readings: "given" by the protocol, sense pairs from behind each drive
            pair on ("rotated"), "reversed", or sense pairs one by one at all drives
            ("sense-first"); tested by reciprocity and sums around loops where empty.

    Example:
        >>> from eitskin.datasets import RecordingForm
        >>> RecordingForm("before-during", length_unit="mm").origin
        'corner'
    """

    rows: Rows = "frames"
    keep_before: bool = False
    transpose: bool = False
    length_unit: LengthUnit = "m"
    origin: str = "corner"
    quantity: Quantity = ""
    scale: float = 1.0
    bad_values: BadValues = "refuse"
    phase_unit: PhaseUnit = ""
    time_unit: TimeUnit = ""
    order: Order = ""
    driven: bool = False
    differences: bool = False

    def __post_init__(self) -> None:
        """Check the choices; raises ConfigurationError."""
        for name, kind in get_type_hints(type(self)).items():
            if (choices := get_args(kind)) and getattr(self, name) not in choices:
                raise ConfigurationError(
                    f"{name.replace('_', ' ')} must be one of "
                    f"{', '.join(filter(None, choices))}, got '{getattr(self, name)}'"
                )
        if not abs(self.scale) > 0 or abs(self.scale) == float("inf"):
            raise ConfigurationError(f"the scale must be a finite factor, got {self.scale:g}")
        if self.rows != "frames" and (self.transpose or self.differences):
            raise ConfigurationError(
                "rows that alternate are neither transposed nor differences; give one of both"
            )


class RecordedFile:
    """File of a recording, from which frames are read in blocks.

    Attributes:
        path: path of the file.
        protocol: drive and sense pairs of the channels; None where unknown.
        unused: tables of the file that are not read.
        counts_from_one: whether names of columns count electrodes from 1.
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
        self._session, self._untested = session, True
        self._baseline: Complex = np.zeros(0, np.complex64)
        self._origin = origin_position(design, form.origin)
        with self.named_errors():
            self._open()

    def blocks(self) -> Iterator[Block]:
        """Frames of the file, block by block, checked; raises DataError that names the file."""
        first = 0
        place = self._places.get("t")
        time_factor = TIMES.get(
            self._form.time_unit, np.nan if place is None or place.factor == 1 else 1.0
        )
        clock = Clock(time_factor)
        with self.named_errors():
            for tables in self._source.blocks(self._wanted, self._form.phase_unit):
                block = self._block(framed := self._frame_tables(tables), first, clock)
                first += len(next(iter(framed.values())))
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
        self._source = source = Source(self.path, names.sheet, names.header_row)
        if names.values is None and source.usual_values is None:
            raise ConfigurationError(
                f"cannot find the values: nothing was named; {source.holds()}; name one of them "
                "with --values"
            )
        usual = source.usual(len(self.protocol) if self.protocol else 0)
        values = [source.require(names.values or usual or "", "values")]
        titles = source.titles(values[0])
        factor = unit_factor(titles) if form.scale == 1.0 else form.scale
        self._names_volts = form.scale == 1.0 and {t.rstrip("])")[-1:] for t in titles} == {"V"}
        self._form, self._scale = (form := replace(form, scale=factor)), factor
        named = self._protocol_of_file(titles)
        if self.protocol is not None and named is not None:
            require_protocol_of_names(self.protocol, named)
        own = source.contents
        patterns = names.patterns or (own.patterns if self.protocol is None else ())
        if self.protocol is None and not patterns:
            self.protocol = named
            if own.measured:
                self.protocol = Protocol.from_rows(own.measured, own.electrodes)
                form = replace(form, driven=own.driven, order=form.order or own.order)  # type: ignore[arg-type]
                self._form = form
                if own.currents:
                    self._scale = form.scale / np.array(own.currents)
        if self.protocol is not None:
            self.protocol = in_order(self.protocol, form.order)
        self._whole = self.protocol
        if self.protocol is not None and form.driven:
            rows = zip(self.protocol.table, self.protocol.shares, strict=True)
            rows_kept = [row for row, shared in rows if not shared]
            self.protocol = Protocol.from_rows(rows_kept, self.protocol.n_electrodes)
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
        self._wanted = ReadRequest(
            tuple(values),
            tuple(sorted(labels)),
            transposed=form.transpose,
            paired=form.rows != "frames",
            loses_cells=form.bad_values != "refuse",
            drops_rows=form.bad_values == "drop",
            block_rows=BLOCK_ROWS // self._whole_rows * self._whole_rows or BLOCK_ROWS,
        )
        parts = (part.strip() for name in values for part in name.split(","))
        used = {*values, *parts, *labels, *patterns}
        self.unused = source.unused_tables(used)
        if patterns:
            self._read_patterns(*patterns)

    def _protocol_of_file(self, titles: Sequence[str]) -> Protocol | None:
        """Protocol by columns of electrodes, or by the names of the values; None for neither."""
        named = protocol_of_names(titles)
        self.counts_from_one = named is not None and counts_from_one(titles)
        if quad := electrode_columns(self._source.names):
            blocks = self._source.blocks(ReadRequest(quad))
            rows = np.concatenate([np.hstack([t[name] for name in quad]) for t in blocks])
            named, self.counts_from_one = protocol_of_rows(rows), bool(rows.min() > 0)
        return named

    def _read_patterns(self, drive: str, sense: str) -> None:
        if self.protocol is not None:
            raise ConfigurationError("give either a protocol or patterns of the file, got both")
        matrices = []
        for name in (drive, sense):
            request = ReadRequest((self._source.require(name, "patterns"),))
            matrices.append(np.concatenate([t[name] for t in self._source.blocks(request)]))
        self.protocol, currents = protocol_of_patterns(*matrices)
        self._whole = self.protocol
        self._scale = self._form.scale / currents

    @property
    def labels(self) -> dict[str, str]:
        """Place of each label, as options say it."""
        return {label: place.text for label, place in self._places.items()}

    @property
    def detected_options(self) -> dict[str, str]:
        """Options that say what was understood of the values."""
        options = {"--values": self._wanted.values[0]}
        if self._whole is not None and (name := self._whole.short_name()):
            options["--protocol"] = name
        if self._form.scale != 1.0:
            options["--scale"] = f"{self._form.scale:g}"
        if self._names_volts and not self._form.quantity:
            options["--quantity"] = "voltage"
        return options

    @property
    def _whole_rows(self) -> int:
        """Rows of which a block has a multiple, so that frames and pairs of them are whole."""
        return 2 * len(self._whole or (0,))

    def _frame_tables(self, tables: Tables) -> Tables:
        """Tables with one row for each frame, where a row has one drive pair's readings, or one.

        So it is where rows are those of matrices of resistances between pairs of electrodes.
        """
        whole, names = self._whole, self._wanted.values
        rows, width = tables[names[0]].shape
        drives = len({row[:2] for row in whole.table}) if whole else 1
        per_frame = len(whole or ()) // width
        n = whole.n_electrodes if whole else width
        matrices = [Z for name in names if (Z := pair_matrices(tables[name], n)) is not None]
        if matrices and whole is None:
            raise DataError(
                f"the rows are those of {n} by {n} matrices: import with --protocol pairwise:{n} "
                "where they are resistances between pairs of electrodes, or "
                f"adjacent:{n}+driven and such where each row is of a drive pair"
            )
        if len(matrices) == len(names) and whole and all(row[:2] == row[2:] for row in whole.table):
            a, b, *_ = np.array(whole.table).T
            per_frame, framed = rows // len(matrices[0]), [Z[:, a, b] for Z in matrices]
        elif 1 < per_frame and (width == 1 or per_frame == drives) and rows % per_frame == 0:
            framed = [tables[name].reshape(-1, per_frame * width) for name in names]
        else:
            return tables
        others = {name: table[::per_frame] for name, table in tables.items()}
        return others | dict(zip(names, framed, strict=False))

    def _block(self, tables: Tables, first: int, clock: Clock) -> Block:
        """Frames of one block of tables, whose first row is row `first` of the file."""
        form = self._form
        values, *before = (self._read_values(tables, name) for name in self._wanted.values)
        if before and before[0].shape != values.shape:
            raise DataError(
                f"'{self._wanted.values[1]}' must have the shape of the values, "
                f"{values.shape}, got {before[0].shape}"
            )
        if form.differences and before:
            values = values + before[0]
        elif form.differences:
            values, self._baseline = add_baselines(values, self._baseline if first else values[0])
        elif not first and form.rows == "frames":
            require_no_baselines(values)
        block = Block(
            values,
            before[0] if before else None,
            read_labels(tables, self._places, LENGTHS[form.length_unit]),
            self._origins(tables, NAMES[:2], "", len(values)),
            self._origins(tables, NAMES[2:], self._session, len(values)),
            np.zeros(values.shape, dtype=np.uint8),
        )
        if "time" in block.labels:
            time = clock.seconds(block.labels["time"], block.specimens, block.sessions)
            block = replace(block, labels={**block.labels, "time": time})
        if form.rows != "frames":
            block, first = pair_rows(block, form.rows), first // 2
        if {"", "nan"} & {*block.specimens.tolist(), *block.sessions.tolist()}:
            raise DataError(
                "expected a specimen, sensor and session for every frame, got an empty cell; fill "
                "it, or leave the label out"
            )
        shifts = dict(zip(("touch_x", "touch_y"), self._origin, strict=True))
        labels = {name: label + shifts.get(name, 0) for name, label in block.labels.items()}
        require_plausible(labels, self._design, self._origin)
        return without_bad_values(replace(block, labels=labels), form.bad_values, first)

    def _read_values(self, tables: Tables, name: str) -> Complex:
        """Values or readings before a touch, scaled, (rows, C); raises DataError."""
        table = tables[name]
        if not np.issubdtype(table.dtype, np.number):
            raise DataError(
                f"'{name}' must be a matrix of numbers, frames by columns, got {table.dtype}"
            )
        whole = self._whole
        if whole is not None and len(whole) != table.shape[1]:
            raise DataError(self._wrong_count(table.shape))
        if whole is not None and not self._form.order and self._untested:
            values = np.where(np.isfinite(table), table, 0)
            mean = values.sum(axis=0) / np.maximum(np.isfinite(table).sum(axis=0), 1)
            require_order(whole, mean, self._design)
            self._untested = False
        with np.errstate(over="ignore", invalid="ignore"):
            scaled: Complex = (table * self._scale).astype(np.complex64)
        if whole is not None and whole != self.protocol:
            scaled = scaled[:, ~np.array(whole.shares)]
        return scaled

    def _wrong_count(self, shape: tuple[int, ...]) -> str:
        """Message for another number of channels than the protocol has."""
        whole = self._whole
        fitting = fitting_protocols(whole.n_electrodes if whole else 0, shape[1])
        hint = f", such as {' or '.join(fitting)}" if fitting else ", or its table, --protocol FILE"
        if len(whole or ()) == shape[0]:
            hint += "; the table has as many rows: read it with --transpose"
        elif whole and len(whole) * 2 in (shape[1] * (shape[1] - 1), shape[1] * (shape[1] + 1)):
            hint = "; a matrix of resistances has all rows, 0 on the diagonal, and equal sides or 0"
        elif whole and 2 * len(whole) == shape[1]:
            hint += (
                "; two columns each are read by names as mag0,phase0,mag1 ... or re0,im0,re1 ..."
            )
        return (
            f"the protocol has {len(whole or ())} measurements, but the frames have "
            f"{shape[1]} channels; give the protocol they were measured with{hint}"
        )

    def _origins(
        self, tables: Tables, labels: Sequence[str], within: str, rows: int
    ) -> NDArray[np.str_]:
        """Names of specimens or sessions of a block's rows, (rows,), after the name `within`."""
        columns = [
            names_of_origin(tables, self._places, label)
            for label in labels
            if label in self._places
        ]
        if within or not columns:
            columns.insert(0, np.full(rows, within or "0"))
        return np.array([" ".join(names).strip() for names in zip(*columns, strict=True)])


def fitting_protocols(n_electrodes: int, channels: int) -> list[str]:
    """Names of protocols with as many measurements; the usual numbers of electrodes for 0."""
    protocols = []
    for n in [n_electrodes] if n_electrodes else (4, 6, 8, 10, 12, 16, 20, 24, 32, 64):
        protocols += [f"pairwise:{n}"] * (not n_electrodes and channels == n * n)  # as matrices
        for name in ("pairwise", "adjacent", "opposite", "skip:1", "skip:2", "skip:3"):
            for text in (f"{name}:{n}", f"{name}:{n}+driven"):
                with suppress(ConfigurationError):
                    if len(Protocol.from_name(text)) == channels:
                        protocols.append(text)
    return protocols
