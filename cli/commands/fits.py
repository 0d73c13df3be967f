"""`eitskin fit`: physical numbers of a real board or sensor."""

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer
from rich.console import Group
from rich.table import Column

from eitskin import datasets, geometry, simulator, training
from eitskin.cli import options
from eitskin.cli.commands import recorded_frames
from eitskin.cli.help import Command
from eitskin.errors import ConfigurationError, DataError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray


app = typer.Typer(
    no_args_is_help=True, help="Fit the physical parameters of a real board or sensor."
)


@app.command("instrument", cls=Command)
@options.with_output
def fit_instrument(
    design: Annotated[Path, typer.Argument(help="Design file of the sensor.")],
    recording: recorded_frames.Recorded,
    *,
    out: Annotated[
        Path, typer.Option(help="Instrument file to write, for --instrument and recipes.")
    ],
    protocol: options.MeasuredPairs = None,
    values: recorded_frames.Values = None,
    terms: Annotated[
        str | None,
        typer.Option(
            help="Terms to fit besides the scale, separated by commas: source, sink, sense_plus, "
            "sense_minus, idle, common_mode, offset, leaks, leads; the first six if omitted."
        ),
    ] = None,
    keep_all: Annotated[
        bool,
        typer.Option("--keep-all", help="Keep terms that the frames do not need, too."),
    ] = False,
    first: Annotated[
        int | None,
        typer.Option(min=1, help="Fit to the first N flat frames and test on the others."),
    ] = None,
    reads: Annotated[
        Literal["complex", "signed", "magnitude"] | None,
        typer.Option(help="Kind of the readings; detected if omitted."),
    ] = None,
    resolution: options.Detail = "coarse",
    seed: int = 0,
    output: options.Output,
) -> None:
    """Fit a four-terminal meter with loads and leaks to frames of the flat, untouched sensor.

    Flat frames of a dataset are its references before touches, else its idle frames, else all
    frames. docs/how-to/train-and-adapt.md explains the result.
    """
    from eitskin.simulator.instrument.instrument import snr_db
    from eitskin.simulator.instrument.meter import USUAL, Quantity
    from eitskin.simulator.instrument.meter_fit import agreement

    quantity: Quantity | None = reads
    sensor = geometry.SensorDesign.from_toml(design)
    options.require_parent(out)
    data = recorded_frames.read_recorded(recording, values, protocol)
    table = recorded_frames.required_protocol(data)
    if table.n_electrodes != len(sensor.electrodes):
        raise ConfigurationError(
            f"the protocol is for {table.n_electrodes} electrodes, the design has "
            f"{len(sensor.electrodes)}; give the design of the sensor that was recorded"
        )
    flat, which = _flat_frames(data)
    _require_others(first, len(flat), "flat frames")
    output.note(f"{len(flat)} flat frames ({which}); solving the sensor at {resolution}")
    Z = simulator.ForwardModel(sensor, resolution=resolution).impedance()
    chosen = tuple(terms.split(",")) if terms is not None else USUAL
    quantity = quantity or ("magnitude" if data.quantity == "magnitude" else None)
    fit = simulator.fit_meter if keep_all else simulator.select_meter
    meter = fit(Z, table, flat[:first], chosen, quantity, seed)
    ideal = simulator.fit_meter(Z, table, flat[:first], (), quantity, seed)
    means = {"fitted": flat[:first].mean(axis=0)}
    if first is not None:
        means["others"] = flat[first:].mean(axis=0)
    agreements = {
        name: {"ideal": agreement(ideal.predicted, mean), "meter": agreement(meter.predicted, mean)}
        for name, mean in means.items()
    }
    simulator.Instrument(snr_db=snr_db(flat[:first]), meter=meter.meter).to_toml(out)
    rows = list(_meter_rows(meter))
    result = {
        "out": str(out),
        "frames": len(flat[:first]),
        "parameters": [
            dict(zip(("name", "value", "standard_error", "unit"), row, strict=True)) for row in rows
        ],
        "not_identifiable": [list(names) for names in meter.tied],
        "agreement": {
            name: {kind: asdict(each) for kind, each in pair.items()}
            for name, pair in agreements.items()
        },
    }
    lines = [
        f"{name} frames: ideal meter r = {pair['ideal'].r:.3f}, residual "
        f"{100.0 * pair['ideal'].residual:.1f} %; fitted r = {pair['meter'].r:.3f}, residual "
        f"{100.0 * pair['meter'].residual:.1f} %"
        for name, pair in agreements.items()
    ]
    cells = [
        (name, f"{value:.4g}", "not identifiable" if error is None else f"{error:.2g}", unit)
        for name, value, error, unit in rows
    ]
    shown = options.make_table(("parameter", "value", "standard error", "unit"), cells)
    output.result(result, Group(shown, *lines))
    for sentence in _meter_remarks(meter, chosen):
        output.note(sentence)
    output.note(f"instrument: {out}")


def _flat_frames(data: "datasets.Dataset") -> "tuple[NDArray[np.complex128], str]":
    """Frames of the flat, untouched sensor, (n, channels), and where they come from."""
    import numpy as np

    before = data.has_touch_reference & ~(np.abs(data.bend_angle_deg) > 0.0)  # NaN: unknown
    if before.any():
        return data.touch_reference[before].astype(complex), "before touches"
    if (idle := data.state == datasets.State.IDLE).any():
        return data.impedance[idle].astype(complex), "idle"
    if (data.state == datasets.UNKNOWN_STATE).all() and np.isnan(data.touch_x).all():
        return data.impedance.astype(complex), "all frames, of unknown state"
    raise DataError(
        "expected frames of the flat, untouched sensor, got only touches and bends; record the "
        "untouched sensor, or name the values before touches with --values"
    )


def _require_others(first: int | None, count: int, what: str) -> None:
    """Refuse a --first that leaves no frames to test on."""
    if first is not None and first >= count:
        raise ConfigurationError(
            f"--first {first} leaves none of {count} {what} to test on; give fewer"
        )


def _meter_rows(fit: "simulator.MeterFit") -> Iterator[tuple[str, float, float | None, str]]:
    """Name, value, standard error and unit of each parameter; None for an error without limit."""
    scale = abs(fit.meter.scale)
    names = [(str(parameter), parameter.unit) for parameter in fit.parameters]
    values = [*map(float, fit.values), scale]
    errors = [*map(float, fit.standard_errors), fit.scale_error * scale]
    for (name, unit), value, error in zip(
        [*names, ("scale", "per ohm")], values, errors, strict=True
    ):
        yield name, value, error if math.isfinite(error) else None, unit


def _describe_combinations(groups: Iterable[Sequence[str]], what: str) -> list[str]:
    """Sentences about numbers of which only a combination can be identified."""
    return [
        f"not identifiable: of {', '.join(names)} only {what} shows in these frames"
        for names in groups
        if len(names) > 1
    ]


def _meter_remarks(fit: "simulator.MeterFit", terms: tuple[str, ...]) -> Iterator[str]:
    """Sentences about what the frames do not call for, and what they do not determine."""
    fitted = {parameter.name for parameter in fit.parameters}
    if left_out := ", ".join(term for term in terms if term not in fitted):
        yield f"left out, because these frames do not need them: {left_out}"
    numbers = 1 + len(fit.parameters)
    if fit.distinct_readings <= numbers:
        yield (
            f"by the symmetry of the sensor only {fit.distinct_readings} readings differ, which "
            f"{numbers} numbers fit whatever the board: the agreement is no evidence for them"
        )
    yield from _describe_combinations(fit.tied, "a combination")
    if single := ", ".join(names[0] for names in fit.tied if len(names) == 1):
        yield f"not identifiable: {single} does not show in these frames"
    if fit.tied:
        yield (
            "parameters that are not identifiable do no harm to flat frames; fit fewer --terms to "
            "get numbers with errors"
        )


@app.command("twin", cls=Command)
@options.with_output
def fit_twin(
    design: Annotated[Path, typer.Argument(help="Design file of the sensor as designed.")],
    recording: recorded_frames.Recorded,
    *,
    out: Annotated[Path, typer.Option(help="Folder to write to; new or empty.")],
    protocol: options.MeasuredPairs = None,
    values: recorded_frames.Values = None,
    fixture: options.FixtureFile = None,
    mechanics: options.MechanicsFile = None,
    terms: Annotated[
        str | None,
        typer.Option(
            help="Terms of the board's meter to fit besides its gain, with commas: source, sink, "
            "sense_plus, sense_minus, idle, common_mode, offset, leaks, leads."
        ),
    ] = None,
    prior: Annotated[
        Path | None, typer.Option(help="File of prior standard deviations; wide when omitted.")
    ] = None,
    specimen: recorded_frames.OneSpecimen = None,
    first: Annotated[
        int | None, typer.Option(min=1, help="Fit to the first N frames and test on the others.")
    ] = None,
    resolution: options.Detail = "coarse",
    seed: int = 0,
    output: options.Output,
) -> None:
    """Fit a twin to flat frames, known angles and known touches of one sensor.

    Parameters that the frames do not constrain keep their prior value.
    docs/how-to/train-and-adapt.md explains the result.
    """
    from eitskin.config import read_toml
    from eitskin.datasets.store.folder import new_folder
    from eitskin.simulator.deformation.sensor_grid import read_fixed
    from eitskin.training.twin.twin import as_plain, write_twin

    new_folder(out)
    sensor = geometry.SensorDesign.from_toml(design)
    widths = read_toml(training.TwinPrior, prior) if prior else training.TwinPrior()
    clamp, materials, _ = read_fixed(fixture, mechanics)
    data = recorded_frames.read_recorded(recording, values, protocol)
    data = recorded_frames.select_one_sensor(data, specimen)
    _require_others(first, len(data), "frames")
    twin = training.Twin.fit(
        sensor,
        data.select(slice(first)),
        fixture=clamp,
        mechanics=materials,
        terms=tuple(terms.split(",")) if terms else (),
        prior=widths,
        resolution=resolution,
        seed=seed,
        progress=lambda step: output.detail(f"Gauss-Newton step {step}"),
    )
    judged = twin.evaluate(data.select(slice(first, None))) if first is not None else {}
    write_twin(twin, out)
    plain: dict[str, Any] = as_plain(twin) | {
        "out": str(out),
        "judged": {kind: {"r": a.r, "residual": a.residual} for kind, a in judged.items()},
    }
    agreements = [*twin.agreements.items()]
    agreements += [(f"{kind}, later frames", each) for kind, each in judged.items()]
    lines = [
        f"{name}: r = {each.r:.4f}, residual {100.0 * each.residual:.2f} %"
        for name, each in agreements
    ]
    headings = (Column("number", no_wrap=True), "value", "error", "prior", "unit")
    output.result(plain, Group(options.make_table(headings, _twin_rows(twin)), *lines))
    for sentence in _twin_remarks(twin):
        output.note(sentence)
    output.note(f"twin: {out}")


def _twin_rows(twin: "training.Twin") -> Iterator[tuple[str, ...]]:
    """Cells of the fitted numbers: value, error, prior."""
    lost = {names[0] for names in twin.undetermined_combinations if len(names) == 1}
    for each, value, error in zip(twin.parameters, twin.values, twin.standard_errors, strict=True):
        shown = "as the prior" if str(each) in lost else f"{error:.2g}"
        prior = f"{each.number(0.0):.4g} +- {abs(each.slope(0.0)):.2g}"
        yield str(each), f"{value:.4g}", shown, prior, each.unit


def _twin_remarks(twin: "training.Twin") -> Iterator[str]:
    """Sentences about what was left out, what is not identifiable, and the worst channel."""
    from eitskin.training.twin.twin import channel_residuals

    if count := twin.frames.left_out:
        yield f"{count} frames have no label that a twin can use, and were left out"
    yield from _describe_combinations(twin.undetermined_combinations, "another combination")
    name, _, _, residual = max(channel_residuals(twin), key=lambda row: row[3]["flat"])
    yield f"largest flat residual: {residual['flat']:.2f} % of channel {name}; see residuals.csv"
