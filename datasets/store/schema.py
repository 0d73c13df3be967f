"""Schema of the dataset format: names, types, axes and units, as in docs/dataset-format.md."""

from dataclasses import dataclass
from typing import Any, Final

import numpy as np

FORMAT: Final = "eitskin-dataset"
FORMAT_VERSION: Final = 2
MAX_TOUCHES: Final = 4
MOST_REFERENCE_FRAMES: Final = 1000

# Larger sizes are refused before memory is allocated: a foreign shard may claim any size.
LIMITS: Final = {"frame": 1 << 20, "channel": 1 << 14, "specimen": 1 << 16, "touch": MAX_TOUCHES}
MAX_VALUES: Final = 1 << 26
MOST_SHARD_BYTES: Final = 1 << 31


@dataclass(frozen=True, slots=True)
class Field:
    """One array of the format.

    Attributes:
        name: attribute of `Dataset`.
        path: of the HDF5 dataset.
        dtype: in memory and in the file.
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
    *,
    finite: bool = False,
    missing: float = 0,
    since: int | None = 1,
) -> Field:
    grouped = axes == "frame touch" or name.startswith("clamp_")
    path = name.replace("_", "/", 1) if grouped else name
    split = tuple(axes.split())
    return Field(name, path, np.dtype(dtype), split, units, description, finite, missing, since)


QUANTITIES: Final = ("impedance", "magnitude", "voltage")

NAN: Final = float("nan")
FIELDS: Final = (
    _field("impedance", "<c8", "frame channel", "ohm", "measured transfer impedance", finite=True),
    _field(
        "touch_reference",
        "<c8",
        "frame channel",
        "ohm",
        "untouched sensor at the same bend, measured with its own noise; NaN where unknown",
        missing=NAN,
    ),
    _field(
        "reference",
        "<c8",
        "specimen channel",
        "ohm",
        "flat untouched sensor, free of noise where simulated",
        finite=True,
    ),
    _field(
        "specimen_number",
        "<u4",
        "specimen",
        "1",
        "number of the specimen within the dataset, rising",
        since=2,
    ),
    _field("specimen", "<u4", "frame", "1", "which sensor, a row of reference", finite=True),
    _field("state", "|u1", "frame", "1", "idle, touch or bend; 255 where unknown", missing=255),
    _field("bend_angle_deg", "<f4", "frame", "degree", "bend; NaN where unknown", missing=NAN),
    _field("touch_x", "<f4", "frame touch", "m", "place of a touch; NaN where absent", missing=NAN),
    _field("touch_y", "<f4", "frame touch", "m", "place of a touch; NaN where absent", missing=NAN),
    _field(
        "touch_force",
        "<f4",
        "frame touch",
        "N",
        "force of a touch; NaN where absent or unknown",
        missing=NAN,
    ),
    _field(
        "touch_radius",
        "<f4",
        "frame touch",
        "m",
        "radius of the indenter; NaN where absent or unknown",
        missing=NAN,
    ),
    _field(
        "touch_depth",
        "<f4",
        "frame touch",
        "m",
        "depth of a touch; NaN where absent or unknown",
        missing=NAN,
        since=None,
    ),
    _field(
        "clamp_span",
        "<f4",
        "frame",
        "m",
        "free length between the plates of the clamp; NaN where unknown",
        missing=NAN,
        since=None,
    ),
    _field(
        "clamp_offset",
        "<f4",
        "frame",
        "m",
        "axis of the clamp below the mid-plane of the layer; NaN where unknown",
        missing=NAN,
        since=None,
    ),
    _field(
        "clamp_faces",
        "<f4",
        "frame",
        "1",
        "faces held by the plates of the clamp, 1 or 2; NaN where unknown",
        missing=NAN,
        since=None,
    ),
    _field(
        "clamp_stiffness",
        "<f4",
        "frame",
        "1",
        "shear modulus of the encapsulation over that of the layer; NaN where unknown",
        missing=NAN,
        since=None,
    ),
    _field("time", "<f8", "frame", "s", "since the episode began", finite=True),
    _field("status", "|u1", "frame channel", "1", "status bits of the board, 0 is good"),
    _field("episode", "<u4", "frame", "1", "frames of one episode follow each other in time"),
    _field("number", "<u4", "frame", "1", "as counted; a gap is frames lost", since=2),
)
CLAMP_FIELDS: Final = tuple(field.name for field in FIELDS if field.path.startswith("clamp/"))
FRAME_FIELDS: Final = tuple(field for field in FIELDS if field.axes[0] == "frame")
