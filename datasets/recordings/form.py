"""Form of a recording: names of its tables, arrangement of its rows, and units of its numbers."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final, Literal, get_args

from eitskin.errors import ConfigurationError

Rows = Literal["frames", "before-during", "during-before"]
LengthUnit = Literal["m", "cm", "mm", "um"]
Quantity = Literal["", "impedance", "magnitude", "voltage"]
BadValues = Literal["refuse", "mark", "drop"]

LENGTHS: Final[Mapping[str, float]] = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6}


@dataclass(frozen=True, slots=True)
class RecordingNames:
    """Names of the tables in a file: of variables, or of columns.

    Numbered columns such as v0, v1 ... are one table, v; FIRST..LAST is the table of the columns
    from one name to another.

    Attributes:
        values: measured values, frames by channels; "v" for files of columns and "magnitudes" for
            OpenEIT when omitted.
        touch_reference: values of the same sensor untouched, frames by channels; none when omitted.
        positions: touch positions, frames by (x, y, ...) [m]; further columns are ignored. The
            columns x and y when omitted.
        columns: place of a label that stands under another name, by label: NAME, NAME:COLUMN of a
            matrix counted from 0, NAME*FACTOR for another unit, or a number for all touches.
        patterns: drive and sense patterns, electrodes by patterns, instead of a protocol.
        sheet: of an Excel file; the first one when omitted.
    """

    values: str | None = None
    touch_reference: str | None = None
    positions: str | None = None
    columns: Mapping[str, str] = field(default_factory=dict)
    patterns: tuple[str, str] | None = None
    sheet: str | None = None


@dataclass(frozen=True, slots=True)
class RecordingForm:
    """Arrangement of a recording's rows and units of its numbers.

    Attributes:
        rows: whether each row of the values is a frame, or rows before and during a press
            alternate.
        keep_before: readings before a press are frames of the untouched sensor, too.
        transpose: the values have frames along their second axis.
        length_unit: of positions, depths and radii.
        origin: of the positions on the design: "corner", "centre" or "X,Y" [m].
        quantity: kind of the values; empty where unknown.
        scale: factor that makes ohm, or volt, of the values.
        bad_values: values that are empty or not finite are refused, marked in the frame's status,
            or their frames are dropped.
    """

    rows: Rows = "frames"
    keep_before: bool = False
    transpose: bool = False
    length_unit: LengthUnit = "m"
    origin: str = "corner"
    quantity: Quantity = ""
    scale: float = 1.0
    bad_values: BadValues = "refuse"

    def __post_init__(self) -> None:
        """Check the choices; raises ConfigurationError."""
        choices = (("rows", Rows), ("length_unit", LengthUnit))
        for name, kind in (*choices, ("quantity", Quantity), ("bad_values", BadValues)):
            if getattr(self, name) not in get_args(kind):
                raise ConfigurationError(
                    f"{name.replace('_', ' ')} must be one of "
                    f"{', '.join(filter(None, get_args(kind)))}, got '{getattr(self, name)}'"
                )
        if not abs(self.scale) > 0 or abs(self.scale) == float("inf"):
            raise ConfigurationError(f"the scale must be a finite factor, got {self.scale:g}")
        if self.rows != "frames" and self.transpose:
            raise ConfigurationError("rows that alternate cannot be transposed; give one of both")
