"""Places on a real skin from few presses, with a fitted meter's sensitivities as the maps' mean.

Run by `python -m eitskin.benchmarks.studies.data.twin_maps FOLDER [--out OUT]`.

FOLDER holds `ohmc8.mat` (DSHardman/HydrogelEIT), split as in the study `adaptation`. Meters of two
kinds are fitted to the mean of the first 400 flat frames. To first order a press changes log V of a
channel at p by d log V / d sigma (p), computed with the meter between; one amplitude for all
channels is fitted to the labelled presses, and Gaussian-process maps learn the rest. Writes
results and prints the table as Markdown.
"""

import argparse
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from eitskin.benchmarks.results import Results, write_results
from eitskin.benchmarks.studies.data.adaptation import (
    DESCRIPTIONS,
    DRAWS,
    RECORDING,
    TESTED,
    read_skin,
)
from eitskin.datasets.recordings.form import RecordingNames
from eitskin.datasets.recordings.recording import read_recording
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.protocol import Protocol
from eitskin.provenance import Provenance
from eitskin.simulator.electrical.forward_model import ForwardModel
from eitskin.simulator.instrument.fit_parameters import USUAL
from eitskin.simulator.instrument.meter import FourTerminalMeter
from eitskin.simulator.instrument.meter_fit import fit_meter
from eitskin.training.adaptation.labelled_presses import LabelledPresses
from eitskin.training.adaptation.map_grid import MapGrid
from eitskin.training.adaptation.place_kernel import DesignSpan
from eitskin.training.adaptation.press_fit import learn_places
from eitskin.training.reconstruction.linear_model import linear_model
from eitskin.training.reconstruction.pixel_grid import PixelGrid

Array = NDArray[np.float64]
Rows = NDArray[np.int64]

NAME, FLAT, FIRST, PIXELS = "twin_maps", "responseups", 400, 3600
METERS: dict[str, tuple[str, ...]] = {
    "loads and common mode": USUAL,
    "and a lead per electrode": (*USUAL, "leads"),
}
STEP = 1e-3  # of the impedances, by which a meter's readings are differentiated


@dataclass(frozen=True, slots=True, eq=False)
class Skin:
    """The round skin as it was meant: impedances and their sensitivities.

    Attributes:
        design: of the skin.
        protocol: of its channels.
        impedance: between electrodes [ohm], (n, n).
        sensitivity: of the impedances, electrode 0 grounded, to each pixel (pixels, n, n).
        shape: rows and columns of the pixels.
    """

    design: SensorDesign
    protocol: Protocol
    impedance: Array
    sensitivity: Array
    shape: tuple[int, int]

    @classmethod
    def solved(cls) -> "Skin":
        """Impedances and sensitivities at coarse resolution."""
        design = SensorDesign.from_toml(DESCRIPTIONS / "round-skin.toml")
        n = len(design.electrodes)
        protocol = Protocol.from_file(DESCRIPTIONS / "round-skin.csv", n)
        grid = PixelGrid.of(design.outline, PIXELS)
        pairs = [(j, k) for j in range(1, n) for k in range(j, n)]
        rows = Protocol.from_rows([(j, 0, k, 0) for j, k in pairs], n)
        model = linear_model(design, rows, grid.shape, resolution="coarse")
        maps = np.zeros((n, n, grid.shape[0] * grid.shape[1]))
        for (j, k), own in zip(pairs, np.real(model.sensitivity), strict=True):
            maps[j, k] = maps[k, j] = own
        Z = ForwardModel(design, resolution="coarse").impedance().real
        return cls(design, protocol, Z, np.moveaxis(maps, 2, 0), grid.shape)

    def maps(self, meter: FourTerminalMeter) -> DesignSpan:
        """Changes of log V of every channel by a change of the conductivity at a place."""
        step = STEP * np.abs(self.impedance).max() / np.abs(self.sensitivity).max()
        ends = []
        for sign in (step, -step):
            Z = self.impedance + sign * self.sensitivity
            reading, _ = meter.reading(meter.transfer_impedance(Z, self.protocol))
            ends.append(np.log(np.abs(reading)))
        outline = self.design.outline
        slopes = ((ends[0] - ends[1]) / (2.0 * step)).T.reshape(-1, *self.shape)
        return DesignSpan(slopes, np.array([outline.length, outline.width]))


def error_mm(skin: LabelledPresses, train: Rows, test: Rows, maps: DesignSpan | None) -> float:
    """Mean error [mm] of the places of presses `test`, learned from presses `train`."""
    presses = skin.select(train)
    if maps is None:
        found, _ = learn_places(presses).locator.locate(skin.ratios[test])
        return 1e3 * float(np.linalg.norm(found.place - skin.places[test], axis=1).mean())
    logs, means = np.log(presses.ratios), maps.features(presses.places)
    # Channels count alike: each mean in units of its root mean square, as large as its answers.
    scale = np.sqrt(np.mean(logs**2, axis=0) / np.mean(means**2, axis=0))
    means = means * scale
    amplitude = float(np.sum(logs * means) / np.sum(means**2))
    rest = replace(presses, ratios=np.exp(logs - amplitude * means))
    locator = learn_places(rest).locator
    added = amplitude * scale * maps.features(_points(locator.grid)) / locator.gain
    mean = locator.grid.mean + (added @ locator.grid.whitening).reshape(locator.grid.mean.shape)
    found, _ = replace(locator, grid=replace(locator.grid, mean=mean)).locate(skin.ratios[test])
    return 1e3 * float(np.linalg.norm(found.place - skin.places[test], axis=1).mean())


def _points(grid: MapGrid) -> Array:
    """Places of a grid, row by row (n, 2) [m]."""
    rows, columns = grid.log_prior.shape
    x, y = np.meshgrid(np.arange(columns), np.arange(rows))
    return np.asarray(grid.low + grid.step * np.stack([x.ravel(), y.ravel()], axis=1))


def main() -> None:
    """Run, write and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, help=f"where {RECORDING} is")
    parser.add_argument("--out", type=Path, default=Path("build/bench"))
    parser.add_argument("--counts", type=int, nargs="+", default=[5])
    options = parser.parse_args()
    path = options.folder / RECORDING
    if not path.is_file():
        parser.error(f"there is no {path}; it is of the repository DSHardman/HydrogelEIT")
    began = time.perf_counter()
    sheet, skin = Skin.solved(), read_skin(options.folder)
    flat = read_recording(path, RecordingNames(FLAT), sheet.protocol).impedance.real.astype(float)
    frame = flat[:FIRST].mean(axis=0)
    methods: dict[str, DesignSpan | None] = {"none": None}
    named: dict[str, float] = {}
    for name, terms in METERS.items():
        fit = fit_meter(sheet.impedance, sheet.protocol, frame, terms, "magnitude")
        methods[name] = own = sheet.maps(fit.meter)
        seen, changes = own.features(skin.places), np.log(skin.ratios)
        r = [np.corrcoef(seen[:, c], changes[:, c])[0, 1] for c in range(len(sheet.protocol))]
        named[f"{name} / median r"] = float(np.median(r))
        named[f"{name} / channels of negative r"] = float(np.sum(np.array(r) < 0.0))
    test = np.arange(FIRST, FIRST + TESTED)
    print("| presses | mean of the maps | mean error, mm | draws |\n| --- | --- | --- | --- |")
    for count in options.counts:
        for name, maps in methods.items():
            trains = [
                np.sort(np.random.default_rng(draw).permutation(FIRST)[:count])
                for draw in range(DRAWS)
            ]
            errors = [error_mm(skin, train, test, maps) for train in trains]
            named[f"{count}, {name} / mean error [mm]"] = float(np.mean(errors))
            shown = ", ".join(f"{each:.1f}" for each in errors)
            print(f"| {count} | {name} | {np.mean(errors):.1f} | {shown} |", flush=True)
    command = f"python -m {__spec__.name if __spec__ else __name__} DATA"
    seconds = time.perf_counter() - began
    results = Results(NAME, command, Provenance.now(0), seconds, options.counts != [5], named)
    write_results(results, options.out, [named], {})
    for name, value in named.items():
        print(f"{name}: {value:.3g}")


if __name__ == "__main__":
    main()
