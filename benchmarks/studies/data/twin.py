"""Twins of simulated sensors whose numbers are known, and of a real round skin.

Run by `python -m eitskin.benchmarks.studies.data.twin [FOLDER]`.

Hidden sensors are drawn about the reference sensor: conductivity by 20 %, thickness by 4 %,
contacts by a factor of 3, places along the rim by 1 mm, the clamp's span by 1 mm and its axis by
0.6 mm, moduli by 14 %, and a board with a gain, a load of the sink and one of idle electrodes. Each
is fitted from noisy flat frames, known angles and known presses. Prints, as Markdown, the root mean
square of error over standard error by kind of number, and what is left of the prior's width.

FOLDER holds `ohmc8.mat` (DSHardman/HydrogelEIT): a twin of its first 400 flat frames, judged on the
last 100, with contacts and instrument.
"""

import argparse
import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from eitskin.datasets.recipe.specimen import Specimen
from eitskin.datasets.recordings.form import RecordingNames
from eitskin.datasets.recordings.recording import read_recording
from eitskin.datasets.store.dataset import Dataset
from eitskin.datasets.store.state import State
from eitskin.geometry.deformation.fixtures import Bend, Clamp
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.protocol import Protocol
from eitskin.provenance import Provenance
from eitskin.simulator.instrument.fit_parameters import USUAL, Parameter
from eitskin.simulator.mechanics.layer_stack import Mechanics
from eitskin.simulator.scene.scene import Scene
from eitskin.simulator.scene.touch import Touch
from eitskin.training.twin.fit import TwinForward
from eitskin.training.twin.parameters import (
    TwinPrior,
    centred,
    instrument_parameters,
    sensor_parameters,
    twin_parameter,
)
from eitskin.training.twin.twin import Twin

Array = NDArray[np.float64]

TERMS = ("sink", "idle")
FLATS, ANGLES, SNR_DB = 10, (-10.0, 10.0, 20.0, 30.0, 40.0), 75.0
RADIUS = 0.0075
HIDDEN = {
    "conductivity": 0.17,
    "thickness": 0.4,
    "contact_impedance": 0.48,
    "electrode_place": 0.67,
    "span": 0.11,
    "offset": 0.24,
    "gel_modulus": 0.13,
    "encapsulation_modulus": 0.13,
    "gain": 1.0,
    "sink": 0.5,
    "idle": 0.5,
}
"""Standard deviations of the hidden coordinates, over those of the prior."""
RECORDING, FLAT, FIRST = "ohmc8.mat", "responseups", 400
DESCRIPTIONS = Path(__file__).parents[3] / "docs" / "guides" / "recordings"
SKIN_TERMS: dict[str, tuple[str, ...]] = {
    "contacts, ideal meter": (),
    "contacts, loads and common mode": USUAL,
    "contacts, loads, common mode and leads": (*USUAL, "leads"),
}


def hidden(parameters: tuple[Parameter, ...], rng: np.random.Generator) -> Array:
    """Coordinates of a hidden sensor, truncated at two standard deviations."""
    x = np.clip(rng.standard_normal(len(parameters)), -2.0, 2.0)
    x *= [HIDDEN[each.name] for each in parameters]
    loads = [each.name in TERMS for each in parameters]
    return np.where(loads, np.abs(x), x)


def recorded(model: TwinForward, x: Array, presses: int, rng: np.random.Generator) -> Dataset:
    """Noisy frames of a hidden sensor: flat, bent by known angles, pressed at known places."""
    places = rng.uniform((0.02, 0.012, 4.0), (0.13, 0.048, 10.0), (presses, 3)).astype(np.float32)
    rounded = [[float(str(value)) for value in row] for row in places]
    touches = [Touch(x_at, y_at, force) for x_at, y_at, force in rounded]
    scenes = [Scene()] * FLATS + [Scene(bend=Bend(angle)) for angle in ANGLES]
    scenes += [Scene(touches=(touch,)) for touch in touches]
    clean = model.readings(x, scenes)
    noise = np.abs(clean[0]).max() * 10.0 ** (-SNR_DB / 20.0) * rng.standard_normal(clean.shape)
    columns = np.full((4, len(scenes), 4), np.nan)
    if presses:
        columns[:3, -presses:, 0] = places.T
        columns[3, -presses:, 0] = RADIUS
    counts = (FLATS, len(ANGLES), presses)
    return Dataset.from_arrays(
        clean + noise,
        protocol=model.protocol,
        quantity="impedance",
        state=np.repeat([State.IDLE, State.BEND, State.TOUCH], counts),
        bend_angle_deg=np.array([scene.bend.angle_deg for scene in scenes]),
        **dict(zip(("touch_x", "touch_y", "touch_force", "touch_radius"), columns, strict=True)),
    )


def recovery(specimens: int, presses: int, seed: int) -> None:
    """Print how far fitted numbers are off, over their standard errors."""
    design = SensorDesign.reference()
    nominal, prior = centred(Specimen(design, Clamp(), Mechanics())), TwinPrior()
    sensor = (*sensor_parameters(nominal, prior), twin_parameter("gain", 1.0, prior.gain))
    n = len(design.electrodes)
    pairs = Protocol.pairwise(n)
    bare = TwinForward(nominal, sensor, pairs, "signed", "coarse")
    Z = bare.impedances(np.zeros(len(sensor)), [Scene()])[0]
    typical = float(np.median(np.abs(np.diag(Z))))
    parameters = (*sensor, *instrument_parameters(TERMS, n, prior, typical))
    model = TwinForward(nominal, parameters, pairs, "signed", "coarse")
    off, narrow = [], []
    for number in range(specimens):
        rng = np.random.default_rng((seed, number))
        x = hidden(parameters, rng)
        twin = Twin.fit(design, recorded(model, x, presses, rng), terms=TERMS)
        off.append((twin.posterior.x - x) / twin.narrowing)
        narrow.append(twin.narrowing)
        print(f"{number}: {np.sqrt(np.mean(off[-1] ** 2)):.2f}", file=sys.stderr, flush=True)
    z, left = np.array(off), np.array(narrow)
    print(f"\n## Hidden sensors\n\n- sensors: {specimens}\n- angles: {len(ANGLES)}")
    print(f"- presses: {presses}\n- flat frames: {FLATS}\n")
    print("| number | rms error over standard error | largest | left of the prior, % |")
    print("| --- | --- | --- | --- |")
    names = np.array([each.name for each in parameters])
    for name in (*dict.fromkeys(names), "all"):
        own = names == name if name != "all" else np.full(len(names), True)
        rms, most = np.sqrt(np.mean(z[:, own] ** 2)), np.abs(z[:, own]).max()
        shown = f"{rms:.2f} | {most:.1f} | {100.0 * np.median(left[:, own]):.1f}"
        print(f"| {name.replace('_', ' ')} | {shown} |", flush=True)


def round_skin(folder: Path) -> None:
    """Print how well twins with contacts and instrument explain the flat channels of a skin."""
    protocol = Protocol.from_file(DESCRIPTIONS / "round-skin.csv", 8)
    data = read_recording(folder / RECORDING, RecordingNames(FLAT), protocol)
    design = SensorDesign.from_toml(DESCRIPTIONS / "round-skin.toml")
    fitted, later = data.select(slice(FIRST)), data.select(slice(FIRST, None))
    print("\n## Round skin\n\n| twin | shown | r | residual, % | r, later | later, % |")
    print("| --- | --- | --- | --- | --- | --- |")
    for name, terms in SKIN_TERMS.items():
        twin = Twin.fit(design, fitted, terms=terms)
        both = twin.agreements["flat"], twin.judged(later)["flat"]
        cells = [f"{each.r:.3f} | {100.0 * each.residual:.1f}" for each in both]
        shown = int((twin.narrowing < 0.5).sum())
        print(f"| {name} | {shown} | {' | '.join(cells)} |", flush=True)


def main() -> None:
    """Print both."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, nargs="?", help=f"where {RECORDING} is")
    parser.add_argument("--specimens", type=int, default=12)
    parser.add_argument("--presses", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    print(Provenance.now(given.seed))
    if given.specimens:
        recovery(given.specimens, given.presses, given.seed)
    if given.folder is not None:
        round_skin(given.folder)


if __name__ == "__main__":
    main()
