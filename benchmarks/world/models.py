"""Models of presses and bends: kinematic, tabulated and solved in 3D."""

from collections.abc import Callable
from functools import partial

from eitskin.benchmarks.world.reference import ReferenceCase
from eitskin.geometry.deformation.fixtures import Clamp, Fixture, Hinge
from eitskin.geometry.deformation.kinematics import Composed, Deformation
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
