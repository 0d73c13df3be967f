"""Error and cost of every model of presses and bends: `eitskin bench world`.

Errors are those of the signal: norm of the error of the 28 relative changes over their norm; on a
bent and pressed sensor of what the presses change, model and reference each less its own bend. The
deformation of each model is evaluated on the mesh of the reference, so that the forward model has
no part in the error.
"""

import statistics
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from eitskin.benchmarks.world.costs import Cost, bytes_stored, costs, counted, flat_and_points
from eitskin.benchmarks.world.models import (
    KINEMATIC,
    QUICK,
    SOLVED,
    TABULATED,
    bend,
    deformations,
    depth,
)
from eitskin.benchmarks.world.reference import KINDS, ReferenceCase, cases
from eitskin.geometry.deformation.kinematics import Deformation
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.provenance import Provenance
from eitskin.simulator.electrical.resolution import Resolution
from eitskin.simulator.simulator import Simulator
from eitskin.threads import one_thread

Array = NDArray[np.float64]
Watch: TypeAlias = Callable[[str, Sequence[Any]], Iterable[Any]]

MEDIAN, WORST = 0.02, 0.04
"""Targets of the signal error of presses by the default models: in the middle, and at most."""
BENDS = 0.01
"""Target of the signal error of bends."""
_QUICK_CASES = ("75_30", "independent_bend_20")
# Presses that are solved in 3D besides those without a table: half a minute to minutes each.
_SOLVED_TOO = ("75_30", "75_15", "two_65_30_85_30")


@dataclass(frozen=True, slots=True)
class ModelError:
    """Comparison of one model with one case of the reference.

    Attributes:
        case: name of the case.
        kind: of the case, one of `KINDS`.
        model: its name.
        error: of the signal.
        seconds: of the deformation at the points of the mesh [s].
        reference_error: of the case, by estimate.
        depth: of the first indenter [m]; None for bends.
        reference_depth: the same, of the reference.
    """

    case: str
    kind: str
    model: str
    error: float
    seconds: float
    reference_error: float
    depth: float | None
    reference_depth: float | None


@dataclass(frozen=True, slots=True)
class World:
    """Results of one run.

    Attributes:
        provenance: machine, versions, seed and date.
        seconds: of the run [s].
        quick: whether few cases and a coarse mesh had to do.
        errors: of all models at all cases.
        costs: of deformations at the points of named resolutions.
        stored: size of all shipped tables by kind [bytes].
        counts: tables that simple scenes look up.
        left_out: models that have no table of a case.
    """

    provenance: Provenance
    seconds: float
    quick: bool
    errors: tuple[ModelError, ...]
    costs: tuple[Cost, ...]
    stored: dict[str, int]
    counts: dict[str, int]
    left_out: tuple[str, ...]

    def of(self, model: str, kind: str) -> list[ModelError]:
        """Errors of one model at cases of one kind."""
        return [row for row in self.errors if (row.model, row.kind) == (model, kind)]

    def default(self, kind: str) -> list[ModelError]:
        """Errors of the default model at cases of one kind: the tables, else the 3D solution."""
        tabulated = {row.case for row in self.of(TABULATED, kind)}
        return self.of(TABULATED, kind) + [
            row for row in self.of(SOLVED, kind) if row.case not in tabulated
        ]

    @property
    def kinds(self) -> tuple[str, ...]:
        """Kinds of cases that were compared."""
        return tuple(kind for kind in KINDS if self.default(kind))

    def median(self, kind: str) -> float:
        """Median error of the default models at cases of one kind."""
        return statistics.median(row.error for row in self.default(kind))

    def worst(self, kind: str) -> ModelError:
        """Largest error of the default models at cases of one kind."""
        return max(self.default(kind), key=lambda row: row.error)


def run(seed: int, quick: bool, watch: Watch = lambda _, items: items) -> World:
    """Measure everything on one core.

    Args:
        seed: kept with the results; nothing is drawn.
        quick: two cases on a coarse mesh, without solutions in 3D.
        watch: returns the items that its text is about; shows progress where wanted.
    """
    start = time.perf_counter()
    found = [case for case in cases() if not quick or case.name in _QUICK_CASES]
    models = QUICK if quick else (KINEMATIC, TABULATED, SOLVED)
    errors: list[ModelError] = []
    left_out: list[str] = []
    with one_thread():
        counts = counted()
        gauges: dict[SensorDesign, Gauge] = {}
        known: dict[tuple[Any, ...], dict[str, Modelled]] = {}
        for case in watch("cases", found):
            if case.design not in gauges:
                gauges[case.design] = Gauge(case.design, "standard" if quick else "fine")
            key = (case.design, case.mechanics, case.scene)
            if key not in known:
                known[key] = modelled(case, gauges[case.design], models)
            errors += [_compared(case, name, model) for name, model in known[key].items()]
            if TABULATED not in known[key]:
                left_out.append(f"{TABULATED} at {case.name}: no table is shipped")
        (spent,) = (measure() for measure in watch("costs", [costs]))
    return World(
        provenance=Provenance.now(seed),
        seconds=time.perf_counter() - start,
        quick=quick,
        errors=tuple(errors),
        costs=spent,
        stored=bytes_stored(),
        counts=counts,
        left_out=tuple(left_out),
    )


class Gauge:
    """Forward model of one sensor that measures relative changes.

    Attributes:
        simulator: of the flat sensor.
        flat: resistances of the flat, untouched sensor [ohm].
        points: batches of points at which deformation gradients are evaluated (..., 3) [m].
    """

    def __init__(self, design: SensorDesign, resolution: Resolution) -> None:
        """Mesh the sensor and solve without touch."""
        self.simulator = Simulator(design, resolution)
        self.flat, self.points = flat_and_points(self.simulator)

    def changes(self, deformation: Deformation) -> Array:
        """Relative change of each resistance, (28,)."""
        found: Array = self.simulator.deformed(deformation).impedance.real / self.flat - 1.0
        return found


@dataclass(frozen=True, slots=True, eq=False)
class Modelled:
    """Result of one model for one scene.

    Attributes:
        signal: relative changes of the resistances; of a bent, pressed sensor without those by its
            bend, (28,).
        seconds: of the deformation at the points of the mesh [s].
        depth: of the first indenter [m]; None for bends.
    """

    signal: Array
    seconds: float
    depth: float | None


def modelled(case: ReferenceCase, gauge: Gauge, models: Sequence[str]) -> dict[str, Modelled]:
    """Results of models for the scene of a case, by name; none without a table of the case."""
    found = {}
    known = deformations(case)
    spared = not case.is_bend and known[TABULATED] and case.name not in _SOLVED_TOO
    for name, model in known.items():
        if name not in models or model is None or (name == SOLVED and spared):
            continue
        if name != SOLVED:
            model()  # tables are read once
        start = time.process_time()
        deformation = model()
        for part in gauge.points:
            deformation.gradient(part)
        seconds = time.process_time() - start
        signal = gauge.changes(deformation)
        if case.kind == "bent press":
            signal -= gauge.changes(bend(case, name))
        found[name] = Modelled(signal, seconds, depth(case, name))
    return found


def _compared(case: ReferenceCase, name: str, model: Modelled) -> ModelError:
    error = np.linalg.norm(model.signal - case.signal) / np.linalg.norm(case.signal)
    return ModelError(
        case=case.name,
        kind=case.kind,
        model=name,
        error=float(error),
        seconds=model.seconds,
        reference_error=case.error,
        depth=model.depth,
        reference_depth=case.depth[0] if case.depth else None,
    )


def sentences(found: World) -> Iterable[str]:
    """Median and worst error beside their targets, what was left out, and provenance."""
    for kind in found.kinds:
        worst = found.worst(kind)
        median, most = (BENDS, BENDS) if kind == "bend" else (MEDIAN, WORST)
        yield (
            f"{kind}, {len(found.default(kind))} cases: median {100 * found.median(kind):.2f} % "
            f"(target {100 * median:g} %), worst {100 * worst.error:.2f} % at {worst.case} "
            f"(target {100 * most:g} %); the reference itself is good to "
            f"{100 * worst.reference_error:.2g} % there, by estimate"
        )
    baseline = [row.error for row in found.of(KINEMATIC, "press")]
    yield f"unbounded dents without corrections: {100 * min(baseline):.0f} % at least"
    for name, count in found.counts.items():
        yield f"{name}: {count}"
    yield from found.left_out
    yield f"{found.seconds:.0f} s; {found.provenance}"
