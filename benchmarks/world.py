"""Error of every model of presses and bends: `eitskin bench world`.

Errors are those of the signal: norm of the error of the 28 relative changes over their norm; on a
bent and pressed sensor of what the presses change, model and reference each less its own bend. The
deformation of each model is evaluated on the mesh of the reference: meshes have no part in it.
"""

import json
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from eitskin.benchmarks.results import (
    Columns,
    Report,
    ReportTable,
    Watch,
    make_results,
    plot_errors,
)
from eitskin.geometry.deformation.fixtures import Bend, Clamp, Fixture, Hinge
from eitskin.geometry.deformation.kinematics import Deformation, Displaced
from eitskin.geometry.design.sensor import Free, Plates, Rigid, SensorDesign, Substrate, Support
from eitskin.simulator.bends import bend_table
from eitskin.simulator.bends.bend_3d import ClampedStack
from eitskin.simulator.bends.pressed_plates import held_by_plates
from eitskin.simulator.deformation.pressed_sensor import PressedSensor, TouchModel, solved_presses
from eitskin.simulator.deformation.sensor_grid import OWN_GRID
from eitskin.simulator.deformation.touches import dents, resolve_touch_model
from eitskin.simulator.electrical.resolution import Resolution
from eitskin.simulator.mechanics.layer_stack import Mechanics
from eitskin.simulator.mechanics.materials import NeoHookean
from eitskin.simulator.scene.indenters import Cylinder, Sphere
from eitskin.simulator.scene.scene import Scene, Touch
from eitskin.simulator.simulator import Simulator
from eitskin.threads import one_thread

Array = NDArray[np.float64]

MEDIAN, WORST = 0.02, 0.04
"""Targets of the signal error of presses by the default models: in the middle, and at most."""
BENDS = 0.01
"""Target of the signal error of bends."""
_COLUMNS: Columns = {
    "case": ("case", "", 1),
    "model": ("model", "", 1),
    "error [%]": ("error", ".2f", 100.0),
    "reference [%]": ("reference_error", ".1f", 100.0),
    "s": ("seconds", ".3f", 1),
}
_QUICK_CASES = ("75_30", "independent_bend_20")
# Presses that are solved in 3D besides those without a table: half a minute to minutes each.
_SOLVED_TOO = ("75_30", "75_15", "two_65_30_85_30")
KINEMATIC: Final = "kinematic"
TABLE_MODEL: Final = "tabulated"
SOLVED_MODEL: Final = "solved"
"""Names of models: `Hinge()`, of bends alone; the tables; solutions in 3D."""
MODELS = (KINEMATIC, TABLE_MODEL, SOLVED_MODEL)


Model = Callable[[], Deformation]
KINDS = ("press", "supported press", "bent press", "bend")
"""Kinds of cases: flat on a rigid base, flat on another support, pressed and bent, bent only."""
UNILATERAL: Final = "unilateral"
"""Contact of references that borrow nothing; others have the profile of an axisymmetric press."""
PUBLISHED_FILE = Path(__file__).parent / "published" / "world_reference.json"
_SUPPORTS: dict[str, Support] = {"plates": Plates(), "free": Free()}


@dataclass(frozen=True, slots=True, eq=False)
class ReferenceCase:
    """Case of the reference: presses on a support, flat or bent, or a clamped bend.

    Attributes:
        name: name of the case.
        design: design of the sensor, with its support.
        mechanics: materials of the sensor.
        scene: touches, bend, or both.
        changes: relative changes of the 28 pair resistances, (28,).
        signal: changes that the touches make, or the bend of an untouched sensor, (28,).
        error: error of the changes over their norm, by estimate.
        depth: depth of each indenter [m].
        borrows: whether the shape of its contacts is taken from the product.
    """

    name: str
    design: SensorDesign
    mechanics: Mechanics
    scene: Scene
    changes: Array
    signal: Array
    error: float
    depth: tuple[float, ...]
    borrows: bool

    @property
    def is_bend(self) -> bool:
        """Whether the sensor is bent rather than pressed."""
        return not self.scene.touches

    @property
    def kind(self) -> str:
        """One of `KINDS`."""
        if self.is_bend:
            return "bend"
        if self.scene.bend.angle_deg:
            return "bent press"
        return "press" if isinstance(self.design.support, Rigid) else "supported press"


def cases(path: Path = PUBLISHED_FILE) -> list[ReferenceCase]:
    """Cases that are solved."""
    solutions = json.loads(path.read_text(encoding="utf-8"))["solutions"]
    return [_case(solution) for solution in solutions if solution["changes"] is not None]


def _case(solution: dict[str, Any]) -> ReferenceCase:
    """Case of a solution; the clamp holds a sensor that is bent without presses."""
    support = _SUPPORTS.get(solution["support"], Rigid())
    if solution["support"] == "substrate":
        thickness, modulus = solution["substrate"]
        support = Substrate(1e-3 * thickness, 1e3 * modulus)
    design = replace(SensorDesign.reference(), support=support)
    if (factor := solution["thickness"]) != 1.0:
        design = replace(
            design,
            thickness=factor * design.thickness,
            encapsulated_thickness=factor * design.encapsulated_thickness,
        )
    materials = Mechanics()
    around = NeoHookean(solution["ratio"] * materials.gel.shear_modulus)
    shape = Cylinder if solution["indenter"]["shape"] == "cylinder" else Sphere
    indenter = shape(1e-3 * solution["indenter"]["radius"])
    touches = (
        Touch(1e-3 * x, 1e-3 * y, solution["force"], indenter) for x, y in solution["touches"]
    )
    changes = np.array(solution["changes"])
    return ReferenceCase(
        name=solution["name"],
        design=design,
        mechanics=replace(materials, encapsulation=around),
        scene=Scene(Bend(solution["angle"]), tuple(touches)),
        changes=changes,
        signal=changes - solution.get("bend_changes", np.zeros(len(changes))),
        error=solution["error"],
        depth=tuple(1e-3 * depth for depth in solution["depth"]),
        borrows=bool(solution["touches"]) and solution.get("contact") != UNILATERAL,
    )


def deformations(case: ReferenceCase) -> dict[str, Model]:
    """Models of one case by name, without tables where those of the case are not shipped."""
    touches = case.scene.touches
    if case.is_bend:
        return {
            KINEMATIC: partial(bend, case, KINEMATIC),
            TABLE_MODEL: partial(bend, case, TABLE_MODEL),
            SOLVED_MODEL: partial(_clamped_3d, case),
        }
    models: dict[str, Model] = {SOLVED_MODEL: partial(_pressed_3d, case)}
    shipped = resolve_touch_model(touches, _sensor(case, None)) == TABLE_MODEL
    if shipped:
        models[TABLE_MODEL] = lambda: dents([touches], [_sensor(case, TABLE_MODEL)])[0]
    return models


def _sensor(case: ReferenceCase, model: TouchModel | None) -> PressedSensor:
    angle = case.scene.bend.angle_deg
    plates = held_by_plates(case.design, Clamp(), case.mechanics, OWN_GRID, angle)
    return PressedSensor(case.design, case.mechanics, model, plates=plates)


def bend(case: ReferenceCase, model: str) -> Deformation:
    """Bend of a case by a model: by `Hinge()` or, under solved presses too, by the tables."""
    fixture: Fixture = Hinge() if model == KINEMATIC else Clamp()
    return bend_table.bend(case.design, fixture, case.mechanics, case.scene.bend)


def _clamped_3d(case: ReferenceCase) -> Deformation:
    clamp = bend_table.on_support(Clamp(), case.design.support)
    stack = ClampedStack(case.design, clamp, mechanics=case.mechanics)
    return next(stack.equilibria([case.scene.bend.angle_deg]))


def _pressed_3d(case: ReferenceCase) -> Deformation:
    solved_presses.cache_clear()
    return dents([case.scene.touches], [_sensor(case, SOLVED_MODEL)])[0]


@dataclass(frozen=True, slots=True)
class ModelError:
    """Comparison of one model with one case of the reference.

    Attributes:
        case: name of the case.
        kind: kind of the case, one of `KINDS`.
        model: its name.
        error: error of the signal.
        seconds: seconds of the deformation at the points of the mesh [s].
        reference_error: reference error of the case, by estimate.
        borrows: whether the reference borrows the shape of its contacts.
    """

    case: str
    kind: str
    model: str
    error: float
    seconds: float
    reference_error: float
    borrows: bool


class Gauge:
    """Forward model of one sensor that measures relative changes.

    Attributes:
        simulator: simulator of the flat sensor.
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

        flat = self.simulator.simulate_deformation(Displaced(np.zeros_like, derivative))
        self.flat = flat.impedance.real

    def changes(self, deformation: Deformation) -> Array:
        """Relative change of each resistance, (28,)."""
        found: Array = (
            self.simulator.simulate_deformation(deformation).impedance.real / self.flat - 1.0
        )
        return found


def compare(case: ReferenceCase, gauge: Gauge, models: Sequence[str]) -> Iterator[ModelError]:
    """Errors of models at the scene of a case; presses that have a table are seldom solved."""
    has_tables = deformations(case)
    if not case.is_bend and TABLE_MODEL in has_tables and case.name not in _SOLVED_TOO:
        del has_tables[SOLVED_MODEL]
    for name in (model for model in models if model in has_tables):
        if name != SOLVED_MODEL:
            has_tables[name]()  # tables are read once
        start = time.process_time()
        deformation = has_tables[name]()
        for part in gauge.points:
            deformation.gradient(part)
        seconds = time.process_time() - start
        signal = gauge.changes(deformation)
        if case.kind == "bent press":
            signal -= gauge.changes(bend(case, name))
        error = np.linalg.norm(signal - case.signal) / np.linalg.norm(case.signal)
        yield ModelError(
            case=case.name,
            kind=case.kind,
            model=name,
            error=float(error),
            seconds=seconds,
            reference_error=case.error,
            borrows=case.borrows,
        )


def select_errors(errors: Sequence[ModelError], model: str, kind: str) -> list[ModelError]:
    """Errors of one model at cases of one kind; "default" is the tables, else the 3D solution."""
    if model != "default":
        return [row for row in errors if (row.model, row.kind) == (model, kind)]
    tabulated = select_errors(errors, TABLE_MODEL, kind)
    cases = {row.case for row in tabulated}
    return tabulated + [
        row for row in select_errors(errors, SOLVED_MODEL, kind) if row.case not in cases
    ]


def figures(errors: Sequence[ModelError]) -> Iterator[tuple[str, float]]:
    """All figures by name: errors by case and model."""
    for row in errors:
        yield f"{row.case} / {row.model} [%]", 100 * row.error
        yield f"{row.case} / {row.model} [s]", row.seconds
        yield f"{row.case} / reference [%]", 100 * row.reference_error
    for kind in KINDS:
        for model in (*MODELS, "default"):
            if rows := select_errors(errors, model, kind):
                name, percent = f"{kind} / {model}", [100 * row.error for row in rows]
                yield f"{name}, median [%]", statistics.median(percent)
                yield f"{name}, worst [%]", max(percent)
                if model == "default":
                    yield f"{name}, cases", len(rows)
                    own = [100 * row.error for row in rows if not row.borrows]
                    if 0 < len(own) < len(rows):
                        yield f"{name}, borrowing nothing, cases", len(own)
                        yield f"{name}, borrowing nothing, median [%]", statistics.median(own)
                        yield f"{name}, borrowing nothing, worst [%]", max(own)
                else:
                    yield f"{name}, median [s]", statistics.median(row.seconds for row in rows)


def sentences(errors: Sequence[ModelError]) -> Iterator[str]:
    """Median and worst error next to their targets."""
    for kind in KINDS:
        if not (rows := select_errors(errors, "default", kind)):
            continue
        middle, worst = statistics.median(r.error for r in rows), max(rows, key=lambda r: r.error)
        median, most = (BENDS, BENDS) if kind == "bend" else (MEDIAN, WORST)
        own = sum(not row.borrows for row in rows)
        yield (
            f"{kind}, {len(rows)} cases, {own} with references that borrow nothing: "
            f"median {100 * middle:.2f} % "
            f"(target {100 * median:g} %), worst {100 * worst.error:.2f} % at {worst.case} "
            f"(target {100 * most:g} %); the reference itself is good to "
            f"{100 * worst.reference_error:.2g} % there, by estimate"
        )


def run(seed: int, quick: bool, watch: Watch = lambda _, items: items) -> Report:
    """Measure everything on one core.

    Args:
        seed: number stored with the results; nothing is drawn.
        quick: two cases on a coarse mesh, without solutions in 3D.
        watch: returns the items that its text is about; shows progress where wanted.
    """
    began = time.perf_counter()
    chosen = [case for case in cases() if not quick or case.name in _QUICK_CASES]
    models = MODELS[:2] if quick else MODELS
    gauge = cache(partial(Gauge, resolution="standard" if quick else "fine"))
    with one_thread():
        errors = [
            row
            for case in watch("cases", chosen)
            for row in compare(case, gauge(case.design), models)
        ]
    points = {
        model: [(max(e.seconds, 1e-4), 100 * e.error) for e in errors if e.model == model]
        for model in models
    }
    limits = {"target, median": 100 * MEDIAN, "target, worst": 100 * WORST}
    x, y = "time of the deformation at all points [s]", "error of the signal [%]"
    rows = [asdict(row) for row in errors]
    draw = partial(plot_errors, panels={"": points}, x=x, y=y, limits=limits, joined=False)
    return Report(
        results=make_results("world", figures(errors), began=began, seed=seed, quick=quick),
        rows=rows,
        tables=[ReportTable.from_rows(rows, _COLUMNS, 2)],
        sentences=[*sentences(errors)],
        plots={"world.png": draw},
    )
