"""Cost and error of the electrical model on sensors with many electrodes.

Run by `python -m eitskin.benchmarks.studies.physics.electrodes [RESOLUTION ...]`.

Prints, as Markdown, a table for each resolution, of rectangles, discs and a polygon: cells,
unknowns, set-up and factors of the flat sensor, a touched scene by reanalysis, stage by stage, and
errors of signals (median, largest) against a converged mesh. Times are processor times. Dents of
the unbounded stack press here, without their corrections, which are not tabulated on all outlines.
"""

import dataclasses
import sys
import time
from collections.abc import Callable
from functools import partial
from typing import NamedTuple, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from eitskin.compiled import kernels
from eitskin.geometry.design.outline import Disc, PlaneOutline, Polygon, Rectangle
from eitskin.geometry.design.regular_layouts import uniform
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.geometry.meshing.grading import Grading
from eitskin.geometry.meshing.mesh_design import CellKind
from eitskin.protocol import Protocol
from eitskin.provenance import Provenance
from eitskin.simulator.electrical.assembly import Assembly
from eitskin.simulator.electrical.forward_model import ForwardModel
from eitskin.simulator.electrical.reanalysis import Reanalysis
from eitskin.simulator.electrical.resolution import Discretisation, Resolution
from eitskin.simulator.layer.deformed_layer import DeformedLayer
from eitskin.simulator.layer.dents import Dents, PlacedDent
from eitskin.simulator.mechanics.layer_stack import Mechanics
from eitskin.simulator.presses.press_store import press_table
from eitskin.simulator.scene.indenters import Cylinder

Array = NDArray[np.float64]
Returned = TypeVar("Returned")

_SLAB = Rectangle(0.150, 0.060)
_L_SHAPE = Polygon(((0, 0), (0.09, 0), (0.09, 0.03), (0.04, 0.03), (0.04, 0.06), (0, 0.06)))
_REFERENCE = SensorDesign.reference()


def _sensor(outline: PlaneOutline, count: int) -> SensorDesign:
    return dataclasses.replace(_REFERENCE, outline=outline, electrodes=uniform(outline, count))


SENSORS: dict[str, tuple[SensorDesign, CellKind]] = {
    "rectangle, 8 electrodes": (_REFERENCE, "hexahedra"),
    "rectangle, 16": (_sensor(_SLAB, 16), "prisms"),
    "rectangle, 16, hexahedra": (_sensor(_SLAB, 16), "hexahedra"),
    "rectangle, 32": (_sensor(_SLAB, 32), "prisms"),
    "rectangle, 32, hexahedra": (_sensor(_SLAB, 32), "hexahedra"),
    "disc of 100 mm, 16": (_sensor(Disc(0.050), 16), "prisms"),
    "disc of 100 mm, 32": (_sensor(Disc(0.050), 32), "prisms"),
    "L-shaped polygon, 12": (_sensor(_L_SHAPE, 12), "prisms"),
}
CONVERGED: Discretisation = ((4, 4, 4, 3, 2), Grading(1e-4, 6e-3, 1.0))
SCENES, SEED = 10, 0
HEAD = """\
| sensor | cells | unknowns | set-up, factors [s] | ms a scene | fields, matrices, solutions [ms] \
| error, median, largest [%] |
|---|---|---|---|---|---|---|"""
_FORCES = (4.0, 12.0)  # [N]
_EDGE = 0.0065  # least distance of a press from the rim [m]


class Cost(NamedTuple):
    """Cost of the electrical model of one sensor.

    Attributes:
        cells: of the mesh.
        unknowns: of the matrix.
        setup, base: of the model, and of the flat sensor's factors [s].
        fields, matrices, solution: pulled-back conductivity, condensed element matrices, and
            contacts, solutions and projections, of a scene [s].
    """

    cells: int
    unknowns: int
    setup: float
    base: float
    fields: float
    matrices: float
    solution: float


def main() -> None:
    """Print a table for each resolution named."""
    print(Provenance.now(SEED))
    truths: dict[SensorDesign, Array] = {}
    for resolution in cast("list[Resolution]", sys.argv[1:] or ["coarse", "fast"]):
        print(f"\n## {resolution}\n\n{HEAD}")
        for name, (design, cells) in SENSORS.items():
            layers = pressed_layers(design)
            if design not in truths:
                converged = ForwardModel(design, CONVERGED, cells="prisms")
                truths[design] = signals(Reanalysis(converged, layers[0]), layers)
            cost, found = measured(design, resolution, cells, layers)
            errors = np.linalg.norm(found - truths[design], axis=1)
            errors *= 100.0 / np.linalg.norm(truths[design], axis=1)
            stages = [1e3 * each for each in cost[4:]]
            print(
                f"| {name} | {cost.cells:,} | {cost.unknowns:,} | {cost.setup:.2f}, {cost.base:.2f}"
                f" | {sum(stages):.0f} | {', '.join(f'{each:.0f}' for each in stages)}"
                f" | {np.median(errors):.2f}, {errors.max():.2f} |",
                flush=True,
            )


def pressed_layers(design: SensorDesign) -> list[DeformedLayer]:
    """The flat layer, then layers under one dent each."""
    rng, mechanics, outline = np.random.default_rng(SEED), Mechanics(), design.outline
    table = press_table(_REFERENCE, mechanics, Cylinder())
    found = [DeformedLayer(design, None, mechanics.piezoresistivity)]
    while len(found) <= SCENES:
        at = rng.uniform(0.0, (outline.length, outline.width))
        dent = table.at_force(float(rng.uniform(*_FORCES)))
        if isinstance(outline, PlaneOutline) and outline.nearest(at)[1] > _EDGE:
            dents = Dents((PlacedDent(float(at[0]), float(at[1]), dent),))
            found.append(DeformedLayer(design, dents, mechanics.piezoresistivity))
    return found


def measured(
    design: SensorDesign,
    resolution: Resolution,
    cells: CellKind,
    layers: list[DeformedLayer],
) -> tuple[Cost, Array]:
    """Cost of a sensor, medians of its scenes, and the signals (scenes, measurements)."""
    model, setup = _timed(partial(ForwardModel, design, resolution, cells=cells))
    solved, base = _timed(partial(Reanalysis, model, layers[0]))
    assembly, stages = model.assembly, []
    with kernels():
        solved.impedance(layers[1])
        for layer in layers[1:]:
            entries, fields = _timed(partial(layer.entries, assembly.points))
            _, matrices = _timed(partial(_matrices, assembly, entries))
            _, whole = _timed(partial(solved.impedance, layer))
            stages.append((fields, matrices, whole - fields - matrices))
        found = signals(solved, layers)
    median = np.median(stages, axis=0).tolist()
    return Cost(len(model.mesh.cells), model.unknowns, setup, base, *median), found


def _matrices(assembly: Assembly, entries: Array) -> Array:
    return assembly.condensed_matrices(assembly.matrices(entries))


def signals(solved: Reanalysis, layers: list[DeformedLayer]) -> Array:
    """Relative changes of the impedances of all pairs, (scenes, measurements)."""
    protocol = Protocol.pairwise(len(solved.base))
    flat = np.real(protocol.measure(solved.base))
    rows = [np.real(protocol.measure(solved.impedance(layer))) for layer in layers[1:]]
    changes: Array = np.array(rows) / flat - 1.0
    return changes


def _timed(run: Callable[[], Returned]) -> tuple[Returned, float]:
    """Result, and processor time [s]."""
    start = time.process_time()
    return run(), time.process_time() - start


if __name__ == "__main__":
    main()
