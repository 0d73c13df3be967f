"""Bends and touches of a body from a surface file: solved once, kept in the store."""

import hashlib
import math
from collections.abc import Callable, Sequence
from dataclasses import astuple, dataclass, fields, replace
from functools import lru_cache
from typing import Any

import numpy as np

from eitskin.errors import ConfigurationError
from eitskin.geometry.deformation.fixtures import Bend, Clamp, Fixture
from eitskin.geometry.deformation.kinematics import Deformation
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.geometry.design.surface import Surface
from eitskin.simulator.bodies.clamped_body import BentBody, ClampedBody
from eitskin.simulator.bodies.pressed_body import (
    MOST_TOUCHES,
    BodyPress,
    PressedBody,
    require_above,
)
from eitskin.simulator.bodies.tetrahedral_solid import TetrahedralField, surface_of
from eitskin.simulator.deformation.press_table import indenter_samples
from eitskin.simulator.deformation.solution_store import Arrays, Problem, load_or_solve
from eitskin.simulator.mechanics import viscoelasticity as relaxation
from eitskin.simulator.mechanics.layer_stack import Mechanics
from eitskin.simulator.scene.scene import PressedTouch, Touch, neighbour_distance

# Version of the solutions: raise it whenever bodies are meshed or solved in another way.
_VERSION = 1
_MAX_KEPT = 16  # solutions in memory, each of some megabytes


@dataclass(frozen=True, slots=True)
class BodyTouch:
    """Touch of a body without history: position, indenter, and force [N] or depth [m]."""

    touch: Touch
    force: float | None
    depth: float | None


def bent_by(
    design: SensorDesign, fixture: Fixture, mechanics: Mechanics, bend: Bend
) -> Deformation:
    """Deformation of a body by a fixture; clamped bodies are solved in a minute or more.

    Raises:
        ConfigurationError: for a bend out of reach, or a clamp that bodies cannot have.
        SolidError: where the clamped body has no stable equilibrium at the angle.
    """
    if not isinstance(fixture, Clamp):
        return fixture.flexure(design, bend)
    if fixture.compliance or fixture.faces != "both":
        raise ConfigurationError(
            "the plates of a clamp hold a body from a surface rigidly and from both sides, got a "
            f"compliance of {fixture.compliance:g} m/Pa and faces = '{fixture.faces}'; leave both "
            "out"
        )
    span, offset, angle = fixture.span, fixture.offset, bend.angle_deg

    def solve() -> BentBody:
        (bent,) = _clamped(design, span, offset, mechanics).equilibria([angle])
        return bent

    field, _ = _loaded(_problem("bend", design, mechanics, [span, offset, angle], solve))
    return field


def pressed_body(
    design: SensorDesign, touches: tuple[BodyTouch, ...], mechanics: Mechanics
) -> PressedBody:
    """Body under touches; the first time takes a minute or more.

    Raises SolidError, with the fraction of the load that was carried, where no stable equilibrium
    is found.
    """

    def solve() -> PressedBody:
        press = BodyPress(design, [each.touch for each in touches], mechanics)
        return press.equilibrium([t.force for t in touches], [t.depth for t in touches])

    described = [
        [each.touch.x, each.touch.y, each.force, each.depth, indenter_samples(each.touch.indenter)]
        for each in touches
    ]
    field, numbers = _loaded(_problem("press", design, mechanics, described, solve))
    return PressedBody(field=field, **numbers)


@lru_cache(maxsize=2)
def _clamped(design: SensorDesign, span: float, offset: float, mechanics: Mechanics) -> ClampedBody:
    return ClampedBody(design, span, offset, mechanics)


def _problem(
    kind: str,
    design: SensorDesign,
    mechanics: Mechanics,
    loads: Sequence[Any],
    solve: Callable[[], BentBody | PressedBody],
) -> Problem:
    """Solution of a body under loads."""
    points, faces = surface_of(design).triangles()
    described = {
        "version": _VERSION,
        "kind": kind,
        "surface": hashlib.sha256(points.round(12).tobytes() + faces.tobytes()).hexdigest(),
        "gel": [type(mechanics.gel).__name__, *astuple(mechanics.gel)],
        "bulk_ratio": mechanics.bulk_ratio,
        "loads": loads,
    }

    def arrays(_: object) -> Arrays:
        solved = solve()
        numbers = {f.name: getattr(solved, f.name) for f in fields(solved) if f.name != "field"}
        of_field = {f"field {f.name}": getattr(solved.field, f.name) for f in fields(solved.field)}
        return {name: np.asarray(value) for name, value in (numbers | of_field).items()}

    return Problem("body", described, arrays)


@lru_cache(maxsize=_MAX_KEPT)
def _loaded(problem: Problem) -> tuple[TetrahedralField, dict[str, Any]]:
    """Field and numbers of a solution."""
    arrays = load_or_solve(problem)
    field = {f.name: arrays.pop(f"field {f.name}") for f in fields(TetrahedralField)}
    numbers = {name: a if a.ndim else float(a) for name, a in arrays.items()}
    return TetrahedralField(**field), numbers


def pressed_by(
    touches: tuple[Touch, ...], design: SensorDesign, mechanics: Mechanics
) -> PressedBody | None:
    """Body under the touches of a scene; None where all dents have faded.

    A body that creeps under a force has the shape of an elastic one under a greater force, as the
    slabs of `viscoelasticity` have; a fading dent is that of a smaller one.
    """
    felt = [one for one in _loads(touches, design, mechanics) if one.force is None or one.force > 0]
    return pressed_body(design, tuple(felt), mechanics) if felt else None


def pressed_body_touches(
    touches: tuple[Touch, ...], design: SensorDesign, mechanics: Mechanics
) -> tuple[PressedTouch, ...]:
    """Depth, contact and pressure of each touch on a body."""
    solved = pressed_by(touches, design, mechanics)
    felt = [one.force is None or one.force > 0 for one in _loads(touches, design, mechanics)]
    rows = iter(range(sum(felt)))
    return tuple(
        _result(touch, touches, mechanics, solved, next(rows) if there else None)
        for touch, there in zip(touches, felt, strict=True)
    )


def require_pressable(surface: Surface, touches: tuple[Touch, ...]) -> None:
    """Raise ConfigurationError for touches that a body cannot have."""
    if len(touches) > MOST_TOUCHES:
        raise ConfigurationError(
            f"a body is pressed by at most {MOST_TOUCHES} touches at once, got {len(touches)}"
        )
    for touch in touches:
        require_above(surface, touch)


def _loads(
    touches: tuple[Touch, ...], design: SensorDesign, mechanics: Mechanics
) -> list[BodyTouch]:
    """Elastic force, or depth, of each touch; forces of 0 where a dent has faded."""
    prony = mechanics.gel_relaxation
    plain = [replace(Touch(t.x, t.y), indenter=t.indenter) for t in touches]
    loads = []
    for touch, place in zip(touches, plain, strict=True):
        force: float | None = touch.force if touch.depth is None else None
        if touch.depth is None and touch.held is not None:
            force = relaxation.elastic_force(prony, touch.force, touch.held, touch.released)
        loads.append(BodyTouch(place, force, touch.depth))
    if not any(t.depth is not None and t.released for t in touches):
        return loads
    # A depth that was released leaves the dent of a force, which follows from the first moment.
    first = [
        BodyTouch(place, None if t.depth is not None else t.force, t.depth)
        for place, t in zip(plain, touches, strict=True)
    ]
    forces = pressed_body(design, tuple(first), mechanics).forces
    for k, touch in enumerate(touches):
        if touch.depth is not None and touch.released:
            held = touch.held or 0.0
            left = relaxation.elastic_force_at_depth(prony, float(forces[k]), held, touch.released)
            loads[k] = BodyTouch(plain[k], left, None)
    return loads


def _result(
    touch: Touch,
    touches: tuple[Touch, ...],
    mechanics: Mechanics,
    solved: PressedBody | None,
    row: int | None,
) -> PressedTouch:
    """Result of one touch, number `row` of the solution; none where its dent has faded."""
    force = depth = radius = peak = thinning = 0.0
    if solved is not None and row is not None:
        elastic = float(solved.forces[row])
        depth, thinning = float(solved.depths[row]), float(solved.thinnings[row])
        acting = elastic if touch.depth is not None else touch.force
        if touch.depth is not None and touch.held is not None:
            acting *= float(mechanics.gel_relaxation.relaxation(touch.held))
        if not touch.released:
            force = acting
            radius = math.sqrt(float(solved.contact_areas[row]) / math.pi)
            peak = float(solved.peak_pressures[row]) * force / elastic
    return PressedTouch(
        touch=touch,
        force=force,
        depth=depth,
        contact_radius=radius,
        peak_pressure=peak,
        thinning=thinning,
        edge_distance=math.inf,
        neighbour_distance=neighbour_distance(touch, touches),
        signal_error=None,
        caution="",
    )
