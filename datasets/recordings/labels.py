"""Labels of a recording's frames: where each stands in the file, its unit, and plausibility."""

import difflib
import re
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from eitskin.bounds import LONGEST
from eitskin.datasets.recordings.reader import Tables
from eitskin.datasets.recordings.source import Source
from eitskin.datasets.store.schema import MAX_TOUCHES, UNKNOWN_STATE, State
from eitskin.errors import ConfigurationError, DataError
from eitskin.files import quote_value
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.geometry.design.surface import Surface

_TOUCHES: Final = {
    "x": "touch_x",
    "y": "touch_y",
    "depth": "touch_depth",
    "radius": "touch_radius",
    "force": "touch_force",
}
NAMES: Final = ("specimen", "sensor", "session")
"""Labels that distinguish frames of different origin, by number or name."""

_LABELS: Final = ("state", "angle_deg", "t", *_TOUCHES, *NAMES)
_PLACE: Final = re.compile(r"(?P<name>.+?)(?::(?P<column>\d{1,4}))?(?:\*(?P<factor>[-+.\deE]+))?")

MAX_FORCE: Final = 500.0  # N on a skin; more is most likely grams
_MARGIN: Final = 0.01  # of the sensor's size, by which positions may have an error at the rim
_SCATTERED, _LEAST_SPAN = 10, 200  # so many positions spread over this fraction of the sensor
MAX_FRAME_PERIOD: Final = 30.0  # s from frame to frame
MIN_FRAME_PERIOD: Final = 2e-5  # s; days of a spreadsheet are shorter
MAX_WHOLE_PERIOD: Final = 2.0  # s, where all times are whole numbers
MAX_EPOCH_TIME: Final = 1e11  # s since 1970
_WRAPS: Final = (2**32 / 1e3, 2**32 / 1e6)
"""Periods of counters of milliseconds and microseconds in 32 bits [s]."""

_STATES: Final = {
    State.IDLE: "idle none untouched flat rest baseline reference background",
    State.TOUCH: "touch touched press pressed pressing contact",
    State.BEND: "bend bent bending",
}
"""Words for each state."""

_UNIT: Final = "--length-unit mm, cm or um where they are in another unit"


@dataclass(frozen=True, slots=True)
class Place:
    """Place of a label in a file: a column of a table, or one value for all frames.

    Attributes:
        text: the place as an option says it.
        table: name of the table; None for one value.
        column: column of the table; None for all its columns, one per touch.
        factor: factor that makes SI units of the numbers.
        value: value of all frames that have a touch, where there is no table.
    """

    text: str
    table: str | None
    column: int | None = None
    factor: float = 1.0
    value: float = np.nan

    @classmethod
    def from_text(cls, text: str) -> "Place":
        """Place of NAME, NAME:COLUMN, NAME*FACTOR, or a number; raises ConfigurationError."""
        try:
            return cls(text, None, value=float(text))
        except ValueError:
            pass
        match = _PLACE.fullmatch(text)
        try:
            factor = float((match and match["factor"]) or 1.0)
        except ValueError:
            factor = np.nan
        if match is None or not 0 < abs(factor) < np.inf:
            raise ConfigurationError(
                "expected NAME, NAME:COLUMN, NAME*FACTOR or a number as the place of a label, got "
                f"'{text}'"
            )
        return cls(text, match["name"], int(match["column"]) if match["column"] else None, factor)


def find_labels(
    source: Source, options: Mapping[str, str], positions: str | None
) -> dict[str, Place]:
    """Places of the labels that a file has, by label.

    Places that are `options` are texts for `Place.from_text`; other labels are taken from tables of
    their names, `positions` from a table with x and y as first columns. Raises ConfigurationError
    for unknown labels, and tables that the file does not have.
    """
    for label in options:
        if label not in _LABELS:
            near = difflib.get_close_matches(label, _LABELS, 1)
            hint = f"; did you mean '{near[0]}'?" if near else ""
            raise ConfigurationError(
                f"expected a label of {', '.join(_LABELS)}, got '{label}'{hint}"
            )
    places = {name: Place(name, name) for name in _LABELS if name in source.names}
    if positions:
        places |= {n: Place(f"{positions}:{i}", positions, i) for i, n in enumerate("xy")}
    places |= {label: Place.from_text(text) for label, text in options.items()}
    for label, place in places.items():
        if place.table is not None:
            source.require(place.table, "positions" if label in "xy" else f"label '{label}'")
        elif label not in _TOUCHES:
            raise ConfigurationError(
                f"one value for all frames is for {', '.join(_TOUCHES)}, got '{label}'; name a "
                "column"
            )
    if ("x" in places) != ("y" in places):
        alone = "x" if "x" in places else "y"
        raise DataError(
            f"a touch needs both touch_x and touch_y, got {alone} only; name the other with "
            "--column, or leave both out"
        )
    return places


def read_labels(tables: Tables, places: Mapping[str, Place], unit: float) -> dict[str, Any]:
    """Labels of a block of frames under the names of `Dataset`'s attributes; `unit` of lengths [m].

    Frames with a position and without a state are touches. Raises DataError for labels that are no
    numbers, and states that are unknown.
    """
    labels: dict[str, Any] = {}
    for label, place in places.items():
        if place.table is None or label in NAMES:
            continue
        table = _table(tables, place, label)
        if label == "state":
            labels["state"] = _states(_column(table, place, label))
        elif label == "t":
            labels["time"] = _times(_column(table, place, label), place.factor)
        elif label == "angle_deg":
            angles = _numbers(_column(table, place, label), label)
            labels["bend_angle_deg"] = angles * place.factor
        else:
            factor = place.factor * (1.0 if label == "force" else unit)
            labels[_TOUCHES[label]] = _touches(_numbers(table, label) * factor, label)
    if "touch_x" in labels:
        touched = np.isfinite(labels["touch_x"])
        for label, place in places.items():
            if place.table is None:
                labels[_TOUCHES[label]] = np.where(touched, place.value, np.nan)
        inferred = np.where(touched.any(axis=1), int(State.TOUCH), UNKNOWN_STATE)
        labels.setdefault("state", inferred.astype(np.uint8))
    return labels


def names_of_origin(tables: Tables, places: Mapping[str, Place], label: str) -> NDArray[np.str_]:
    """Specimen, sensor or session of each frame of a block, (rows,); whole numbers as such."""
    column = _column(_table(tables, places[label], label), places[label], label)
    if column.dtype.kind == "U":
        return column.astype(np.str_)
    names = [str(int(v)) if float(v).is_integer() else str(v) for v in column.tolist()]
    return np.array(names, dtype=np.str_)


def _table(tables: Tables, place: Place, label: str) -> NDArray[Any]:
    """Table of a label, or the one column of it that is named, (rows, columns)."""
    table = tables[str(place.table)]
    if place.column is None:
        return table
    if place.column >= table.shape[1]:
        raise DataError(
            f"'{place.table}' has {table.shape[1]} columns, counted from 0, got column "
            f"{place.column} for '{label}'"
        )
    return table[:, place.column : place.column + 1]


def _column(table: NDArray[Any], place: Place, label: str) -> NDArray[Any]:
    """The only column of a table, (rows,); raises DataError for more."""
    if table.shape[1] != 1:
        raise DataError(
            f"'{label}' must have one value for each frame, got {table.shape[1]}; name one column "
            f"as {place.table}:0"
        )
    column: NDArray[Any] = table[:, 0]
    return column


def _times(column: NDArray[Any], factor: float) -> NDArray[Any]:
    """Times (rows,), numbers in the unit of the file or dates; raises DataError."""
    import pandas as pd

    try:
        times = _numbers(column, "t") * factor
    except DataError as error:
        # Fractions of seconds behind a comma or, in three digits, a colon.
        marked = [
            re.sub(r"(:\d\d)(?:,(?=\d)|:(?=\d{3}$))", r"\1.", each) for each in column.tolist()
        ]
        column = np.array(marked)
        for form in ("ISO8601", "%d.%m.%Y %H:%M:%S", "%m/%d/%Y %I:%M:%S %p"):
            with suppress(ValueError):
                dates = pd.to_datetime(column, utc=True, format=form)
                return np.asarray(dates.tz_localize(None), dtype="M8[ns]")
        with suppress(ValueError, TypeError):
            return np.asarray(pd.to_timedelta(column), dtype="m8[ns]").astype("M8[ns]")
        raise DataError(
            f"{error}; expected times as numbers, as dates such as 2026-11-23T14:05:00.3, or as "
            "14:05:00.3"
        ) from error
    if not np.isfinite(times).all():
        row = int(np.flatnonzero(~np.isfinite(times))[0])
        raise DataError(f"'t' must be finite, but its value {row} is not; leave the label out")
    return times


@dataclass(slots=True)
class Clock:
    """Times of a recording's blocks in seconds on a clock that does not go back.

    Attributes:
        unit: unit of the times in the file [s]; NaN where it was not given.
        ends: ends of each specimen and session the last time in the file, what its wraps add, and
            the usual step [s].
    """

    unit: float
    ends: dict[tuple[str, str], tuple[float, float, float]] = field(default_factory=dict)

    def seconds(
        self, times: NDArray[Any], specimens: NDArray[np.str_], sessions: NDArray[np.str_]
    ) -> NDArray[np.float64]:
        """Times of consecutive frames (n,) [s], of dates since 1970; DataError where none can be.

        A counter of 32 bits that begins again goes on.
        """
        unit = times.dtype.kind == "M" or not np.isnan(self.unit)
        if times.dtype.kind == "M":
            times = times.astype(np.int64) / 1e9
        else:
            times = times * (self.unit if unit else 1.0)
        origins = np.stack([specimens, sessions], axis=1)
        for origin in np.unique(origins, axis=0):
            rows = np.flatnonzero((origins == origin).all(axis=1))
            key = (str(origin[0]), str(origin[1]))
            last, later, usual = self.ends.get(key, (times[rows[0]], 0.0, 0.0))
            steps = np.diff(times[rows], prepend=last)
            usual = float(np.median(steps[steps > 0])) if (steps > 0).any() else usual
            whole = (times[rows] == np.round(times[rows])).all()
            longest = MAX_WHOLE_PERIOD if whole else MAX_FRAME_PERIOD
            unlikely = usual > longest or 0 < usual < MIN_FRAME_PERIOD
            if not unit and (unlikely or abs(times[rows]).max() > MAX_EPOCH_TIME):
                raise DataError(
                    f"times such as {times[rows[0]]:.15g} and {times[rows[-1]]:.15g}, {usual:g} "
                    "from frame to frame, are hardly seconds; import with --time-unit ms or us, "
                    "with --column t=NAME*86400 for days, or with --time-unit s where they are"
                )
            wraps = np.zeros(len(steps))
            for period in _WRAPS:
                wraps[(steps < 0) & (0 <= steps + period) & (steps + period <= 10 * usual)] = period
            if (wrong := steps + wraps < 0).any():
                row = int(wrong.argmax())
                now = times[rows[row]]
                raise DataError(
                    f"'t' runs backwards, from {now - steps[row]:.12g} to {now:.12g} s; name the "
                    "column of sessions with --column session=NAME, import each session "
                    "as a file, or rename the column t to leave it out"
                )
            self.ends[key] = float(times[rows[-1]]), later + float(wraps.sum()), usual
            times[rows] += later + np.cumsum(wraps)
        return times


def _numbers(table: NDArray[Any], label: str) -> NDArray[np.float64]:
    """Table of a label as numbers, NaN where empty."""
    if table.dtype.kind == "U":
        table = np.where(np.char.strip(table) == "", "nan", table)
    try:
        if table.dtype.kind == "M":
            raise TypeError("expected numbers, got dates")
        return np.real(table).astype(np.float64)
    except (ValueError, TypeError) as error:
        raise DataError(f"'{label}' must hold numbers: {error}") from error


def _touches(table: NDArray[np.float64], label: str) -> NDArray[np.float64]:
    """Values of up to four touches per frame in the format's four columns, (rows, 4)."""
    if table.shape[1] > MAX_TOUCHES:
        raise DataError(
            f"'{label}' must have one column for each of at most {MAX_TOUCHES} touches, got "
            f"{table.shape[1]} columns; name one as NAME:0"
        )
    spare = ((0, 0), (0, MAX_TOUCHES - table.shape[1]))
    return np.pad(table, spare, constant_values=np.nan)


def _states(values: NDArray[Any]) -> NDArray[np.uint8]:
    """States from names or numbers, (n,); an empty cell is unknown."""
    numbers_by_name = {"": UNKNOWN_STATE}
    for state, words in _STATES.items():
        numbers_by_name |= dict.fromkeys([str(int(state)), *words.split()], int(state))
    cells = [str(cell).strip().lower().removesuffix(".0") for cell in values.tolist()]
    if wrong := sorted(set(cells) - set(numbers_by_name)):
        got = ", ".join(quote_value(cell) for cell in wrong[:3])
        raise DataError(f"'state' must be idle, touch, bend or 0, 1, 2, got {got}")
    return np.array([numbers_by_name[cell] for cell in cells], dtype=np.uint8)


def origin_position(design: SensorDesign | None, origin: str) -> tuple[float, float]:
    """Position of the recording's origin on the design [m].

    An origin is "corner" of the bounding box, its "centre", or "X,Y" [m]. Raises ConfigurationError
    for another text, and a centre without a design.
    """
    if origin == "corner":
        return 0.0, 0.0
    if origin == "centre":
        if design is None:
            raise ConfigurationError(
                "an origin at the centre needs the sensor's design; add --sensor DESIGN.toml"
            )
        return design.centre[:2]
    try:
        x, y = (float(cell) for cell in origin.split(","))
    except ValueError:
        raise ConfigurationError(
            f"expected an origin as corner, centre or X,Y in metres, got '{origin}'"
        ) from None
    return x, y


def require_plausible(
    labels: Mapping[str, NDArray[Any]], design: SensorDesign | None, origin: tuple[float, float]
) -> None:
    """Raise DataError for positions next to the sensor, and sizes and forces of other units.

    Positions are those on the design, on which the recording's own count from `origin` [m].
    """
    extent = LONGEST
    if design is not None and not isinstance(design.outline, Surface):
        extent = max(design.outline.length, design.outline.width)
    for name, meaning in (("touch_depth", "depths"), ("touch_radius", "radii of indenters")):
        sizes = _finite(labels, name)
        if sizes.size and (sizes.min() < 0 or sizes.max() > extent):
            raise DataError(
                f"{meaning} must be in metres, from 0 to {extent:g} m, got {sizes.min():g} to "
                f"{sizes.max():g}; import with {_UNIT}"
            )
    force = _finite(labels, "touch_force")
    if force.size and np.abs(force).max() > MAX_FORCE:
        raise DataError(
            f"forces must be in newtons, up to {MAX_FORCE:g} N, got {force.max():g}; import "
            "with --column force=NAME*0.00981 where they are in grams"
        )
    _require_positions(labels, design, extent, origin)


def _require_positions(
    labels: Mapping[str, NDArray[Any]],
    design: SensorDesign | None,
    extent: float,
    origin: tuple[float, float],
) -> None:
    names = ("touch_x", "touch_y")
    positions = np.concatenate([_finite(labels, n) - o for n, o in zip(names, origin, strict=True)])
    if not positions.size:
        return
    least, most = positions.min(), positions.max()
    if np.abs(positions).max() > min(LONGEST, 3 * extent):
        limit = f"up to {LONGEST:g} m" if design is None else f"on a sensor of {extent:g} m"
        raise DataError(
            f"positions must be in metres, {limit}, got {least:g} to {most:g}; import with {_UNIT}"
        )
    if design is None or isinstance(design.outline, Surface):
        return
    points = np.stack([np.ravel(labels[name]) for name in names], axis=-1)
    points = points[np.isfinite(points).all(axis=1)]
    span = float(np.ptp(points, axis=0).max()) if len(points) else 0.0
    if len(np.unique(points, axis=0)) >= _SCATTERED and span < extent / _LEAST_SPAN:
        raise DataError(
            f"{len(points)} positions on a sensor of {extent:g} m lie within {span:g} m; expected "
            "metres: import with the --length-unit that the file has"
        )
    outside = ~design.outline.contains(points, -_MARGIN * extent)
    if outside.any():
        first = points[int(np.flatnonzero(outside)[0])]
        centred = "; import with --origin centre where they count from the sensor's middle"
        raise DataError(
            f"positions must lie on the sensor, x from 0 to {design.outline.length:g} m and y from "
            f"0 to {design.outline.width:g} m, but {int(outside.sum())} of {len(points)} are "
            f"outside of it, the first at ({first[0]:g}, {first[1]:g}) m"
            f"{centred if least < 0 and origin == (0.0, 0.0) else ''}"
        )


def _finite(labels: Mapping[str, NDArray[Any]], name: str) -> NDArray[np.float64]:
    """Finite values of a label, or none."""
    values = np.asarray(labels.get(name, ()), dtype=np.float64)
    return values[np.isfinite(values)]
