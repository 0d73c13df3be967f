"""`eitskin instrument`: instruments of real boards, fitted to frames of the untouched sensor."""

import dataclasses
import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Group
from rich.table import Table

from eitskin.cli.commands.recorded_frames import Recorded, Values, read_recorded, required_protocol
from eitskin.cli.options import (
    MeasuredPairs,
    Output,
    one_of,
    require_parent,
    with_output,
)
from eitskin.errors import ConfigurationError, DataError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from eitskin.datasets.store.dataset import Dataset
    from eitskin.simulator.instrument.meter_fit import Agreement, MeterFit

    Frames = NDArray[np.complex128]

app = typer.Typer(no_args_is_help=True, help="Fit instruments to frames of real boards.")

Design = Annotated[Path, typer.Argument(help="Design file of the sensor.")]
Terms = Annotated[
    str | None,
    typer.Option(
        help="Terms to fit beside the scale, with commas: source, sink, sense_plus, sense_minus, "
        "idle, common_mode, offset, leaks, leads; the first six when omitted."
    ),
]


@app.command("fit")
@with_output
def fit(
    design: Design,
    recording: Recorded,
    *,
    out: Annotated[
        Path, typer.Option(help="Instrument file to write, for --instrument and recipes.")
    ],
    protocol: MeasuredPairs = None,
    values: Values = None,
    terms: Terms = None,
    keep_all: Annotated[
        bool,
        typer.Option("--keep-all", help="Keep also the terms that the frames do not call for."),
    ] = False,
    first: Annotated[
        int | None,
        typer.Option(min=1, help="Fit to the first so many flat frames, and judge on the others."),
    ] = None,
    reads: Annotated[
        str | None,
        typer.Option(help="complex, signed or magnitude; as the values look when omitted."),
    ] = None,
    resolution: Annotated[
        str, typer.Option(help="Resolution of the sensor: coarse, fast, standard ...")
    ] = "coarse",
    seed: int = 0,
    output: Output,
) -> None:
    """Fit a four-terminal meter with loads and leaks to frames of the flat, untouched sensor.

    Flat frames of a dataset are its references before touches, or else its idle frames, or else,
    where nothing says what the frames show, all of them. See docs/instrument.md.
    """
    from eitskin.geometry.design.sensor import SensorDesign
    from eitskin.simulator.electrical.forward_model import ForwardModel
    from eitskin.simulator.electrical.resolution import Resolution
    from eitskin.simulator.instrument.fit_parameters import USUAL
    from eitskin.simulator.instrument.instrument import Instrument, snr_db
    from eitskin.simulator.instrument.meter import Quantity
    from eitskin.simulator.instrument.meter_fit import agreement, fit_meter, select_meter

    detail = one_of("--resolution", resolution, Resolution)
    quantity: Quantity | None = one_of("--reads", reads, Quantity) if reads else None
    sensor = SensorDesign.from_toml(design)
    require_parent(out)
    data = read_recorded(recording, values, protocol)
    table = required_protocol(data)
    if table.n_electrodes != len(sensor.electrodes):
        raise ConfigurationError(
            f"the protocol is for {table.n_electrodes} electrodes, the design has "
            f"{len(sensor.electrodes)}; give the design of the sensor that was recorded"
        )
    flat, which = _flat_frames(data)
    fitted, others = flat[:first], flat[first:] if first else flat[:0]
    if first and not len(others):
        raise ConfigurationError(
            f"--first {first} leaves none of {len(flat)} flat frames to judge on; give fewer"
        )
    output.note(f"{len(flat)} flat frames ({which}); solving the sensor at {resolution}")
    Z = ForwardModel(sensor, resolution=detail).impedance()
    chosen = tuple(terms.split(",")) if terms is not None else USUAL
    quantity = quantity or ("magnitude" if data.quantity == "magnitude" else None)
    fit_terms = fit_meter if keep_all else select_meter
    found = fit_terms(Z, table, fitted, chosen, quantity, seed)
    ideal = fit_meter(Z, table, fitted, (), quantity, seed)
    judged = {"fitted": fitted.mean(axis=0)}
    if len(others):
        judged["others"] = others.mean(axis=0)
    agreements = {
        name: {"ideal": agreement(ideal.predicted, mean), "meter": agreement(found.predicted, mean)}
        for name, mean in judged.items()
    }
    Instrument(snr_db=snr_db(fitted), meter=found.meter).to_toml(out)
    output.result(_plain(found, agreements, len(fitted), out), _table(found, agreements))
    for sentence in _remarks(found, chosen):
        output.note(sentence)
    output.note(f"instrument: {out}")


def _flat_frames(data: "Dataset") -> "tuple[Frames, str]":
    """Frames of the flat, untouched sensor, (n, channels), and where they come from."""
    import numpy as np

    from eitskin.datasets.store.schema import UNKNOWN_STATE, State

    untouched = data.has_touch_reference
    flat = ~(np.abs(data.bend_angle_deg) > 0.0)  # also where the angle is unknown
    if (untouched & flat).any():
        return data.touch_reference[untouched & flat].astype(complex), "before touches"
    if (idle := data.state == State.IDLE).any():
        return data.impedance[idle].astype(complex), "idle"
    if (data.state == UNKNOWN_STATE).all() and np.isnan(data.touch_x).all():
        return data.impedance.astype(complex), "all frames, of unknown state"
    raise DataError(
        "expected frames of the flat, untouched sensor, got only touches and bends; record the "
        "untouched sensor, or name the values before touches with --values"
    )


def _plain(
    found: "MeterFit",
    agreements: "dict[str, dict[str, Agreement]]",
    frames: int,
    out: Path,
) -> dict[str, object]:
    return {
        "out": str(out),
        "frames": frames,
        "parameters": [
            {"name": name, "value": value, "standard_error": error, "unit": unit}
            for name, value, error, unit in _rows(found)
        ],
        "not_identifiable": [list(names) for names in found.tied],
        "agreement": {
            name: {kind: dataclasses.asdict(each) for kind, each in both.items()}
            for name, both in agreements.items()
        },
    }


def _rows(found: "MeterFit") -> list[tuple[str, float, float | None, str]]:
    """Name, value, standard error and unit of each parameter; None for an error without limit."""
    errors = [float(e) if math.isfinite(e) else None for e in found.standard_errors]
    rows = [
        (str(parameter), float(value), error, parameter.unit)
        for parameter, value, error in zip(found.parameters, found.values, errors, strict=True)
    ]
    scale = abs(found.meter.scale)
    error = found.scale_error * scale
    return [*rows, ("scale", scale, error if math.isfinite(error) else None, "per ohm")]


def _table(found: "MeterFit", agreements: "dict[str, dict[str, Agreement]]") -> Group:
    lines = [
        f"{name} frames: ideal meter r = {both['ideal'].r:.3f}, residual "
        f"{100.0 * both['ideal'].residual:.1f} %; fitted r = {both['meter'].r:.3f}, residual "
        f"{100.0 * both['meter'].residual:.1f} %"
        for name, both in agreements.items()
    ]
    table = Table("parameter", "value", "standard error", "unit")
    for name, value, error, unit in _rows(found):
        shown = "not identifiable" if error is None else f"{error:.2g}"
        table.add_row(name, f"{value:.4g}", shown, unit)
    return Group(table, *lines)


def _remarks(found: "MeterFit", terms: tuple[str, ...]) -> list[str]:
    """Sentences about what the frames do not call for, and what they do not determine."""
    fitted = {each.name for each in found.parameters}
    left_out = ", ".join(term for term in terms if term not in fitted)
    said = [f"not called for by these frames, and left out: {left_out}"] if left_out else []
    numbers = 1 + len(found.parameters)
    if found.distinct_readings <= numbers:
        said.append(
            f"by the symmetry of the sensor only {found.distinct_readings} readings differ, which "
            f"{numbers} numbers fit whatever the board: the agreement is no evidence for them"
        )
    single = [names[0] for names in found.tied if len(names) == 1]
    said += [
        f"not identifiable: of {', '.join(names)} only a combination shows in these frames"
        for names in found.tied
        if len(names) > 1
    ]
    if single:
        said.append(f"not identifiable: {', '.join(single)} does not show in these frames")
    if found.tied:
        said.append(
            "parameters that are not identifiable do no harm to flat frames; fit fewer --terms to "
            "get numbers with errors"
        )
    return said
