"""Flat channels of a real round skin, explained by ideal and by fitted instruments.

Run by `python -m eitskin.benchmarks.studies.boards.round_skin FOLDER`.

FOLDER holds `ohmc8.mat` (DSHardman/HydrogelEIT): 500 frames of the untouched skin, each before a
press, of a board that reads magnitudes with facing electrodes as drive, in both directions. Meters
are fitted to the mean of the first 400 frames and judged on the mean of the last 100, and on each
channel when it is left out of the fit. Beside them stand the means of the channels that are alike
by the symmetry of skin and electrodes: no instrument that is the same for all electrodes can
explain more. Prints, as Markdown, how well each explains the channels, parameters with standard
errors, and what the laws of an ideal meter say of the board.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eitskin.datasets.recordings.form import RecordingNames
from eitskin.datasets.recordings.recording import read_recording
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.hardware.diagnosis.reading_check import check_readings
from eitskin.protocol import Protocol
from eitskin.provenance import Provenance
from eitskin.simulator.electrical.forward_model import ForwardModel
from eitskin.simulator.instrument.fit_parameters import USUAL
from eitskin.simulator.instrument.meter_fit import agreement, fit_meter, select_meter

RECORDING, FLAT = "ohmc8.mat", "responseups"
FIRST = 400
DESCRIPTIONS = Path(__file__).parents[3] / "docs" / "guides" / "recordings"
METERS: dict[str, tuple[str, ...]] = {
    "ideal": (),
    "loads and common mode": USUAL,
    "and a leak per electrode": (*USUAL, "leaks"),
    "and a lead per electrode": (*USUAL, "leads"),
}
CHOSEN = "loads and common mode, chosen"
BY_SYMMETRY = "means of channels alike by symmetry"
LEFT_OUT_STARTS = 3

Array = NDArray[np.float64]


def left_out(Z: Array, protocol: Protocol, frame: Array, terms: Sequence[str]) -> float:
    """Residual of the channels, each against a fit to all others, relative to the frame."""
    said = []
    for channel in range(len(protocol)):
        others = np.arange(len(protocol)) != channel
        rows = [row for row, kept in zip(protocol.table, others, strict=True) if kept]
        less = Protocol.from_rows(rows, protocol.n_electrodes)
        fit = fit_meter(Z, less, frame[others], terms, "magnitude", starts=LEFT_OUT_STARTS)
        whole, _ = fit.meter.reading(fit.meter.transfer_impedance(Z, protocol))
        said.append(whole[channel])
    return agreement(said, frame).residual


def means_by_symmetry(protocol: Protocol, frame: Array) -> tuple[Array, Array, int]:
    """Mean of the channels alike by rotation: with each channel, without it, and their number."""
    table, n = np.array(protocol.table), protocol.n_electrodes
    turned = (table - table[:, :1]) % n
    kinds, kind = np.unique(turned, axis=0, return_inverse=True)
    alike = np.equal.outer(kind.ravel(), kind.ravel()).astype(float)
    count, total = alike.sum(axis=1), alike @ frame
    return total / count, (total - frame) / (count - 1.0), len(kinds)


def row(
    name: str, numbers: int, predicted: ArrayLike, frames: Array, left_out_residual: float
) -> str:
    """Markdown row of one explanation of the flat frame."""
    cells = []
    for part in (frames[:FIRST], frames[FIRST:]):
        found = agreement(predicted, part.mean(axis=0))
        cells += [f"{found.r:.3f}", f"{100.0 * found.residual:.1f}"]
    cells.append(f"{100.0 * left_out_residual:.1f}")
    return f"| {name} | {numbers} | {' | '.join(cells)} |"


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, help=f"where {RECORDING} is")
    path = parser.parse_args().folder / RECORDING
    if not path.is_file():
        parser.error(f"there is no {path}; it is of the repository DSHardman/HydrogelEIT")
    protocol = Protocol.from_file(DESCRIPTIONS / "round-skin.csv", 8)
    frames = read_recording(path, RecordingNames(FLAT), protocol).impedance.real.astype(float)
    design = SensorDesign.from_toml(DESCRIPTIONS / "round-skin.toml")
    Z = ForwardModel(design, resolution="coarse").impedance().real
    print(f"{Provenance.now(0)}\n")
    for law in check_readings(frames, protocol).laws:
        print(f"- {law.kind}, compared and violated: {law.relations}, {law.violated}")
    print("\n| meter | numbers | r | residual, % | r, later | later, % | left out, % |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    frame = frames[:FIRST].mean(axis=0)
    chosen = select_meter(Z, protocol, frame, USUAL, "magnitude")
    fits = {name: fit_meter(Z, protocol, frame, terms) for name, terms in METERS.items()}
    terms = METERS | {CHOSEN: tuple(dict.fromkeys(each.name for each in chosen.parameters))}
    for name, fit in (fits | {CHOSEN: chosen}).items():
        unseen = left_out(Z, protocol, frame, terms[name])
        print(row(name, 1 + len(fit.parameters), fit.predicted, frames, unseen), flush=True)
    means, others, kinds = means_by_symmetry(protocol, frame)
    print(row(BY_SYMMETRY, kinds, means, frames, agreement(others, frame).residual))
    print("\n| parameter, chosen | value | standard error |\n| --- | --- | --- |")
    for parameter, value, error in zip(
        chosen.parameters, chosen.values, chosen.standard_errors, strict=True
    ):
        unit = f" [{parameter.unit}]" * bool(parameter.unit)
        print(f"| {parameter}{unit} | {value:.2g} | {error:.2g} |")
    lost = ", ".join(str(each) for each in fits["loads and common mode"].unidentifiable)
    print(f"\nnot identifiable where all loads are fitted: {lost or 'none'}")


if __name__ == "__main__":
    main()
