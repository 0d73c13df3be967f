"""Error against run time of the forward model and of pyEIT: `eitskin bench accuracy`.

Two errors on the reference sensor: of the 28 flat resistances, and of their change under smooth
touch-sized drops of conductivity, the signal; each against a reference far finer, whose own error
is known. Times are per frame of 28 after meshing, of one core.
"""

import dataclasses
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np

from eitskin.benchmarks.accuracy import cases, deformed, peer
from eitskin.benchmarks.accuracy.cases import ModelCase
from eitskin.benchmarks.accuracy.truth import Truth, judge, model_frame
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.protocol import Protocol
from eitskin.provenance import Provenance
from eitskin.simulator.electrical.forward_model import ForwardModel
from eitskin.simulator.electrical.resolution import discretisation
from eitskin.threads import one_thread

# hp-FEM, converged to nine digits: pairs (0,1) .. (0,7), and the sum over all 28 [ohm].
HP_FIRST = (530.08615, 718.93029, 744.02202, 720.20649, 548.07843, 470.82818, 407.32498)
HP_SUM = 16209.0957
HP_CONTACT = 1e-4

Watch: TypeAlias = Callable[[str, Sequence[Any]], Iterable[Any]]


@dataclass(frozen=True, slots=True)
class ModelResult:
    """One point of the plot.

    Attributes:
        family, name: the line of the plot, and the point on it.
        cells: kind of mesh.
        element: orders in the plane of the constant, linear ... part upwards.
        solver: that factorised.
        nodes, unknowns: of the mesh, and of the matrix.
        setup_seconds: for a new geometry; of pyEIT without the mesh.
        frame_seconds: per frame of 28, all but the mesh done anew.
        resistance_error, signal_error: as in `Judgement`.
        published_error: largest relative error against the published flat resistances at
            z = 1e-4 ohm m2; None for pyEIT, whose electrodes have no contact impedance.
    """

    family: str
    name: str
    cells: str
    element: str
    solver: str
    nodes: int
    unknowns: int
    setup_seconds: float
    frame_seconds: float
    resistance_error: float
    signal_error: float
    published_error: float | None


@dataclass(frozen=True, slots=True)
class Duel:
    """Results of pyEIT and of eitskin on one mesh."""

    own: ModelResult
    other: ModelResult

    @property
    def ratio(self) -> float:
        """Ratio of pyEIT's time per frame to eitskin's."""
        return self.other.frame_seconds / self.own.frame_seconds


@dataclass(frozen=True, slots=True)
class Accuracy:
    """Everything that one run found.

    Attributes:
        provenance: what it was measured with.
        seconds: that the run took [s].
        quick: whether fewer models and a coarser reference had to do.
        resistance_error, signal_error: of the reference, as in `Truth`.
        results: of our models.
        duels: at equal nodes; empty where pyEIT is not installed.
        deformed: bent and pressed scenes.
    """

    provenance: Provenance
    seconds: float
    quick: bool
    resistance_error: float
    signal_error: float
    results: tuple[ModelResult, ...]
    duels: tuple[Duel, ...]
    deformed: tuple[deformed.Deformed, ...]

    @property
    def points(self) -> tuple[ModelResult, ...]:
        """All results: eitskin's, then pyEIT's."""
        own, others = (d.own for d in self.duels), (d.other for d in self.duels)
        return (*self.results, *own, *others)


def run(seed: int, quick: bool, watch: Watch = lambda _, items: items) -> Accuracy:
    """Measure everything on one core.

    Args:
        seed: of the places of the conductivity drops.
        quick: fewer models and a coarser reference, in seconds instead of minutes.
        watch: gives back the items that its text is about; shows progress where wanted.
    """
    start = time.perf_counter()
    own = cases.QUICK if quick else cases.FULL
    peers = (cases.QUICK_PEERS if quick else cases.PEERS) if peer.is_installed() else ()
    with one_thread():
        references = cases.QUICK_REFERENCES if quick else cases.REFERENCES
        (truth,) = (Truth.compute(seed, pair) for pair in watch("reference", [references]))
        results = tuple(measure(case, truth) for case in watch("models", own))
        duels = tuple(compare(case, truth) for case in watch("pyEIT", peers))
        (pressed,) = (f(quick) for f in watch("bent and pressed", [_deformed]))
    return Accuracy(
        provenance=Provenance.now(seed),
        seconds=time.perf_counter() - start,
        quick=quick,
        resistance_error=truth.resistance_error,
        signal_error=truth.signal_error,
        results=results,
        duels=duels,
        deformed=pressed,
    )


def measure(case: ModelCase, truth: Truth) -> ModelResult:
    """Errors and times of one forward model."""
    start = time.process_time()
    model = case.model(truth.design)
    setup = time.process_time() - start
    found = judge(model_frame(model), truth)
    order, _ = discretisation(case.resolution, truth.design, case.cells)
    return ModelResult(
        family=case.family,
        name=case.name,
        cells=case.cells,
        element="-".join(map(str, order)),
        solver=model.solver.name,
        nodes=len(model.mesh.points),
        unknowns=model.unknowns,
        setup_seconds=setup,
        frame_seconds=found.seconds,
        resistance_error=found.resistance_error,
        signal_error=found.signal_error,
        published_error=published_error(case),
    )


def published_error(case: ModelCase) -> float:
    """Largest relative error of the seven published flat resistances and of their sum."""
    design = SensorDesign.reference()
    electrodes = [dataclasses.replace(e, contact_impedance=HP_CONTACT) for e in design.electrodes]
    model = case.model(dataclasses.replace(design, electrodes=tuple(electrodes)))
    R = np.real(Protocol.pairwise(8).measure(model.impedance()))
    errors = [*(R[:7] / HP_FIRST - 1.0), R.sum() / HP_SUM - 1.0]
    return float(np.abs(errors).max())


def compare(case: ModelCase, truth: Truth) -> Duel:
    """Compare both models on the mesh of one case, a plane one where the case has one order."""
    order, _ = discretisation(case.resolution, truth.design, case.cells)
    plane = len(order) == 1
    mesh = ForwardModel(truth.design, case.resolution).mesh
    model = peer.PointElectrodeModel(truth.design, mesh, plane)
    found = judge(model.frame(truth.design.conductivity), truth)
    cells = "triangles" if plane else "tetrahedra"
    other = ModelResult(
        family=f"pyEIT, {cells}",
        name=case.name,
        cells=cells,
        element="1",
        solver="sparse LU, once per drive",
        nodes=model.nodes,
        unknowns=model.nodes,
        setup_seconds=model.setup_seconds,
        frame_seconds=found.seconds,
        resistance_error=found.resistance_error,
        signal_error=found.signal_error,
        published_error=None,
    )
    own = measure(case, truth)
    return Duel(dataclasses.replace(own, nodes=model.nodes), other)


def _deformed(quick: bool) -> tuple[deformed.Deformed, ...]:
    if quick:
        return deformed.compare_deformed(
            ("fast",), deformed.QUICK_REFERENCES, deformed.QUICK_SCENES
        )
    return deformed.compare_deformed(
        ("fast", "standard", "fine"), deformed.REFERENCES, deformed.SCENES
    )
