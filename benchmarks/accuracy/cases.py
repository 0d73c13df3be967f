"""Forward models that `bench accuracy` compares: meshes, elements and solvers."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import get_args

from eitskin.geometry.design.sensor import SensorDesign
from eitskin.geometry.meshing.grading import Grading
from eitskin.geometry.meshing.mesh_design import CellKind
from eitskin.simulator.electrical.forward_model import ForwardModel
from eitskin.simulator.electrical.resolution import Discretisation, Resolution
from eitskin.simulator.linalg.elimination_order import OrderName

# A ladder's rungs: each divides the cells at the electrode edges by this.
_STEP = 4.0

_ORDERS = {1: "linear", 2: "quadratic", 3: "cubic", 4: "quartic"}


@dataclass(frozen=True, slots=True)
class ModelCase:
    """Forward model to be measured, and the line of the plot that it belongs to.

    Attributes:
        family: name of the line.
        name: of this point of it.
        resolution: a name, or element order and grading.
        cells: kind of mesh.
        solver: chosen by the shape when omitted.
    """

    family: str
    name: str
    resolution: Resolution | Discretisation
    cells: CellKind = "hexahedra"
    solver: OrderName | None = None

    def model(self, design: SensorDesign) -> ForwardModel:
        """Forward model of the design on its mesh."""
        return ForwardModel(design, self.resolution, cells=self.cells, solver=self.solver)


def ladder(
    order: tuple[int, ...],
    coarse: Grading,
    rungs: int,
    cells: CellKind = "hexahedra",
    solver: OrderName | None = None,
) -> list[ModelCase]:
    """Sequence of ever finer gradings for elements of one order.

    Far from the edges the error goes with size^(2 order), near them with the size of the finest
    cells alone: sizes and growth shrink as the finest size to the power of 1 / (2 order).
    """
    family = f"{cells}, {_ORDERS[order[0]]}" + (f", {solver}" if solver else "")
    cases = []
    for rung in range(rungs):
        finest = coarse.finest / _STEP**rung
        ratio = _STEP ** (-0.5 * rung / order[0])
        grading = Grading(finest, coarse.coarsest * ratio, coarse.growth * ratio, coarse.layers)
        cases.append(ModelCase(family, _length(finest), (order, grading), cells, solver))
    return cases


def _length(metres: float) -> str:
    return f"{1e3 * metres:.3g} mm" if metres >= 1e-3 else f"{1e6 * metres:.3g} um"


def named(cells: CellKind, names: Sequence[Resolution] = get_args(Resolution)) -> list[ModelCase]:
    """The named resolutions for one kind of mesh."""
    return [ModelCase(f"{cells}, named", name, name, cells) for name in names]


def uniform(size: float, layers: int) -> ModelCase:
    """Linear elements on boxes of one size, as given to pyEIT; a plane model without layers."""
    order = (1, 1) if layers else (1,)
    return ModelCase(
        "hexahedra, linear, uniform" if layers else "squares, linear, uniform",
        _length(size),
        (order, Grading(size, size, 1.0, max(1, layers))),
    )


CUBIC: tuple[tuple[int, ...], Grading] = ((3, 2, 1), Grading(1e-3, 5e-3, 2.0))

FULL: tuple[ModelCase, ...] = (
    *named("hexahedra"),
    *ladder((1, 1), Grading(2e-3, 4e-3, 1.0), 3),
    *ladder((2, 2, 1), Grading(1e-3, 4e-3, 1.0), 3),
    *ladder(*CUBIC, rungs=4),
    *ladder((4, 3, 2), Grading(1e-3, 6e-3, 3.0), 4),
    *ladder(*CUBIC, rungs=3, solver="nested dissection"),
    *named("prisms"),
    *ladder((1, 1), Grading(2e-3, 4e-3, 0.7), 3, "prisms"),
    *ladder((2, 2, 1), Grading(1e-3, 5e-3, 0.7), 2, "prisms"),
    *ladder((3, 2, 1), Grading(1e-3, 6e-3, 0.7), 3, "prisms"),
    *named("tetrahedra"),
)
# Meshes that pyEIT is measured on, cut into tetrahedra or, the plane ones, into triangles.
PEERS = (uniform(4.4e-3, 2), uniform(2.2e-3, 4), uniform(2e-3, 0), uniform(9.5e-4, 0))
QUICK_PEERS = (uniform(8e-3, 2),)

QUICK: tuple[ModelCase, ...] = (
    *named("hexahedra", ("fast",)),
    *ladder((1, 1), Grading(4e-3, 5e-3, 1.0), 2),
    *ladder((3, 2, 1), Grading(2e-3, 6e-3, 2.0), 2, solver="nested dissection"),
    *ladder((2, 2, 1), Grading(4e-3, 1e-2, 1.0), 2, "prisms"),
)

# Pairs of references: the first is the truth; the second, of other cells, order and grading, says
# how far it can be trusted.
REFERENCES = (
    ModelCase("reference", "first", ((5, 4, 3, 2), Grading(3e-6, 4e-3, 1.5))),
    ModelCase("reference", "second", ((4, 3, 3, 2), Grading(1e-5, 7e-3, 0.8)), "prisms"),
)
QUICK_REFERENCES = (
    ModelCase("reference", "first", ((4, 3, 2), Grading(1e-5, 5e-3, 2.5))),
    ModelCase("reference", "second", ((3, 2, 1), Grading(2e-5, 4e-3, 1.5))),
)


@dataclass(frozen=True, slots=True)
class Target:
    """Target of a named resolution on one core; errors as in `Judgement`.

    `deformed_error` is the largest error of the signal of presses and sheared layers.
    """

    name: str
    resistance_error: float | None
    signal_error: float
    deformed_error: float
    seconds: float


TARGETS = (
    Target("fast", None, 2e-2, 1e-2, 0.010),
    Target("standard", 1e-3, 1e-2, 3e-3, 0.050),
    Target("fine", 1e-5, 1e-4, 1e-4, 5.0),
)
TARGET_RATIO = 20.0
