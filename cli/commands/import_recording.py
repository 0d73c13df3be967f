"""`eitskin import`: measured voltages with labels, as a dataset."""

import re
import shlex
from collections.abc import Collection, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final, Literal

import typer

from eitskin import datasets, geometry, simulator
from eitskin.cli.options import MeasuredPairs, Output, given_words, with_output
from eitskin.errors import ConfigurationError

if TYPE_CHECKING:
    from eitskin.datasets.store.summary import DatasetSummary

_AXIS: Final = "(pos|position|touch|press|contact|loc|location|target)?{0}(pos|position|coord)?"
_USUAL_NAMES: Final = {
    "state": "state|label|class|condition",
    "t": "t|times?|timestamp|elapsed(time)?",
    "x": _AXIS.format("x"),
    "y": _AXIS.format("y"),
    "force": "force|load|fz",
    "depth": "depth|indentation",
    "angle_deg": "(bend|bending)?angle",
}
"""Usual names of a label's column, in small letters and without its unit."""
_WITH_UNIT: Final = re.compile(
    r"(?P<name>.+?)(?:[\s_]*[\[(]|[\s_]+)(?P<unit>m|cm|mm|um|s|ms|us|ns|N|deg)[\])]?"
)


@with_output
def command(
    files: Annotated[
        list[Path],
        typer.Argument(
            help="Recording, or several of one form, each a session: .csv, .tsv, .xlsx, .parquet, "
            ".mat (EIDORS, too), .npz, .h5, .dat (pyGIMLi), .get, .eit (Draeger, Sciospec, or a "
            "folder of them) or OpenEIT .txt."
        ),
    ],
    *,
    context: typer.Context,
    out: Annotated[Path | None, typer.Option(help="Folder to write to; new or empty.")] = None,
    preview: Annotated[
        bool,
        typer.Option("--preview", help="Show what is understood of the files, and write nothing."),
    ] = False,
    sensor: Annotated[
        Path | None,
        typer.Option(help="Sensor design file, stored and used to check positions and units."),
    ] = None,
    protocol: MeasuredPairs = None,
    values: Annotated[
        str | None,
        typer.Option(
            help="Variable, beginning of columns, or FIRST..LAST column of the values; two with a "
            "comma for magnitude,phase or real,imag."
        ),
    ] = None,
    touch_reference: Annotated[
        str | None, typer.Option(help="Values just before each touch, named as those of --values.")
    ] = None,
    rows: Annotated[
        Literal["frames", "before-during", "during-before"],
        typer.Option(help="Order of rows: frames, or readings before and during each touch."),
    ] = "frames",
    keep_before: Annotated[
        bool, typer.Option("--keep-before", help="Keep readings before a touch as idle frames.")
    ] = False,
    positions: Annotated[str | None, typer.Option(help="Variable with x, y of each touch.")] = None,
    column: Annotated[
        list[str] | None,
        typer.Option(
            metavar="LABEL=PLACE",
            help="Place of state, angle_deg, t, x, y, force, depth, radius, specimen, sensor or "
            "session: NAME, NAME:COLUMN, NAME*FACTOR, or a number for all touches. Repeatable.",
        ),
    ] = None,
    length_unit: Annotated[
        Literal["m", "cm", "mm", "um"],
        typer.Option(help="Unit of x, y, depth and radius in the file."),
    ] = "m",
    origin: Annotated[
        str, typer.Option(help="Origin of x and y: corner, centre, or X,Y in metres.")
    ] = "corner",
    quantity: Annotated[
        Literal["impedance", "magnitude", "voltage"] | None,
        typer.Option(help="Kind of the values."),
    ] = None,
    scale: Annotated[
        float, typer.Option(help="Multiply values by this to get ohms (for voltages: 1/current).")
    ] = 1.0,
    frequency: Annotated[float, typer.Option(help="Frequency of the excitation, in hertz.")] = 40e3,
    bad_values: Annotated[
        Literal["refuse", "mark", "drop"],
        typer.Option(help="Treatment of empty or non-finite values; drop leaves out frames."),
    ] = "refuse",
    phase_unit: Annotated[
        Literal["deg", "rad"] | None,
        typer.Option(help="Unit of phases next to magnitudes; detected if omitted."),
    ] = None,
    time_unit: Annotated[
        Literal["s", "ms", "us", "ns"] | None,
        typer.Option(help="Unit of t; asked for if seconds are unlikely."),
    ] = None,
    differences: Annotated[
        bool,
        typer.Option(
            "--differences",
            help="Take values as differences from --touch-reference, or from rows like the first.",
        ),
    ] = False,
    order: Annotated[
        Literal["given", "rotated", "reversed", "sense-first"] | None,
        typer.Option(help="Order of readings; rotated: senses start behind each drive pair."),
    ] = None,
    transpose: Annotated[
        bool, typer.Option("--transpose", help="Take columns of the values as frames, not rows.")
    ] = False,
    patterns: Annotated[
        str | None,
        typer.Option(help="DRIVE,SENSE: matrices of patterns in the file, instead of a protocol."),
    ] = None,
    sheet: Annotated[str | None, typer.Option(help="Sheet of an Excel file, or the first.")] = None,
    header_row: Annotated[
        int | None, typer.Option(help="Row of the columns' names, from 1; detected if omitted.")
    ] = None,
    output: Output,
) -> None:
    """Import a recording (CSV, Excel, MATLAB, HDF5, Parquet) as a dataset."""
    from eitskin.datasets.store.folder import save_parts
    from eitskin.datasets.store.summary import DatasetSummary

    if out is None and not preview:
        raise ConfigurationError("name the folder with --out, or see what is read with --preview")
    design = geometry.SensorDesign.from_toml(sensor) if sensor else None
    recording = datasets.Recording(
        files,
        datasets.RecordingNames(
            values,
            touch_reference,
            positions,
            _columns(column or ()),
            _pair(patterns),
            sheet,
            header_row,
        ),
        simulator.Protocol.from_name(protocol, len(design.electrodes) if design else None)
        if protocol
        else None,
        frequency,
        design,
        datasets.RecordingForm(
            rows,
            keep_before,
            transpose,
            length_unit,
            origin,
            quantity or "",
            scale,
            bad_values,
            phase_unit or "",
            time_unit or "",
            order or "",
            bool(protocol and protocol.endswith("+driven")),
            differences,
        ),
    )
    if out is None or preview:
        _preview(output, recording, context)
        return
    if recording.unused:
        output.note(
            f"not read: {', '.join(recording.unused)}; a label among them is named with "
            "--column LABEL=NAME"
        )
    summary = DatasetSummary()
    save_parts(summary.add_parts(recording.parts()), out)
    _tell(output, out, recording, summary)


def _preview(output: Output, recording: "datasets.Recording", context: typer.Context) -> None:
    """Print what is understood of a recording, and the command that says all of it."""
    description, options = recording.describe_format()
    words = given_words(context, {"preview", "out", "as_json", "quiet"})
    for option, value in options.items():
        words += [] if option in words else [option, value]
    read = {label.partition(" = ")[0] for label in description["labels"].split(", ")}
    words += [word for pair in _suggest_options(recording.unused, read) for word in pair]
    if recording.unused:
        description["not read"] += "; a label among them: --column LABEL=NAME"
    description["command"] = shlex.join(["eitskin", *words, "--out", "FOLDER"])
    output.result(description, "\n".join(f"{name}: {text}" for name, text in description.items()))


def _suggest_options(names: Iterable[str], labels: Collection[str]) -> list[tuple[str, str]]:
    """Options for columns with usual names of labels, other than those in `labels`, and units."""
    columns: dict[str, str] = {}
    units: dict[str, str] = {}
    for name in names:
        match = _WITH_UNIT.fullmatch(name)
        word = re.sub(r"[\W_]", "", match["name"] if match else name).casefold()
        for label, usual in _USUAL_NAMES.items():
            if label not in {*labels, *columns} and re.fullmatch(usual, word):
                columns[label] = name
                if match and label in ("t", "x", "y", "depth") and match["unit"] not in ("m", "N"):
                    units["--time-unit" if label == "t" else "--length-unit"] = match["unit"]
    if ("x" in columns) != ("y" in columns):
        columns = {label: name for label, name in columns.items() if label not in "xy"}
    return [("--column", f"{label}={name}") for label, name in columns.items()] + [*units.items()]


def _tell(
    output: Output, out: Path, recording: "datasets.Recording", summary: "DatasetSummary"
) -> None:
    """Print what has been imported."""
    contents, counts = summary.contents(), summary.states
    shown = ", ".join(f"{count} {name}" for name, count in counts.items() if count)
    for kind, names in (("specimen", recording.specimens), ("session", recording.sessions)):
        if any(name != str(number) for name, number in names.items()):
            name_list = ", ".join(f"{number} is {name}" for name, number in names.items())
            output.note(f"numbers of {kind}s: {name_list}")
    output.result(
        {
            "out": str(out),
            "frames": contents["frames"],
            "channels": contents["channels"],
            "states": counts,
            "protocol": contents["protocol"],
            "quantity": contents["quantity"],
            "specimens": dict(recording.specimens),
            "sessions": dict(recording.sessions),
            "unused": list(recording.unused),
        },
        f"{contents['frames']} frames of {contents['channels']} channels ({shown}) in {out}",
    )
    output.note(
        f"ranges: {summary.ranges or 'all values are equal'}; wrong by a unit? see --scale, "
        "--length-unit, --time-unit"
    )


def _columns(texts: Iterable[str]) -> dict[str, str]:
    """Places of labels by label; raises ConfigurationError."""
    places: dict[str, str] = {}
    for text in texts:
        label, equals, place = (part.strip() for part in text.partition("="))
        if not (label and equals and place) or label in places:
            raise ConfigurationError(
                f"expected --column LABEL=PLACE, each label once, as in force=F_N, got '{text}'"
            )
        places[label] = place
    return places


def _pair(text: str | None) -> tuple[str, str] | None:
    """Names of drive and sense patterns; raises ConfigurationError."""
    if text is None:
        return None
    drive, comma, sense = (part.strip() for part in text.partition(","))
    if not (drive and comma and sense):
        raise ConfigurationError(f"expected --patterns DRIVE,SENSE, got '{text}'")
    return drive, sense
