"""Schema of the dataset format: names, types, axes, units and values, as in its page in docs."""

import math
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from eitskin.bounds import LARGEST_READING, LONGEST, MOST
from eitskin.errors import DataError
from eitskin.files import quote_value

FORMAT: Final = "eitskin-dataset"
FORMAT_VERSION: Final = 2
ENGINE: Final = 2  # number of the simulation, raised where frames change beyond rounding
MAX_TOUCHES: Final = 4
AVERAGED: Final = ("reference_frames", "touch_frames")
"""Keys of recipes: frames averaged for each `touch_reference`, and for each touched frame."""
MAX_AVERAGED_FRAMES: Final = 1000

# Larger sizes are refused before memory is allocated: a foreign shard may claim any size.
LIMITS: Final = {"frame": 1 << 20, "channel": 1 << 14, "specimen": 1 << 16, "touch": MAX_TOUCHES}
MAX_VALUES: Final = 1 << 26
MAX_SHARD_BYTES: Final = 1 << 31

UNKNOWN_STATE: Final = 255
"""Value for an unknown state in arrays; no class, and so no member of `State`."""


class State(IntEnum):
    """State of the sensor in one frame; `TOUCH` for a sensor both bent and touched.

    Example:
        >>> from eitskin.datasets import State
        >>> [state.name for state in State]
        ['IDLE', 'TOUCH', 'BEND']
    """

    IDLE = 0
    TOUCH = 1
    BEND = 2


@dataclass(frozen=True, slots=True)
class Field:
    """One array of the format.

    Attributes:
        name: attribute of `Dataset`.
        path: path of the HDF5 dataset.
        dtype: dtype in memory and in the file.
        axes: names of the axes, of "frame", "channel", "touch" and "specimen".
        units: SI, or "1".
        description: one line, written into the file.
        finite: whether NaN and infinity are refused.
        missing: value for "unknown".
        since: first version of the format whose files all hold the array; None for an array that
            only files with known values hold.
    """

    name: str
    path: str
    dtype: np.dtype[Any]
    axes: tuple[str, ...]
    units: str
    description: str
    finite: bool = False
    missing: float = 0
    since: int | None = 1


def _field(
    name: str,
    dtype: str,
    axes: str,
    units: str,
    description: str,
    since: int | None = 1,
) -> Field:
    grouped = axes == "frame touch" or name.startswith("clamp_")
    path = name.replace("_", "/", 1) if grouped else name
    unknown = float("nan") if "NaN" in description else UNKNOWN_STATE if name == "state" else 0
    finite = name in ("impedance", "reference", "specimen", "time")
    split = tuple(axes.split())
    return Field(name, path, np.dtype(dtype), split, units, description, finite, unknown, since)


QUANTITIES: Final = ("impedance", "magnitude", "voltage")

_BEND_COLUMNS: Final = (
    "untouched sensor at the same bend, measured with its own noise; NaN where unknown"
)
_FLAT: Final = "flat untouched sensor, free of noise where simulated"
_SPAN: Final = "free length between the plates of the clamp; NaN where unknown"
_OFFSET: Final = "axis of the clamp below the mid-plane of the layer; NaN where unknown"
_FACES: Final = "faces held by the plates of the clamp, 1 or 2; NaN where unknown"
_STIFFNESS: Final = "shear modulus of the encapsulation over that of the layer; NaN where unknown"
_GAP: Final = "gap between the plates that carry the sensor, 0 on a base; NaN where unknown"
_NUMBER: Final = "number of the specimen within the dataset, rising"
_RADIUS: Final = "radius of the indenter; NaN where absent or unknown"
_FORCE: Final = "force of a touch; NaN where absent or unknown"
_DEPTH: Final = "depth of a touch; NaN where absent or unknown"

FIELDS: Final = (
    _field("impedance", "<c8", "frame channel", "ohm", "measured transfer impedance"),
    _field("touch_reference", "<c8", "frame channel", "ohm", _BEND_COLUMNS),
    _field("reference", "<c8", "specimen channel", "ohm", _FLAT),
    _field("specimen_number", "<u4", "specimen", "1", _NUMBER, since=2),
    _field("specimen", "<u4", "frame", "1", "which sensor, a row of reference"),
    _field("state", "|u1", "frame", "1", "idle, touch or bend; 255 where unknown"),
    _field("bend_angle_deg", "<f4", "frame", "degree", "bend; NaN where unknown"),
    _field("touch_x", "<f4", "frame touch", "m", "place of a touch; NaN where absent"),
    _field("touch_y", "<f4", "frame touch", "m", "place of a touch; NaN where absent"),
    _field("touch_force", "<f4", "frame touch", "N", _FORCE),
    _field("touch_radius", "<f4", "frame touch", "m", _RADIUS),
    _field("touch_depth", "<f4", "frame touch", "m", _DEPTH, since=None),
    _field("clamp_span", "<f4", "frame", "m", _SPAN, since=None),
    _field("clamp_offset", "<f4", "frame", "m", _OFFSET, since=None),
    _field("clamp_faces", "<f4", "frame", "1", _FACES, since=None),
    _field("clamp_stiffness", "<f4", "frame", "1", _STIFFNESS, since=None),
    _field("support_gap", "<f4", "frame", "m", _GAP, since=None),
    _field("time", "<f8", "frame", "s", "since the episode began"),
    _field("status", "|u1", "frame channel", "1", "status bits of the board, 0 is good"),
    _field("episode", "<u4", "frame", "1", "frames of one episode follow each other in time"),
    _field("number", "<u4", "frame", "1", "as counted; a gap is frames lost", since=2),
)
CLAMP_FIELDS: Final = tuple(field.name for field in FIELDS if field.path.startswith("clamp/"))
FRAME_FIELDS: Final = tuple(field for field in FIELDS if field.axes[0] == "frame")


MAX_MAGNITUDES: Final = {
    **dict.fromkeys(("impedance", "touch_reference", "reference"), LARGEST_READING),
    **dict.fromkeys(("touch_x", "touch_y", "touch_radius", "touch_depth"), LONGEST),
    **dict.fromkeys(("clamp_span", "clamp_offset", "support_gap"), LONGEST),
    "bend_angle_deg": 720.0,
    "touch_force": 1e6,
    "clamp_stiffness": MOST,
    "time": 1e10,
}
"""Largest magnitude of a column's values, in its units: beyond it, units or digits are wrong."""


def require_format(name: object, version: object) -> int:
    """Version of a file of this format; raises DataError for another format or version."""
    if name != FORMAT:
        raise DataError(f"expected format '{FORMAT}', got {quote_value(name)}")
    if not isinstance(version, int) or version < 1:
        raise DataError(f"expected a format version of 1 or more, got {quote_value(version)}")
    if version > FORMAT_VERSION:
        raise DataError(
            f"format version {version} is newer than {FORMAT_VERSION}, the last that this eitskin "
            "reads; upgrade with pip install --upgrade eitskin"
        )
    return version


def _is_positive(values: NDArray[Any]) -> NDArray[np.bool_]:
    return np.asarray(np.isfinite(values) & (values > 0))


_POSSIBLE_FIXTURES: Final[dict[str, tuple[Callable[[NDArray[Any]], NDArray[np.bool_]], str]]] = {
    "clamp_span": (_is_positive, "a positive length in m"),
    "clamp_offset": (np.isfinite, "a length in m"),
    "clamp_faces": (lambda values: np.isin(values, (1, 2)), "1 or 2"),
    "clamp_stiffness": (_is_positive, "a positive ratio of moduli"),
    "support_gap": (lambda values: np.isfinite(values) & (values >= 0), "a length in m, or 0"),
}


def check_values(columns: Mapping[str, NDArray[Any]]) -> None:
    """Raise DataError for values that the format refuses, in those columns that are given."""
    for field in FIELDS:
        values = columns.get(field.name)
        if field.finite and values is not None and not np.isfinite(values).all():
            row = int(np.argwhere(~np.isfinite(values))[0][0])
            raise DataError(
                f"{field.name} must be finite, but {field.axes[0]} {row} is not; leave such "
                "frames out"
            )
    for name in MAX_MAGNITUDES.keys() & columns.keys():
        limit = MAX_MAGNITUDES[name]
        if len(wrong := columns[name][np.abs(columns[name]) > limit]):
            units = next(field.units for field in FIELDS if field.name == name)
            raise DataError(
                f"{name} must be at most {limit:g} {units} in magnitude, got {wrong[0]:g}; is it "
                "in another unit?"
            )
    numbers = columns.get("specimen_number", np.zeros(1)).astype(np.int64)
    if (np.diff(numbers) <= 0).any() or numbers[-1] >= LIMITS["specimen"]:
        raise DataError(
            f"specimen_number must rise and stay below {LIMITS['specimen']}, got "
            f"{np.array2string(numbers, threshold=8)}"
        )
    if "specimen" in columns and "reference" in columns:
        specimens, most = len(columns["reference"]), columns["specimen"].max(initial=0)
        if most >= specimens:
            raise DataError(f"specimen {most} has no reference; there are {specimens}")
    for name, (possible, expected) in _POSSIBLE_FIXTURES.items():
        values = columns.get(name, np.zeros(0))
        wrong = values[~(np.isnan(values) | possible(values))]
        if len(wrong):
            raise DataError(f"{name} must be {expected}, or NaN where unknown, got {wrong[0]:g}")
    states = columns.get("state", np.zeros(0, np.uint8))
    if wrong_states := set(np.unique(states).tolist()) - {*State, UNKNOWN_STATE}:
        known = ", ".join(f"{state.value} {state.name.lower()}" for state in State)
        raise DataError(
            f"states must be {known} or {UNKNOWN_STATE} unknown, got {sorted(wrong_states)}"
        )
    if "touch_x" in columns and "touch_y" in columns:
        finite_coordinates = (np.isfinite(columns[name]) for name in ("touch_x", "touch_y"))
        if not np.array_equal(*finite_coordinates):
            raise DataError("a touch needs both touch_x and touch_y; one of them is NaN")


class SpecimenReferences(dict[int, NDArray[Any]]):
    """References of specimens by number, each kept once; parts must agree on those they share."""

    def add(self, numbers: NDArray[np.uint32], reference: NDArray[Any]) -> None:
        """Add the specimens of one part: rising numbers (S,), and a row of `reference` for each.

        Raises DataError where a specimen has another reference than in the parts before.
        """
        for number, row in zip(numbers.tolist(), reference, strict=True):
            if not np.array_equal(self.setdefault(number, row), row):
                raise DataError(
                    "the parts of a dataset must share the reference of a specimen, but that of "
                    f"specimen {number} differs; these were not made together"
                )

    def to_arrays(self) -> tuple[NDArray[np.uint32], NDArray[Any]]:
        """Numbers of all specimens, rising, (S,), and their references (S, C)."""
        numbers = sorted(self)
        return np.array(numbers, dtype=np.uint32), np.array([self[n] for n in numbers])


class ColumnCollector:
    """Columns of a dataset, filled from its parts one at a time, and references of specimens."""

    def __init__(self, channels: int, frames: int, names: Collection[str]) -> None:
        """Begin with uninitialised columns `names` of as many channels and frames."""
        sizes = {"frame": frames, "channel": channels, "touch": MAX_TOUCHES}
        self.references = SpecimenReferences()
        self._columns = {
            field.name: np.empty([sizes[axis] for axis in field.axes], field.dtype)
            for field in FRAME_FIELDS
            if field.name in names
        }

    def put(self, rows: slice | NDArray[np.int64], part: Mapping[str, NDArray[Any]]) -> None:
        """Fill some rows with the columns of a part; raises DataError for other references."""
        if "reference" in part:
            self.references.add(part["specimen_number"], part["reference"])
        for name, column in self._columns.items():
            values = part[name]
            column[rows] = part["specimen_number"][values] if name == "specimen" else values

    def whole(self) -> dict[str, Any]:
        """All columns by name, (n, ...), with those of the specimens of all parts, (S, ...)."""
        if "specimen" not in self._columns:
            return self._columns
        numbers, reference = self.references.to_arrays()
        rows = np.searchsorted(numbers, self._columns["specimen"]).astype(np.uint32)
        return self._columns | {
            "specimen": rows,
            "specimen_number": numbers,
            "reference": reference,
        }


def frame_bytes(channels: int, names: Collection[str]) -> int:
    """Size in memory of the columns `names` of one frame."""
    sizes = {"channel": channels, "touch": MAX_TOUCHES, "frame": 1}
    return sum(
        field.dtype.itemsize * math.prod(sizes[axis] for axis in field.axes)
        for field in FRAME_FIELDS
        if field.name in names
    )
