"""Bends and touches of a body from a surface file: solved once, kept in the store."""

import hashlib
import math
from collections.abc import Callable, Sequence
from dataclasses import astuple, fields, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eitskin.errors import ConfigurationError
from eitskin.geometry.deformation.fixtures import Bend, Clamp, Fixture
from eitskin.geometry.deformation.kinematics import Deformation
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.geometry.design.surface import Surface
from eitskin.simulator.bodies.clamped_body import ClampedBody
from eitskin.simulator.bodies.pressed_body import (
    MAX_TOUCHES,
    BodyPress,
    PressedBody,
    require_over_body,
)
from eitskin.simulator.bodies.tetrahedral_solid import TetrahedralField, require_surface
from eitskin.simulator.deformation.press_table import indenter_samples
from eitskin.simulator.deformation.solution_store import Arrays, Problem, load_or_solve
from eitskin.simulator.mechanics import viscoelasticity as relaxation
from eitskin.simulator.mechanics.layer_stack import Mechanics
from eitskin.simulator.scene.indenters import Footprint
from eitskin.simulator.scene.scene import PressedTouch, Touch, neighbour_distance

# Version of the solutions: raise it whenever bodies are meshed or solved in another way.
_VERSION = 2
_MAX_KEPT = 16  # solutions in memory, each of some megabytes


def solve_bend(
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

    def solve() -> Arrays:
        return _field_arrays(_clamped_body(design, span, offset, mechanics).solve_angle(angle))

    field, _ = _load_solution(_problem("bend", design, mechanics, [span, offset, angle], solve))
    return field


def pressed_body(
    design: SensorDesign, touches: tuple[Touch, ...], mechanics: Mechanics
) -> PressedBody:
    """Body under touches without history; the first time takes a minute or more.

    Raises SolidError, with the fraction of the load that was carried, where no stable equilibrium
    is found.
    """

    def solve() -> Arrays:
        solved = BodyPress(design, touches, mechanics).equilibrium()
        numbers = {f.name: getattr(solved, f.name) for f in fields(solved) if f.name != "field"}
        return numbers | _field_arrays(solved.field)

    described = [
        [t.x, t.y, t.force if t.depth is None else None, t.depth, indenter_samples(t.indenter)]
        for t in touches
    ]
    field, numbers = _load_solution(_problem("press", design, mechanics, described, solve))
    return PressedBody(field=field, **numbers)


@lru_cache(maxsize=2)
def _clamped_body(
    design: SensorDesign, span: float, offset: float, mechanics: Mechanics
) -> ClampedBody:
    return ClampedBody(design, span, offset, mechanics)


def _problem(
    kind: str,
    design: SensorDesign,
    mechanics: Mechanics,
    loads: Sequence[Any],
    solve: Callable[[], Arrays],
) -> Problem:
    """Solution of a body under loads."""
    points, faces = require_surface(design).triangles()
    described = {
        "version": _VERSION,
        "kind": kind,
        "surface": hashlib.sha256(points.round(12).tobytes() + faces.tobytes()).hexdigest(),
        "gel": [type(mechanics.gel).__name__, *astuple(mechanics.gel)],
        "bulk_ratio": mechanics.bulk_ratio,
        "loads": loads,
    }

    return Problem("body", described, lambda _: solve())


def _field_arrays(field: TetrahedralField) -> Arrays:
    return {f"field {f.name}": getattr(field, f.name) for f in fields(field)}


@lru_cache(maxsize=_MAX_KEPT)
def _load_solution(problem: Problem) -> tuple[TetrahedralField, Arrays]:
    """Field and numbers of a solution."""
    arrays = load_or_solve(problem, dict)
    field = {f.name: arrays.pop(f"field {f.name}") for f in fields(TetrahedralField)}
    return TetrahedralField(**field), arrays


def solve_presses(
    touches: tuple[Touch, ...], design: SensorDesign, mechanics: Mechanics
) -> PressedBody | None:
    """Body under the touches of a scene; None where all dents have faded.

    A body that creeps under a force has the shape of an elastic one under a greater force, as the
    slabs of `viscoelasticity` have; a fading dent is that of a smaller one.
    """
    felt = tuple(touch for touch in _elastic(touches, design, mechanics) if touch is not None)
    return pressed_body(design, felt, mechanics) if felt else None


def pressed_body_touches(
    touches: tuple[Touch, ...], design: SensorDesign, mechanics: Mechanics
) -> tuple[PressedTouch, ...]:
    """Depth, contact and pressure of each touch on a body."""
    solved = solve_presses(touches, design, mechanics)
    felt = [touch is not None for touch in _elastic(touches, design, mechanics)]
    rows = iter(range(sum(felt)))
    return tuple(
        _result(touch, touches, mechanics, solved, next(rows) if there else None)
        for touch, there in zip(touches, felt, strict=True)
    )


def require_pressable(surface: Surface, touches: tuple[Touch, ...]) -> None:
    """Raise ConfigurationError for touches that a body cannot have."""
    if len(touches) > MAX_TOUCHES:
        raise ConfigurationError(
            f"a body is pressed by at most {MAX_TOUCHES} touches at once, got {len(touches)}"
        )
    for touch in touches:
        require_over_body(surface, touch)
        if isinstance(touch.indenter, Footprint):
            raise ConfigurationError(
                "a body from a surface file is pressed by bodies of revolution, got a footprint; "
                "give a cylinder, sphere or profile"
            )


def _elastic(
    touches: tuple[Touch, ...], design: SensorDesign, mechanics: Mechanics
) -> list[Touch | None]:
    """Touches without history that leave the dents of the given ones; None for faded dents."""
    prony = mechanics.gel_relaxation
    first = [replace(touch, held=None, released=0.0, before=()) for touch in touches]
    pushed: NDArray[np.float64] | None = None  # forces at the first moment
    found: list[Touch | None] = []
    for k, (touch, one) in enumerate(zip(touches, first, strict=True)):
        force = touch.force
        if touch.depth is not None and touch.released:
            # A depth that was released leaves the dent of a force, after the first moment's.
            if pushed is None:
                pushed = pressed_body(design, tuple(first), mechanics).forces
            lasted = touch.held or 0.0, touch.released
            force = relaxation.elastic_force_at_depth(prony, float(pushed[k]), *lasted)
        elif touch.depth is None and touch.held is not None:
            loads = (touch.force, touch.held, touch.released), *touch.before
            force = sum(relaxation.elastic_force(prony, *load) for load in loads)
        if touch.depth is not None and not touch.released:
            found.append(one)
        else:
            left = force > relaxation.FADED * touch.force
            found.append(replace(one, depth=None, force=force) if left else None)
    return found


def _result(
    touch: Touch,
    touches: tuple[Touch, ...],
    mechanics: Mechanics,
    pressed_body: PressedBody | None,
    row: int | None,
) -> PressedTouch:
    """Result of one touch, number `row` of the solution; none where its dent has faded."""
    force = depth = radius = peak = thinning = 0.0
    if pressed_body is not None and row is not None:
        elastic = float(pressed_body.forces[row])
        depth, thinning = float(pressed_body.depths[row]), float(pressed_body.thinnings[row])
        acting = elastic if touch.depth is not None else touch.force
        if touch.depth is not None and touch.held is not None:
            acting *= float(mechanics.gel_relaxation.relaxation(touch.held))
        if not touch.released:
            force = acting
            radius = math.sqrt(float(pressed_body.contact_areas[row]) / math.pi)
            peak = float(pressed_body.peak_pressures[row]) * force / elastic
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
        caution="touches press the bare body of a surface file, without its encapsulation, with an "
        "unmeasured error",
    )
