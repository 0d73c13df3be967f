"""Changes of the 28 resistances by bends and presses.

Run by `python -m eitskin.benchmarks.studies.physics.signals`.

Prints, as Markdown, the change of each pair of the reference sensor over the bend angle, between
clamped plates and by the kinematic hinge, and what 5 and 10 N do at the paper's 27
positions, beside depth and thinning; with `--pictures FOLDER` draws both.
"""

import argparse
import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eitskin.extras import require
from eitskin.geometry.deformation.fixtures import Bend, Clamp, Fixture, Hinge
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.provenance import Provenance
from eitskin.simulator.scene.scene import Scene
from eitskin.simulator.scene.touch import Touch
from eitskin.simulator.simulator import Simulator

Array = NDArray[np.float64]

ANGLES = (-20.0, -10.0, 10.0, 20.0, 30.0, 40.0, 50.0)
POSITIONS = tuple(
    (float(x), y) for x, y in itertools.product(np.arange(15, 136, 15) * 1e-3, (0.015, 0.03, 0.045))
)
FORCES = (5.0, 10.0)
ALIKE = 1e-3
"""Pairs that mirror each other change alike but for this share; the first of them is named."""
DENTS = (1.0, 2.0, *FORCES, 15.0)
"""Forces in the middle of the sensor [N]; the tables of presses end below 20 N."""
FIXTURES: dict[str, Fixture] = {"clamped plates": Clamp(), "kinematic hinge, a plate": Hinge()}


@dataclass(frozen=True, slots=True, eq=False)
class Signals:
    """Relative changes of the resistances [%].

    Attributes:
        labels: of the pairs.
        bends: by the name of the fixture, (angles, pairs).
        presses: by force [N], (positions, pairs).
    """

    labels: tuple[str, ...]
    bends: dict[str, Array]
    presses: dict[float, Array]


def measured() -> Signals:
    """Signals at the resolution `standard`."""
    design = SensorDesign.reference()
    bends = {}
    for name, fixture in FIXTURES.items():
        sim = Simulator(design, "standard", fixture)
        bends[name] = _changes(sim, (Scene(Bend(angle)) for angle in ANGLES))
    presses = {
        force: _changes(sim, (Scene(touches=(Touch(x, y, force),)) for x, y in POSITIONS))
        for force in FORCES
    }
    return Signals(sim.protocol.labels, bends, presses)


def _changes(sim: Simulator, scenes: Iterable[Scene]) -> Array:
    flat = sim.measure(Scene()).impedance.real
    return np.array([100.0 * (sim.measure(scene).impedance.real / flat - 1.0) for scene in scenes])


def bend_table(labels: Sequence[str], changes: Array) -> str:
    """Table of the signals of pairs by angle."""
    head = ["pair", *(f"{angle:+g}" for angle in ANGLES)]
    rows = [
        [label, *(f"{c:+.2f}" for c in row)] for label, row in zip(labels, changes.T, strict=True)
    ]
    return _markdown(head, rows)


def press_table(found: Signals) -> str:
    """Table of the largest change of any pair at each position."""
    head = ["x, y [mm]", *(f"{f:g} N [%], pair, norm of all" for f in FORCES)]
    rows = []
    for number, (x, y) in enumerate(POSITIONS):
        cells = []
        for force in FORCES:
            change = found.presses[force][number]
            size = np.abs(change)
            largest = int(np.argmax(size > (1.0 - ALIKE) * size.max()))
            norm = np.linalg.norm(change)
            cells.append(f"{change[largest]:+.3f}, {found.labels[largest]}, {norm:.2f}")
        rows.append([f"{1e3 * x:.0f}, {1e3 * y:.0f}", *cells])
    return _markdown(head, rows)


def dent_table() -> str:
    """Table of depth, thinning and contact of a press in the middle of the sensor."""
    sim = Simulator(SensorDesign.reference(), "fast")
    head = ["force [N]", "depth [mm]", "gel thinner on the axis [%]", "contact radius [mm]"]
    head.append("mean pressure [kPa]")
    rows = []
    for force in DENTS:
        (press,) = sim.presses(Scene(touches=(Touch(0.075, 0.03, force),)))
        values = (1e3 * press.depth, 100.0 * press.thinning, 1e3 * press.contact_radius)
        row = [f"{force:g}", *(f"{v:.2f}" for v in values), f"{1e-3 * press.mean_pressure:.1f}"]
        rows.append(row)
    return _markdown(head, rows)


def _markdown(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def draw(found: Signals, folder: Path) -> list[Path]:
    """Plot pairs over angles, and pairs over positions as colour maps."""
    bends = folder / "signals-bend.png"
    panels = [(name, changes) for name, changes in found.bends.items()]
    columns = [f"{angle:+g}" for angle in ANGLES]
    _maps(panels, columns, "bend angle [deg]", found, bends, size=(10.0, 7.6))
    presses = folder / "signals-press.png"
    panels = [(f"{force:g} N, cylinder of 15 mm", c) for force, c in found.presses.items()]
    places = [f"{1e3 * x:.0f}, {1e3 * y:.0f}" for x, y in POSITIONS]
    _maps(panels, places, "place x, y [mm]", found, presses, size=(14.0, 7.6))
    return [bends, presses]


def _maps(
    panels: Sequence[tuple[str, Array]],
    columns: Sequence[str],
    axis: str,
    found: Signals,
    path: Path,
    size: tuple[float, float],
) -> None:
    figure: Any = require("matplotlib.figure", "bench").Figure(figsize=size, layout="constrained")
    limit = max(np.abs(changes).max() for _, changes in panels)
    all_axes = figure.subplots(1, len(panels), sharey=True)
    for axes, (title, changes) in zip(all_axes, panels, strict=True):
        image = axes.imshow(changes.T, cmap="RdBu_r", vmin=-limit, vmax=limit, aspect="auto")
        axes.set_title(title)
        axes.set_xticks(range(len(columns)), columns, rotation=90 if len(columns) > 9 else 0)
        axes.set_xlabel(axis)
        axes.set_yticks(range(len(found.labels)), found.labels, fontsize=8)
    all_axes[0].set_ylabel("pair of electrodes")
    figure.colorbar(image, ax=all_axes, label="change of resistance [%]")
    figure.savefig(path, dpi=110, facecolor="white")


def main() -> None:
    """Print the tables, and draw the pictures where a folder is named."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--pictures", type=Path, help="folder to draw into")
    folder = parser.parse_args().pictures
    found = measured()
    print(Provenance.now(0))
    for name, changes in found.bends.items():
        print(f"\n## {name}\n\n{bend_table(found.labels, changes)}")
    print(f"\n## presses\n\n{press_table(found)}\n")
    for force, changes in found.presses.items():
        largest = np.abs(changes).max(axis=1)
        print(f"- largest pair at {force:g} N [%]: {largest.min():.2f} to {largest.max():.2f}")
    print(f"\n## a press in the middle\n\n{dent_table()}")
    if folder:
        for path in draw(found, folder):
            print(f"\npicture: {path}")


if __name__ == "__main__":
    main()
