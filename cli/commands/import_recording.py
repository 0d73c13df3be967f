"""`eitskin import`: measured voltages with labels, as a dataset."""

import shlex
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from eitskin import datasets, geometry, simulator
from eitskin.cli.options import MeasuredPairs, Output, given_words, with_output
from eitskin.errors import ConfigurationError

if TYPE_CHECKING:
    from eitskin.datasets.store.summary import DatasetSummary


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
    out: Annotated[Path | None, typer.Option(help="Folder for the dataset; new or empty.")] = None,
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
        str | None, typer.Option(help="The same for frames just before a touch.")
    ] = None,
    rows: Annotated[
        str,
        typer.Option(help="frames; or before-during, during-before: rows of a press alternate."),
    ] = "frames",
    keep_before: Annotated[
        bool, typer.Option("--keep-before", help="Keep readings before a press as frames, too.")
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
        str, typer.Option(help="Of x, y, depth and radius in the file: m, cm, mm or um.")
    ] = "m",
    origin: Annotated[
        str, typer.Option(help="Of x and y on the sensor: corner, centre, or X,Y in metres.")
    ] = "corner",
    quantity: Annotated[
        str, typer.Option(help="Kind of the values: impedance, magnitude or voltage.")
    ] = "",
    scale: Annotated[
        float, typer.Option(help="Factor that makes ohm of the values; 1/current for voltages.")
    ] = 1.0,
    frequency: Annotated[float, typer.Option(help="Frequency of the excitation, in hertz.")] = 40e3,
    bad_values: Annotated[
        str, typer.Option(help="Empty or not finite values: refuse, mark, or drop the frame.")
    ] = "refuse",
    phase_unit: Annotated[
        str, typer.Option(help="Of phases beside magnitudes: deg or rad; found where it can be.")
    ] = "",
    time_unit: Annotated[
        str, typer.Option(help="Of t as numbers: s, ms, us or ns; asked where it is hardly s.")
    ] = "",
    differences: Annotated[
        bool,
        typer.Option("--differences", help="Values are differences from --touch-reference."),
    ] = False,
    order: Annotated[
        str, typer.Option(help="Of readings: given, rotated (from the drive pair on) or reversed.")
    ] = "",
    transpose: Annotated[
        bool, typer.Option("--transpose", help="Frames are columns of the values, not rows.")
    ] = False,
    patterns: Annotated[
        str | None,
        typer.Option(help="DRIVE,SENSE: matrices of patterns in the file, instead of a protocol."),
    ] = None,
    sheet: Annotated[str | None, typer.Option(help="Sheet of an Excel file; the first.")] = None,
    header_row: Annotated[
        int | None, typer.Option(help="Row of the columns' names, from 1; found where omitted.")
    ] = None,
    output: Output,
) -> None:
    """Import measured voltages and labels, as a dataset for training and evaluation."""
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
        simulator.Protocol.named(protocol, len(design.electrodes) if design else None)
        if protocol
        else None,
        frequency,
        design,
        datasets.RecordingForm(
            rows,  # type: ignore[arg-type]
            keep_before,
            transpose,
            length_unit,  # type: ignore[arg-type]
            origin,
            quantity,  # type: ignore[arg-type]
            scale,
            bad_values,  # type: ignore[arg-type]
            phase_unit,  # type: ignore[arg-type]
            time_unit,  # type: ignore[arg-type]
            order,  # type: ignore[arg-type]
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
    save_parts(summary.watched(recording.parts()), out)
    _tell(output, out, recording, summary)


def _preview(output: Output, recording: "datasets.Recording", context: typer.Context) -> None:
    """Print what is understood of a recording, and the command that says all of it."""
    said, options = recording.understood()
    words = given_words(context, {"preview", "out", "as_json", "quiet"})
    for option, value in options.items():
        words += [] if option in words else [option, value]
    said["command"] = shlex.join(["eitskin", *words, "--out", "FOLDER"])
    output.result(said, "\n".join(f"{name}: {text}" for name, text in said.items()))


def _tell(
    output: Output, out: Path, recording: "datasets.Recording", summary: "DatasetSummary"
) -> None:
    """Print what has been imported."""
    contents, counts = summary.contents(), summary.states
    shown = ", ".join(f"{count} {name}" for name, count in counts.items() if count)
    for kind, names in (("specimen", recording.specimens), ("session", recording.sessions)):
        if any(name != str(number) for name, number in names.items()):
            told = ", ".join(f"{number} is {name}" for name, number in names.items())
            output.note(f"numbers of {kind}s: {told}")
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
