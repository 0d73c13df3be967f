"""`eitskin twin`: the physical numbers behind one real sensor, fitted to labelled frames."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Group
from rich.table import Column, Table

from eitskin.cli.commands.recorded_frames import Recorded, Values, of_specimen, read_recorded
from eitskin.cli.options import (
    FixtureFile,
    MeasuredPairs,
    MechanicsFile,
    Output,
    one_of,
    with_output,
)
from eitskin.errors import ConfigurationError

if TYPE_CHECKING:
    from eitskin.simulator.instrument.meter_fit import Agreement
    from eitskin.training.twin.twin import Twin

app = typer.Typer(no_args_is_help=True, help="Fit the physical numbers behind one sensor.")


@app.callback()
def _group() -> None:
    """Keep `fit` a command of its own."""


@app.command("fit")
@with_output
def fit(
    design: Annotated[Path, typer.Argument(help="Design file of the sensor as it was meant.")],
    recording: Recorded,
    *,
    out: Annotated[Path, typer.Option(help="Folder for the twin's files; new or empty.")],
    protocol: MeasuredPairs = None,
    values: Values = None,
    fixture: FixtureFile = None,
    mechanics: MechanicsFile = None,
    terms: Annotated[
        str | None,
        typer.Option(
            help="Terms of the board's meter to fit beside its gain, with commas: source, sink, "
            "sense_plus, sense_minus, idle, common_mode, offset, leaks, leads."
        ),
    ] = None,
    prior: Annotated[
        Path | None, typer.Option(help="File of prior standard deviations; wide when omitted.")
    ] = None,
    specimen: Annotated[
        int | None, typer.Option(min=0, help="Number of the specimen in the dataset.")
    ] = None,
    first: Annotated[
        int | None, typer.Option(min=1, help="Fit to the first so many frames, judge on the rest.")
    ] = None,
    resolution: Annotated[
        str, typer.Option(help="Resolution of the sensor: coarse, fast, standard ...")
    ] = "coarse",
    seed: int = 0,
    output: Output,
) -> None:
    """Fit a twin to flat frames, known angles and known touches of one sensor.

    Numbers that no frame shows stay at their prior. See docs/twin.md.
    """
    from eitskin.config import read_toml
    from eitskin.datasets.store.folder import new_folder
    from eitskin.geometry.design.sensor import SensorDesign
    from eitskin.simulator.deformation.sensor_grid import read_fixed
    from eitskin.simulator.electrical.resolution import Resolution
    from eitskin.training.twin.files import as_plain, write_twin
    from eitskin.training.twin.parameters import TwinPrior
    from eitskin.training.twin.twin import Twin

    detail = one_of("--resolution", resolution, Resolution)
    new_folder(out)
    sensor = SensorDesign.from_toml(design)
    wide = read_toml(TwinPrior, prior) if prior else TwinPrior()
    held, materials, _ = read_fixed(fixture, mechanics)
    data = read_recorded(recording, values, protocol)
    data = data if specimen is None else of_specimen(data, specimen)
    fitted, rest = data, None
    if first is not None:
        if first >= len(data):
            raise ConfigurationError(
                f"--first {first} leaves no frame of {len(data)} to judge on; give fewer"
            )
        fitted, rest = data.select(slice(first)), data.select(slice(first, None))
    twin = Twin.fit(
        sensor,
        fitted,
        fixture=held,
        mechanics=materials,
        terms=tuple(terms.split(",")) if terms else (),
        prior=wide,
        resolution=detail,
        seed=seed,
        progress=lambda step: output.detail(f"Gauss-Newton step {step}"),
    )
    judged = {} if rest is None else twin.judged(rest)
    write_twin(twin, out)
    plain = as_plain(twin) | {
        "out": str(out),
        "judged": {kind: {"r": a.r, "residual": a.residual} for kind, a in judged.items()},
    }
    output.result(plain, _shown(twin, judged))
    for sentence in _remarks(twin):
        output.note(sentence)
    output.note(f"twin: {out}")


def _shown(twin: "Twin", judged: "dict[str, Agreement]") -> Group:
    """Table of the numbers, and how well they explain the frames."""
    table = Table(Column("number", no_wrap=True), "value", "error", "prior", "unit")
    lost = {names[0] for names in twin.undetermined if len(names) == 1}
    for each, value, error in zip(twin.parameters, twin.values, twin.standard_errors, strict=True):
        shown = "as the prior" if str(each) in lost else f"{error:.2g}"
        prior = f"{each.number(0.0):.4g} +- {abs(each.slope(0.0)):.2g}"
        table.add_row(str(each), f"{value:.4g}", shown, prior, each.unit)
    lines = [
        f"{kind}: r = {found.r:.4f}, residual {100.0 * found.residual:.2f} %"
        for kind, found in twin.agreements.items()
    ]
    lines += [
        f"{kind}, later frames: r = {found.r:.4f}, residual {100.0 * found.residual:.2f} %"
        for kind, found in judged.items()
    ]
    return Group(table, *lines)


def _remarks(twin: "Twin") -> list[str]:
    """Sentences about what was left out, what is not identifiable, and the worst channel."""
    from eitskin.training.twin.files import channel_residuals

    said = []
    if twin.frames.left_out:
        said.append(
            f"{twin.frames.left_out} frames have no label that a twin can use, and were left out"
        )
    said += [
        f"not identifiable: of {', '.join(names)} only another combination shows in these frames"
        for names in twin.undetermined
        if len(names) > 1
    ]
    name, _, _, left = max(channel_residuals(twin), key=lambda row: row[3]["flat"])
    said.append(f"largest flat residual: {left['flat']:.2f} % of channel {name}; see residuals.csv")
    return said
