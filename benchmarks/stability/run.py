"""Run of all stiff and extreme cases and their outcomes: `eitskin bench stability`.

Every case must give a number that can be trusted or a ConfigurationError that says what was wrong.
Errors are against closed forms or rigorous bounds, invariants are what always holds of a case's
family, and residuals say how many digits rounding left; `CaseValues` says which is which. Random
sensors and scenes, many of them impossible, are drawn here.
"""

import dataclasses
import time
from collections.abc import Iterable, Iterator, Sequence
from functools import partial
from typing import Any, get_args

import numpy as np

from eitskin.benchmarks.results import Report, ReportTable, Watch, make_results
from eitskin.benchmarks.stability import electrical, extremes, mechanical
from eitskin.benchmarks.stability.case import QUANTITIES, Case, CaseValues, Outcome, judge
from eitskin.benchmarks.stability.electrical import imbalance
from eitskin.geometry import (
    Bend,
    Disc,
    Electrode,
    FreeArc,
    Hinge,
    Layer,
    PlaneOutline,
    Polygon,
    Rectangle,
    Roll,
    SensorDesign,
    Twist,
)
from eitskin.geometry.deformation.fixtures import Fixture
from eitskin.geometry.deformation.kinematics import Composition
from eitskin.geometry.design.electrode import On, Shape
from eitskin.geometry.meshing.grading import Grading
from eitskin.simulator import Scene, Simulator, Touch
from eitskin.simulator.deformation.press_table import sketched_dents
from eitskin.threads import one_thread

_SHOWN = ("extreme presses", "ordinary designs")  # families whose cases are figures, one by one


def cases(seed: int, quick: bool) -> dict[str, Iterable[Case]]:
    """All cases, by family; quick ones are fewer and smaller, half a minute instead of ten."""
    ratios = (1e-6, 1e6) if quick else (1e-6, 1e-4, 1e-2, 1e2, 1e4, 1e6)
    shares = (0.01,) if quick else (0.5, 0.1, 0.01, 1e-3)
    return {
        "bends": mechanical.bends(quick),
        "rolls and twists": mechanical.rolls_and_twists(quick),
        "compositions": mechanical.compositions(quick),
        "incompressible": mechanical.incompressible(quick),
        "presses": mechanical.presses(quick),
        "extreme presses": extremes.extremes(quick),
        "conductivity contrast": electrical.contrasts(ratios),
        "contact impedance": electrical.contacts(),
        "electrodes": electrical.electrodes(quick),
        "thin layers": electrical.layers((1e-6, 1.0, 1e6), shares),
        "ordinary designs": electrical.ordinary_designs(quick),
        "random designs": random_designs(seed, 20 if quick else 300),
    }


def run(seed: int, quick: bool, watch: Watch = lambda _, items: items) -> Report:
    """Compute and test all cases on one core; the report fails where one is wrong."""
    began = time.perf_counter()
    with one_thread():
        rows = [
            judge(case, family)
            for family, some in cases(seed, quick).items()
            for case in watch(family, list(some))
        ]
    own = {row["case"]: numbers for row in rows if (numbers := row.pop("figures"))}
    refused = (row for row in rows if row["family"] in _SHOWN and row["outcome"] == "refused")
    own |= {row["case"]: {"refused": 1.0} for row in refused}
    figures = dict(_figures(rows)) | {"all.seconds": time.perf_counter() - began}
    figures |= {f"{case} / {key}": each[key] for case, each in own.items() for key in each}
    wrong = [row for row in rows if row["outcome"] == "wrong"]
    remarks = ["wrong {family}, {case}: {reason}".format_map(row) for row in wrong]
    remarks += ["{family}, {case}: {reached}".format_map(row) for row in rows if row["reached"]]
    families = ["all", *dict.fromkeys(row["family"] for row in rows)]
    heads = ("cases", *get_args(Outcome), *QUANTITIES)
    cells = [(name, *(_cell(figures.get(f"{name}.{head}")) for head in heads)) for name in families]
    return Report(
        results=make_results("stability", figures.items(), began=began, seed=seed, quick=quick),
        rows=rows,
        tables=[ReportTable(("family", *heads), cells)],
        sentences=remarks,
        failed=bool(wrong),
    )


def _cell(value: float | None) -> str:
    if value is None:
        return ""
    return f"{value:.0f}" if value == int(value) else f"{value:.0e}"


def _figures(rows: Sequence[dict[str, Any]]) -> Iterator[tuple[str, float]]:
    """Figures of each family and of all: counts of the outcomes and worst values."""
    families = {"all": list(rows)}
    for row in rows:
        families.setdefault(row["family"], []).append(row)
    for name, some in families.items():
        yield f"{name}.cases", len(some)
        for outcome in get_args(Outcome):
            yield f"{name}.{outcome}", sum(row["outcome"] == outcome for row in some)
        for quantity in QUANTITIES:
            worst = [value for row in some if (value := row[quantity]) is not None]
            if worst:
                yield f"{name}.{quantity}", max(worst)


# Random sensors and scenes


def draw(rng: np.random.Generator) -> tuple[SensorDesign, Fixture, Scene]:
    """Random sensor, fixture and scene; raises ConfigurationError where one is impossible."""
    extent = _log_uniform(rng, 1e-2, 0.5)
    outline = _outline(rng, extent)
    thickness = extent * _log_uniform(rng, 3e-3, 0.3)
    count = int(rng.integers(2, 9))
    electrodes = tuple(_electrode(rng, outline, thickness, count) for _ in range(count))
    layered = rng.integers(4) == 0
    shares = rng.dirichlet(np.ones(3)).tolist() if layered else []
    design = SensorDesign(
        outline=outline,
        thickness=thickness,
        electrodes=electrodes,
        conductivity=1.0 if layered else _log_uniform(rng, 1e-3, 1e2),
        layers=tuple(Layer(share * thickness, _log_uniform(rng, 1e-3, 1e3)) for share in shares),
        encapsulated_thickness=thickness * rng.uniform(1.0, 3.0),
    )
    return design, _fixture(rng, outline), _scene(rng, outline)


def _log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def _outline(rng: np.random.Generator, extent: float) -> PlaneOutline:
    kind = rng.integers(3)
    if kind == 0:
        return Rectangle(extent, extent * _log_uniform(rng, 0.1, 3.0))
    if kind == 1:
        return Disc(0.5 * extent)
    # A star about the middle; now and then its corners are not in turn, so that sides cross.
    turn = rng.uniform(0.0, 2.0 * np.pi, int(rng.integers(3, 10)))
    turn = turn if rng.integers(6) == 0 else np.sort(turn)
    reach = 0.5 * extent * rng.uniform(0.3, 1.0, len(turn))
    points = reach[:, None] * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    points -= points.min(axis=0)
    return Polygon(tuple((float(x), float(y)) for x, y in points))


def _electrode(
    rng: np.random.Generator, outline: PlaneOutline, thickness: float, count: int
) -> Electrode:
    size = _log_uniform(rng, 1e-9, 1e3)
    # Seldom an active contact.
    phase = 0.0 if rng.integers(3) else float(rng.uniform(-0.51, 0.51) * np.pi)
    impedance = size * np.exp(1j * phase)
    z = complex(impedance) if impedance.imag else float(impedance.real)
    share = outline.perimeter / count
    make = partial(Electrode, contact_impedance=z)
    if rng.integers(4):
        x, y = outline.rim_points(rng.uniform(0.0, outline.perimeter)).tolist()
        width = share * _log_uniform(rng, 1e-2, 0.6)
        height = thickness * float(rng.uniform(0.1, 1.0)) if rng.integers(4) == 0 else None
        return make(x, y, width, height=height)
    x, y = (rng.uniform(0.2, 0.8, 2) * (outline.length, outline.width)).tolist()
    width, height = (0.5 * share * _log_uniform(rng, 0.1, 0.4) for _ in range(2))
    shape: Shape = "round" if rng.integers(2) else "rectangle"
    on: On = ("top", "bottom", "inside")[int(rng.integers(3))]
    inside = thickness * float(rng.uniform(0.0, 1.1)) if on == "inside" else None
    return make(x, y, width, height=height, z=inside, on=on, shape=shape)


def _fixture(rng: np.random.Generator, outline: PlaneOutline) -> Fixture:
    length = outline.length * float(rng.uniform(0.2, 1.1))
    transition = float(rng.choice([0.0, 0.2])) * length
    contraction = float(rng.choice([0.0, 0.8]))
    if rng.integers(2):
        return FreeArc(length, transition=transition, contraction=contraction)
    offset = outline.length * float(rng.uniform(-0.2, 0.2))
    return Hinge(length, offset, transition=transition, contraction=contraction)


def _scene(rng: np.random.Generator, outline: PlaneOutline) -> Scene:
    places = rng.uniform(0.0, 1.0, (int(rng.integers(3)), 2)) * (outline.length, outline.width)
    return Scene(
        bend=Bend(float(rng.uniform(-200.0, 200.0)) if rng.integers(2) else 0.0),
        touches=tuple(Touch(float(x), float(y), float(rng.uniform(0.0, 13.0))) for x, y in places),
        roll=Roll(float(rng.uniform(-400.0, 400.0))) if rng.integers(4) == 0 else None,
        twist=Twist(float(rng.uniform(-1e3, 1e3))) if rng.integers(4) == 0 else None,
    )


def random_designs(seed: int, count: int) -> Iterator[Case]:
    """Cases of random sensors and scenes, each with a generator of its own."""
    for number in range(count):
        solve = partial(_measure_seed, (seed, number))
        # Contrasts of a million between layers leave ten digits of a frame, and fewer of the heat.
        yield Case(f"{seed}-{number}", solve, None, invariant_limit=1e-4)


def _measure_seed(seed: tuple[int, int]) -> CaseValues:
    """Frame of the scene, with positive resistances as in the flat sensor."""
    design, fixture, scene = draw(np.random.default_rng(seed))
    size = 0.2 * max(design.outline.length, design.outline.width)
    finest = min(min(e.width, e.height or e.width) for e in design.electrodes)
    sizes = Grading(float(np.clip(0.5 * finest, 0.1 * size, size)), size, 3.0)
    sim = Simulator(design, ((1, 1), sizes), fixture)
    flat = imbalance(sim.model)
    # Every stack would need presses of its own, which take a minute: dents as for drawings.
    bare = dataclasses.replace(scene, touches=())
    dents, bent = sketched_dents(scene.touches, design), sim.deformation(bare)
    R = sim.simulate_deformation(Composition(dents, bent) if bent else dents).impedance.real
    if not np.all(R > 0.0):
        raise ArithmeticError(f"resistances of {R.min():g} to {R.max():g} ohm")
    return CaseValues(invariant=flat)
