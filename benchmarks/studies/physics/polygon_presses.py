"""Tabulated presses on polygons and pairs of them beside presses solved in 3D for each scene.

Run by `python -m eitskin.benchmarks.studies.physics.polygon_presses [SCENES ...]`.

Prints, as Markdown, for an L-shaped outline and an oblique one: the error of the signal by tables
relative to solved presses, that of dents without corrections, and processor times. SCENES pick some
by a part of their name.
"""

import sys
import time

import numpy as np
from numpy.typing import NDArray

from eitskin.geometry.design.outline import Disc, PlaneOutline, Polygon
from eitskin.geometry.design.regular_layouts import uniform
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.protocol import Protocol
from eitskin.provenance import Provenance
from eitskin.simulator.layer.dents import Dents, PlacedDent
from eitskin.simulator.presses.press_store import press_table
from eitskin.simulator.scene.indenters import Cylinder
from eitskin.simulator.scene.scene import Scene
from eitskin.simulator.scene.touch import Touch
from eitskin.simulator.simulator import Simulator

Array = NDArray[np.float64]
Place = tuple[float, float, float]  # x, y [mm] and force [N]

_SIDE, _LEG = 0.100, 0.050
_L_SHAPE = Polygon(
    ((0.0, 0.0), (_SIDE, 0.0), (_SIDE, _LEG), (_LEG, _LEG), (_LEG, _SIDE), (0.0, _SIDE))
)
_OBLIQUE = Polygon(((0.0, 0.0), (0.110, 0.0), (0.080, 0.070), (0.020, 0.070)))
_DISC = Disc(0.050)
_ELECTRODES = 12
# The first twelve are those to which the weights of `EdgeField` were fitted.
_PLACES: tuple[tuple[str, PlaneOutline, tuple[Place, ...]], ...] = (
    ("L, fitted: middle", _L_SHAPE, ((25, 25, 6),)),
    ("L, fitted: middle of a leg", _L_SHAPE, ((50, 25, 10),)),
    ("L, fitted: middle of a leg", _L_SHAPE, ((75, 25, 10),)),
    ("L, fitted: side", _L_SHAPE, ((75, 10, 6),)),
    ("L, fitted: end", _L_SHAPE, ((90, 25, 6),)),
    ("L, fitted: convex corner", _L_SHAPE, ((90, 10, 6),)),
    ("L, fitted: convex corner", _L_SHAPE, ((12, 12, 10),)),
    ("L, fitted: re-entrant corner", _L_SHAPE, ((40, 40, 6),)),
    ("L, fitted: re-entrant corner", _L_SHAPE, ((45, 45, 6),)),
    ("L, fitted: re-entrant corner", _L_SHAPE, ((60, 40, 3),)),
    ("L, fitted: middle of a leg", _L_SHAPE, ((25, 60, 3),)),
    ("L, fitted: side", _L_SHAPE, ((75, 45, 6),)),
    ("L, other: middle of a leg", _L_SHAPE, ((63, 22, 8),)),
    ("L, other: side", _L_SHAPE, ((33, 6, 4),)),
    ("L, other: side", _L_SHAPE, ((8, 70, 8),)),
    ("L, other: convex corner", _L_SHAPE, ((93, 42, 5),)),
    ("L, other: convex corner", _L_SHAPE, ((17, 9, 7),)),
    ("L, other: re-entrant corner", _L_SHAPE, ((36, 46, 8),)),
    ("L, other: re-entrant corner", _L_SHAPE, ((54, 44, 5),)),
    ("L, other: re-entrant corner", _L_SHAPE, ((43, 60, 10),)),
    ("oblique: middle", _OBLIQUE, ((52, 35, 8),)),
    ("oblique: side", _OBLIQUE, ((85, 38, 5),)),
    ("oblique: corner", _OBLIQUE, ((93, 12, 5),)),
    ("L, pair: 20 mm apart", _L_SHAPE, ((15, 25, 6), (35, 25, 6))),
    ("L, pair: 30 mm apart", _L_SHAPE, ((60, 20, 6), (88, 30, 8))),
    ("L, pair: 21 mm, about the re-entrant corner", _L_SHAPE, ((60, 41, 6), (41, 50, 5))),
    ("disc, pair: 20 mm apart", _DISC, ((40, 50, 6), (60, 50, 6))),
)


def main(wanted: list[str]) -> None:
    """Print a row for each scene."""
    print(Provenance.now(seed=0))
    print("| scene | places [mm] and forces [N] | dents alone [%] | tables [%] | ", end="")
    print("solved [s] | tables [s] |\n" + "|---" * 6 + "|")
    for name, outline, places in _PLACES:
        if wanted and not any(part in name for part in wanted):
            continue
        alone, error, solved, tabulated = _compared(outline, places)
        print(f"| {name} | {places} | {alone:.1f} | {error:.1f} | {solved:.1f} |", end="")
        print(f" {tabulated:.3f} |", flush=True)


def _compared(
    outline: PlaneOutline, places: tuple[Place, ...]
) -> tuple[float, float, float, float]:
    """Errors of dents alone and of tables [%], and processor times of solved and tabulated [s]."""
    design = SensorDesign(outline, 0.005, uniform(outline, _ELECTRODES))
    protocol = Protocol.adjacent(_ELECTRODES)
    scene = Scene(touches=tuple(Touch(1e-3 * x, 1e-3 * y, force) for x, y, force in places))
    signals, times = [], []
    for model in ("solved", "tabulated"):
        simulator = Simulator(design, "coarse", protocol=protocol, touch_model=model)
        flat = simulator.measure_all([Scene()])[0].real
        simulator.measure_all([Scene(touches=(Touch(0.015, 0.015, 3.0),))] * (model != "solved"))
        start = time.process_time()
        signals.append(simulator.measure_all([scene])[0].real / flat - 1.0)
        times.append(time.process_time() - start)
    table = press_table(design, simulator.mechanics, Cylinder())
    dents = [PlacedDent(t.x, t.y, table.at_force(t.force or 0.0)) for t in scene.touches]
    alone = simulator.deformed(Dents(tuple(dents))).impedance.real / flat - 1.0
    scale = 100.0 / float(np.linalg.norm(signals[0]))
    off = [scale * float(np.linalg.norm(each - signals[0])) for each in (alone, signals[1])]
    return off[0], off[1], times[0], times[1]


if __name__ == "__main__":
    main(sys.argv[1:])
