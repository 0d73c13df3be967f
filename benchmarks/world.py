"""Error of every model of presses and bends: `eitskin bench world`.

Errors are those of the signal: norm of the error of the 28 relative changes over their norm; on a
bent and pressed sensor of what the presses change, model and reference each less its own bend. The
deformation of each model is evaluated on the mesh of the reference, so that the forward model has
no part in the error.
"""

import dataclasses
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from eitskin.benchmarks.plots import plot_errors
from eitskin.benchmarks.reference_cases import KINDS, ReferenceCase, cases
from eitskin.benchmarks.results import Report, ReportTable, Watch, measured
from eitskin.geometry.deformation.fixtures import Clamp, Fixture, Hinge
from eitskin.geometry.deformation.kinematics import Composed, Deformation, Displaced
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.simulator.bends import bend_table
from eitskin.simulator.bends.bend_3d import BentStack, ClampedStack
from eitskin.simulator.deformation.dents import Dents, PlacedDent
from eitskin.simulator.deformation.press_table import press_table
from eitskin.simulator.deformation.solved_press import solved_presses
from eitskin.simulator.deformation.touches import (
    PressedSensor,
    TouchModel,
    bent_dents,
    dents,
    pressed_touches,
    resolve_touch_model,
)
from eitskin.simulator.electrical.resolution import Resolution
from eitskin.simulator.simulator import Simulator
from eitskin.threads import one_thread

Array = NDArray[np.float64]

MEDIAN, WORST = 0.02, 0.04
"""Targets of the signal error of presses by the default models: in the middle, and at most."""
BENDS = 0.01
"""Target of the signal error of bends."""
_HEADINGS = ("case", "model", "error [%]", "reference [%]", "s")
_QUICK_CASES = ("75_30", "independent_bend_20")
# Presses that are solved in 3D besides those without a table: half a minute to minutes each.
_SOLVED_TOO = ("75_30", "75_15", "two_65_30_85_30")
KINEMATIC, TABULATED, SOLVED = "kinematic", "tabulated", "solved"
"""Names of models: unbounded dents or `Hinge()`; the tables; solutions in 3D."""
QUICK = (KINEMATIC, TABULATED)

Model = Callable[[], Deformation]


def deformations(case: ReferenceCase) -> dict[str, Model | None]:
    """Models of one case by name; None where the tables of the case are not shipped."""
    scene = case.scene
    if case.is_bend:
        return {
            KINEMATIC: partial(bend, case, KINEMATIC),
            TABULATED: partial(bend, case, TABULATED),
            SOLVED: partial(_clamped_3d, case),
        }
    if scene.bend.angle_deg:
        return {
            KINEMATIC: lambda: Composed(_unbounded(case), bend(case, KINEMATIC)),
            TABULATED: None,
            SOLVED: partial(_pressed_bent, case),
        }
    shipped = resolve_touch_model(scene.touches, _sensor(case, None)) == TABULATED
    tabulated = partial(dents, scene.touches, _sensor(case, "tabulated"))
    return {
        KINEMATIC: partial(_unbounded, case),
        TABULATED: tabulated if shipped else None,
        SOLVED: partial(_pressed_3d, case),
    }


def _sensor(case: ReferenceCase, model: TouchModel | None) -> PressedSensor:
    return PressedSensor(case.design, case.mechanics, model)


def bend(case: ReferenceCase, model: str) -> Deformation:
    """Bend of a case by a model: by `Hinge()` or, under solved presses too, by the tables."""
    fixture: Fixture = Hinge() if model == KINEMATIC else Clamp()
    return bend_table.bend(case.design, fixture, case.mechanics, case.scene.bend)


def depth(case: ReferenceCase, model: str) -> float | None:
    """Depth of the first indenter by a model [m]; None for bends."""
    if case.is_bend:
        return None
    if model == KINEMATIC:
        touch = case.scene.touches[0]
        found = press_table(case.design, case.mechanics, touch.indenter).at_force(touch.force)
        return float(found.depth)
    way: TouchModel = "tabulated" if model == TABULATED else "solved"
    return pressed_touches(case.scene.touches, _sensor(case, way), _bent_state(case))[0].depth


def _clamped_3d(case: ReferenceCase) -> Deformation:
    clamp = bend_table.on_support(Clamp(), case.design.support)
    stack = ClampedStack(case.design, clamp, mechanics=case.mechanics)
    return next(stack.equilibria([case.scene.bend.angle_deg]))


def _pressed_3d(case: ReferenceCase) -> Deformation:
    solved_presses.cache_clear()
    return dents(case.scene.touches, _sensor(case, "solved"))


def _bent_state(case: ReferenceCase) -> BentStack | None:
    if not case.scene.bend.angle_deg:
        return None
    return bend_table.equilibrium(case.design, Clamp(), case.mechanics, case.scene.bend)


def _pressed_bent(case: ReferenceCase) -> Deformation:
    solved_presses.cache_clear()
    state = bend_table.equilibrium(case.design, Clamp(), case.mechanics, case.scene.bend)
    return bent_dents(case.scene.touches, _sensor(case, "solved"), bend(case, SOLVED), state)


def _unbounded(case: ReferenceCase) -> Deformation:
    """Dents of the unbounded stack, without corrections."""
    placed = []
    for touch in case.scene.touches:
        table = press_table(case.design, case.mechanics, touch.indenter)
        placed.append(PlacedDent(touch.x, touch.y, table.at_force(touch.force)))
    return Dents(tuple(placed))


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
    """Errors of all models at all cases."""

    errors: tuple[ModelError, ...]

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
        self.points: list[Array] = []

        def derivative(points: Array) -> Array:
            self.points.append(points)
            return np.zeros((*points.shape, 3))

        flat = self.simulator.deformed(Displaced(np.zeros_like, derivative))
        self.flat = flat.impedance.real

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


def figures(found: World) -> Iterator[tuple[str, float]]:
    """All figures by name: errors and depths by case and model."""
    for row in found.errors:
        yield f"{row.case} / {row.model} [%]", 100 * row.error
        if row.depth is not None:
            yield f"{row.case} / {row.model}, depth [mm]", 1e3 * row.depth
        yield f"{row.case} / {row.model} [s]", row.seconds
        yield f"{row.case} / reference [%]", 100 * row.reference_error
        if row.reference_depth is not None:
            yield f"{row.case} / reference, depth [mm]", 1e3 * row.reference_depth
    for kind in KINDS:
        for model in (KINEMATIC, TABULATED, SOLVED):
            rows = found.of(model, kind)
            if rows:
                yield (
                    f"{kind} / {model}, median [%]",
                    100 * statistics.median(r.error for r in rows),
                )
                yield f"{kind} / {model}, worst [%]", 100 * max(r.error for r in rows)
                yield f"{kind} / {model}, median [s]", statistics.median(r.seconds for r in rows)
        if found.default(kind):
            yield f"{kind} / default, cases", len(found.default(kind))
            yield f"{kind} / default, median [%]", 100 * found.median(kind)
            yield f"{kind} / default, worst [%]", 100 * found.worst(kind).error


def sentences(found: World) -> Iterator[str]:
    """Median and worst error beside their targets."""
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


def run(seed: int, quick: bool, watch: Watch = lambda _, items: items) -> Report:
    """Measure everything on one core.

    Args:
        seed: kept with the results; nothing is drawn.
        quick: two cases on a coarse mesh, without solutions in 3D.
        watch: returns the items that its text is about; shows progress where wanted.
    """
    began = time.perf_counter()
    chosen = [case for case in cases() if not quick or case.name in _QUICK_CASES]
    models = QUICK if quick else (KINEMATIC, TABULATED, SOLVED)
    errors: list[ModelError] = []
    with one_thread():
        gauges: dict[SensorDesign, Gauge] = {}
        for case in watch("cases", chosen):
            if case.design not in gauges:
                gauges[case.design] = Gauge(case.design, "standard" if quick else "fine")
            found = modelled(case, gauges[case.design], models)
            errors += [_compared(case, name, model) for name, model in found.items()]
    world = World(tuple(errors))
    points = {
        model: [(max(e.seconds, 1e-4), 100 * e.error) for e in errors if e.model == model]
        for model in models
    }
    limits = {"target, median": 100 * MEDIAN, "target, worst": 100 * WORST}
    x, y = "time of the deformation at all points [s]", "error of the signal [%]"
    return Report(
        results=measured("world", figures(world), began=began, seed=seed, quick=quick),
        rows=[dataclasses.asdict(row) for row in errors],
        tables=[
            ReportTable(("case", "model", "error [%]", "reference [%]", "s"), [*_cells(world)], 2)
        ],
        sentences=[*sentences(world)],
        plots={"world.png": partial(plot_errors, panels={"": points}, x=x, y=y, limits=limits)},
    )


def _cells(found: World) -> Iterator[tuple[str, ...]]:
    for row in found.errors:
        error, reference = f"{100 * row.error:.2f}", f"{100 * row.reference_error:.1f}"
        yield row.case, row.model, error, reference, f"{row.seconds:.3f}"
