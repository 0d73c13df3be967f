"""Models of presses and bends: kinematic, tabulated and solved in 3D."""

from collections.abc import Callable
from functools import partial

from eitskin.benchmarks.world.reference import ReferenceCase
from eitskin.geometry.deformation.fixtures import Clamp, Fixture, Hinge
from eitskin.geometry.deformation.kinematics import Composed, Deformation
from eitskin.simulator.bends import bend_store
from eitskin.simulator.bends.bend_3d import ClampedStack
from eitskin.simulator.layer.dents import Dents, PlacedDent
from eitskin.simulator.layer.pressed_touches import TouchModel, dents, pressed_touches
from eitskin.simulator.presses.correction_store import is_shipped, tabulable
from eitskin.simulator.presses.press_store import press_table
from eitskin.simulator.presses.solved_press import solved_presses

KINEMATIC, TABULATED, SOLVED = "kinematic", "tabulated", "solved"
"""Names of models: unbounded dents or `Hinge()`; the tables; solutions in 3D."""
QUICK = (KINEMATIC, TABULATED)

Model = Callable[[], Deformation]
_FIXTURES: dict[str, Fixture] = {KINEMATIC: Hinge(), TABULATED: Clamp(), SOLVED: Clamp()}


def deformations(case: ReferenceCase) -> dict[str, Model | None]:
    """Models of one case by name; None where the tables of the case are not shipped."""
    scene, sensor = case.scene, (case.design, case.mechanics)
    if case.is_bend:
        design, materials = sensor
        return {
            KINEMATIC: partial(bend_store.bend, design, Hinge(), materials, scene.bend),
            TABULATED: partial(bend_store.bend, design, Clamp(), materials, scene.bend),
            SOLVED: partial(_clamped_3d, case),
        }
    shipped = tabulable(case.design) and all(
        is_shipped(*sensor, touch.indenter) for touch in scene.touches
    )
    found: dict[str, Model | None] = {
        KINEMATIC: partial(_unbounded, case),
        TABULATED: partial(dents, scene.touches, *sensor, "tabulated") if shipped else None,
        SOLVED: partial(_pressed_3d, case),
    }
    if not scene.bend.angle_deg:
        return found
    return {
        name: None if press is None else partial(_then_bent, case, press, _FIXTURES[name])
        for name, press in found.items()
    }


def depth(case: ReferenceCase, model: str) -> float | None:
    """Depth of the first indenter by a model [m]; None for bends."""
    if case.is_bend:
        return None
    if model == KINEMATIC:
        touch = case.scene.touches[0]
        found = press_table(case.design, case.mechanics, touch.indenter).at_force(touch.force)
        return float(found.depth)
    way: TouchModel = "tabulated" if model == TABULATED else "solved"
    return pressed_touches(case.scene.touches, case.design, case.mechanics, way)[0].depth


def _then_bent(case: ReferenceCase, press: Model, fixture: Fixture) -> Deformation:
    """Presses on the flat sensor, then the bend."""
    bend = bend_store.bend(case.design, fixture, case.mechanics, case.scene.bend)
    return Composed(press(), bend)


def _clamped_3d(case: ReferenceCase) -> Deformation:
    clamp = bend_store.on_support(Clamp(), case.design.support)
    stack = ClampedStack(case.design, clamp, mechanics=case.mechanics)
    return next(stack.equilibria([case.scene.bend.angle_deg]))


def _pressed_3d(case: ReferenceCase) -> Deformation:
    solved_presses.cache_clear()
    return dents(case.scene.touches, case.design, case.mechanics, "solved")


def _unbounded(case: ReferenceCase) -> Deformation:
    """Dents of the unbounded stack, without corrections."""
    placed = []
    for touch in case.scene.touches:
        table = press_table(case.design, case.mechanics, touch.indenter)
        placed.append(PlacedDent(touch.x, touch.y, table.at_force(touch.force)))
    return Dents(tuple(placed))
