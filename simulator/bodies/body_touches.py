"""Touches of a scene on a body: loads with their history, and results of each touch."""

import math
from dataclasses import replace

from eitskin.errors import ConfigurationError
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.geometry.design.surface import Surface
from eitskin.simulator.bodies.body_store import BodyTouch, pressed_body
from eitskin.simulator.bodies.pressed_body import MOST_TOUCHES, PressedBody
from eitskin.simulator.bodies.upper_side import require_above
from eitskin.simulator.layer.pressed_touches import PressedTouch
from eitskin.simulator.mechanics import viscoelasticity as relaxation
from eitskin.simulator.mechanics.layer_stack import Mechanics
from eitskin.simulator.scene.scene import Touch


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
    neighbour = min(
        (math.dist((touch.x, touch.y), (t.x, t.y)) for t in touches if t is not touch),
        default=math.inf,
    )
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
        mean_pressure=force / (math.pi * radius**2) if radius else 0.0,
        peak_pressure=peak,
        thinning=thinning,
        edge_distance=math.inf,
        neighbour_distance=neighbour,
        signal_error=None,
        caution="",
    )
