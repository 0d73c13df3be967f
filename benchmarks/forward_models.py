"""Forward models that `bench accuracy` compares, pyEIT's, and the truth that they are held to."""

import dataclasses
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from typing import TypeAlias, get_args

import numpy as np
from numpy.typing import NDArray

from eitskin.extras import require
from eitskin.geometry import Mesh, SensorDesign
from eitskin.geometry.meshing.grading import Grading
from eitskin.geometry.meshing.mesh_design import CellKind
from eitskin.simulator import ForwardModel, Protocol
from eitskin.simulator.electrical.resolution import Discretisation, Resolution

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class ModelCase:
    """Forward model to be measured, and the line of the plot that it belongs to.

    Attributes:
        family: name of the line.
        name: name of this point of it.
        resolution: a name, or element order and grading.
        cells: kind of mesh.
    """

    family: str
    name: str
    resolution: Resolution | Discretisation
    cells: CellKind = "hexahedra"

    def model(self, design: SensorDesign) -> ForwardModel:
        """Forward model of the design on its mesh."""
        return ForwardModel(design, self.resolution, cells=self.cells)


def _length(metres: float) -> str:
    return f"{1e3 * metres:.3g} mm" if metres >= 1e-3 else f"{1e6 * metres:.3g} um"


def select_cases(
    cells: CellKind, names: Sequence[Resolution] = get_args(Resolution)
) -> list[ModelCase]:
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


FULL = (*select_cases("hexahedra"), *select_cases("prisms"), *select_cases("tetrahedra"))
QUICK = (*select_cases("hexahedra", ("coarse", "fast")), *select_cases("prisms", ("coarse",)))
# Meshes that pyEIT is measured on, cut into tetrahedra or, the plane one, into triangles.
PEERS = (uniform(4.4e-3, 2), uniform(2e-3, 0))
QUICK_PEERS = (uniform(8e-3, 2),)

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
class Drop:
    """Conductivity that falls smoothly, by 30 % at most, about the position of a touch.

    sigma = sigma_0 (1 - depth exp(-r^2 / radius^2)), r the distance from (x, y, z).

    Attributes:
        x, y, z: position where the drop is largest [m].
        background: sigma_0 [S/m].
        depth: largest relative drop.
        radius: distance at which the drop is 1/e of the largest [m].
    """

    x: float
    y: float
    z: float
    background: float = 1.0
    depth: float = 0.3
    radius: float = 0.008

    def __call__(self, points: Array) -> Array:
        """Conductivity [S/m], (...), at points (..., 3) [m]."""
        away = points - np.array([self.x, self.y, self.z])
        square = np.einsum("...i,...i->...", away, away)
        sigma: Array = self.background * (1.0 - self.depth * np.exp(-square / self.radius**2))
        return sigma


Frame: TypeAlias = Callable[[Drop | None], Array]


def drops(design: SensorDesign, seed: int, count: int = 5) -> tuple[Drop, ...]:
    """Drops at random positions on top of the layer."""
    outline = design.outline
    rng = np.random.default_rng(seed)
    places = rng.uniform((0.0, 0.0), (outline.length, outline.width), (count, 2))
    return tuple(Drop(float(x), float(y), design.thickness) for x, y in places)


def model_frame(model: ForwardModel) -> Frame:
    """Function from a conductivity to the 28 resistances [ohm] of `model`."""
    protocol = Protocol.pairwise(len(model.design.electrodes))

    def frame(drop: Drop | None) -> Array:
        return np.real(protocol.measure(model.impedance(drop)))

    return frame


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """Reference resistances and signals, far more accurate than the models that are tested.

    Attributes:
        design: the sensor.
        drops: changes of the conductivity.
        resistances: resistances of the flat sensor, (28,) [ohm].
        signals: their change by each drop, (drops, 28) [ohm].
        resistance_error, signal_error: differences of a second reference, as in `judge`.
    """

    design: SensorDesign
    drops: tuple[Drop, ...]
    resistances: Array
    signals: Array
    resistance_error: float
    signal_error: float

    @classmethod
    def compute(cls, seed: int, references: tuple[ModelCase, ModelCase] = REFERENCES) -> "Truth":
        """Solve the reference sensor by the first reference, and check it by the second."""
        design = SensorDesign.reference()
        changes = drops(design, seed)
        first, second = (model_frame(reference.model(design)) for reference in references)
        flat = first(None)
        signals = np.array([first(drop) - flat for drop in changes])
        unchecked = cls(design, changes, flat, signals, np.nan, np.nan)
        check = judge(second, unchecked, least_seconds=0.0)
        return dataclasses.replace(
            unchecked,
            resistance_error=check["resistance_error"],
            signal_error=check["signal_error"],
        )


def judge(frame: Frame, truth: Truth, least_seconds: float = 0.4) -> dict[str, float]:
    """Compare `frame` with the truth and time it over all drops, several times where it is fast.

    Returns "resistance_error", the largest relative error of the flat resistances; "signal_error",
    norm of the error of the change over norm of the change, the largest of all drops; and
    "frame_seconds", median processor time per frame of 28, evaluated, assembled and solved.
    """
    flat = frame(None)
    frames: list[Array] = []
    times: list[float] = []
    while len(frames) < len(truth.drops) or sum(times) < least_seconds:
        start = time.process_time()
        frames.append(frame(truth.drops[len(frames) % len(truth.drops)]))
        times.append(time.process_time() - start)
    signals = np.array(frames[: len(truth.drops)]) - flat
    missed = np.linalg.norm(signals - truth.signals, axis=1)
    return {
        "resistance_error": float(np.abs(flat / truth.resistances - 1.0).max()),
        "signal_error": float((missed / np.linalg.norm(truth.signals, axis=1)).max()),
        "frame_seconds": float(np.median(times)),
    }


# Six tetrahedra around a diagonal of a hexahedron; neighbours split shared faces alike. pyEIT
# wants them left-handed: others give it a stiffness of the wrong sign.
_TETRAHEDRA = np.array(
    [[0, 1, 6, 2], [0, 2, 6, 3], [0, 3, 6, 7], [0, 7, 6, 4], [0, 4, 6, 5], [0, 5, 6, 1]]
)
_TRIANGLES = np.array([[0, 1, 2], [0, 2, 3]])


def has_pyeit() -> bool:
    """Whether pyEIT is installed."""
    return find_spec("pyeit") is not None


class PointElectrodeModel:
    """Point electrode model of pyEIT 1.2.4 (Liu et al. 2018), whose electrodes are single nodes.

    The slab is of tetrahedra or, averaged over the height, of triangles.

    Attributes:
        nodes: number of nodes.
    """

    def __init__(self, design: SensorDesign, mesh: Mesh, plane: bool) -> None:
        """Split the boxes of `mesh`; each electrode is the node nearest to its centre."""
        fem, wrapper = require("pyeit.eit.fem", "bench"), require("pyeit.mesh", "bench")
        self._thickness = design.thickness if plane else 1.0
        tetrahedra = mesh.points, mesh.cells[:, _TETRAHEDRA].reshape(-1, 4)
        nodes, elements = _triangles(mesh) if plane else tetrahedra
        height = 0.0 if plane else 0.5 * design.thickness
        centres = np.array([(e.x, e.y, height)[: nodes.shape[1]] for e in design.electrodes])
        away = np.linalg.norm(nodes - centres[:, None], axis=2)
        self.nodes = len(nodes)
        self._electrodes = away.argmin(axis=1)
        self._points = _evaluation_points(nodes[elements], design.thickness)
        self._forward = fem.Forward(
            wrapper.PyEITMesh(node=nodes, element=elements, el_pos=self._electrodes)
        )

    def frame(self, background: float) -> Frame:
        """Function from the deformed layer to the resistances of all pairs [ohm]."""
        table = np.array(Protocol.pairwise(len(self._electrodes)).table)

        def frame(drop: Drop | None) -> Array:
            sigma = drop(self._points) if drop else np.full(self._points.shape[:2], background)
            return self._resistances(sigma.mean(axis=1), table[:, :2])

        return frame

    def _resistances(self, conductivity: Array, pairs: Indices) -> Array:
        """Resistances of all pairs [ohm], by superposition of drives from electrode 0."""
        self._forward.assemble_pde(conductivity * self._thickness)
        others = range(1, len(self._electrodes))
        driven = [self._forward.solve(np.array([0, j]))[self._electrodes] for j in others]
        from_zero = np.array([np.zeros(len(self._electrodes)), *driven])
        plus, minus = pairs.T
        potentials = from_zero[minus] - from_zero[plus]
        rows = np.arange(len(pairs))
        resistances: Array = potentials[rows, plus] - potentials[rows, minus]
        return resistances


def _triangles(mesh: Mesh) -> tuple[Array, Indices]:
    """Points of the lowest layer, and its squares cut into two triangles each."""
    if mesh.heights is None or mesh.cells.shape[1] != 8:
        raise ValueError("expected a structured mesh of hexahedra")
    levels = len(mesh.heights)
    squares = mesh.cells[:: levels - 1, :4] // levels
    nodes: Array = mesh.points[::levels, :2]
    return nodes, squares[:, _TRIANGLES].reshape(-1, 3)


def _evaluation_points(corners: Array, thickness: float) -> Array:
    """Points (elements, q, 3) [m] of the conductivity: centroids; over the height in the plane."""
    middles = corners.mean(axis=1)
    if middles.shape[1] == 3:
        points: Array = middles[:, None]
        return points
    heights = thickness * (np.arange(4) + 0.5) / 4.0
    points = np.empty((len(middles), len(heights), 3))
    points[..., :2], points[..., 2] = middles[:, None], heights
    return points
