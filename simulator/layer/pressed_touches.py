"""Touches of a scene, pressed: their dents, depth, contact and pressure."""

import math
from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from eitskin.errors import ConfigurationError
from eitskin.geometry.deformation.kinematics import Deformation
from eitskin.geometry.design.outline import Polygon, Rectangle
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.geometry.design.surface import Surface
from eitskin.simulator.layer.bent_presses import BentPresses
from eitskin.simulator.layer.dents import ColumnField, Dents, PlacedDent
from eitskin.simulator.layer.depth_search import TOLERANCE, DepthSearch
from eitskin.simulator.mechanics import viscoelasticity as relaxation
from eitskin.simulator.mechanics.layer_stack import Mechanics
from eitskin.simulator.presses.contact_frame import BentState
from eitskin.simulator.presses.correction_store import (
    corrections,
    is_shipped,
    pair_corrections,
    tabulable,
)
from eitskin.simulator.presses.fields.edge_field import re_entrant_distance
from eitskin.simulator.presses.fields.smooth_field import SmoothField
from eitskin.simulator.presses.fields.spline_field import SplineField, spline_sum
from eitskin.simulator.presses.fields.turned_field import TurnedField
from eitskin.simulator.presses.press_store import press_table
from eitskin.simulator.presses.solved_press import (
    Press,
    SolvedField,
    contact_frame,
    solved_presses,
)
from eitskin.simulator.presses.tabulated_dent import TabulatedDent
from eitskin.simulator.scene.scene import Touch

Array = NDArray[np.float64]
TouchModel = Literal["tabulated", "solved"]

# Distances of the axis from the gel's edge and from another touch, below which signals are more
# than 4 % off independent solutions, or not compared with them (docs/deformation.md) [m].
_EDGE, _NEIGHBOUR = 0.005, 0.020
# Depth over the thickness of the stack, to which presses were compared.
_DEEP = 0.55
# Distance from a re-entrant corner, over the thickness of the stack, within which sums over sides
# leave more than 5 %.
_CORNER = 1.0
# Largest errors of the signal found beyond these distances, on a flat sensor, on a flat polygon
# and on a bent sensor.
_FLAT, _POLYGON, _BENT = 0.04, 0.05, 0.05
_THEN = (
    "pressed and bent, rolled or twisted then, which was not compared; a sensor on a support "
    "'plates' that its clamp bends, without roll and twist, is pressed as one problem"
)
_NODES, _FEWEST = 0.18, 12  # of splines for corrections, over the thickness of the stack
_MOST_SEARCHED = 10  # dents that are tried for touches to a given depth


@dataclass(frozen=True, slots=True)
class PressedTouch:
    """Depth, contact, pressure and expected error of one touch of a scene.

    Attributes:
        touch: of the scene.
        force: on the indenter now [N]; 0 after the release.
        depth: of the dent: position of the indenter's lowest point, now or before its release,
            below the undeformed top of the stack [m].
        contact_radius: of the contact area in the deformed stack [m]; 0 without contact.
        mean_pressure: force over contact area [Pa].
        peak_pressure: largest contact pressure [Pa].
        thinning: 1 - thickness over undeformed thickness of the gel, on the axis.
        edge_distance: from the axis to the nearest edge of the gel [m].
        neighbour_distance: from the axis to that of the nearest other touch [m].
        signal_error: largest error of the signal, relative, that comparisons with the full model
            found at such distances (docs/deformation.md); None at smaller distances or larger
            depths than any comparison, beside re-entrant corners, on other outlines than
            rectangles and polygons, and on a sensor that is bent, rolled or twisted after it is
            pressed.
        caution: why the dent is less exact than a single one in the middle of the sensor; empty
            otherwise.
    """

    touch: Touch
    force: float
    depth: float
    contact_radius: float
    mean_pressure: float
    peak_pressure: float
    thinning: float
    edge_distance: float
    neighbour_distance: float
    signal_error: float | None
    caution: str = ""

    @property
    def contact_area(self) -> float:
        """Area of the contact [m2]."""
        return math.pi * self.contact_radius**2


class _Pressed(NamedTuple):
    """Touch with its dent, None where it has faded, and the force on the indenter [N]."""

    touch: Touch
    dent: TabulatedDent | None
    force: float


class _World(NamedTuple):
    """All touches with their dents, corrections, and how much deeper each indenter sinks [m]."""

    pressed: tuple[_Pressed, ...]
    corrections: tuple[ColumnField, ...]
    sunk: tuple[float, ...]


def dents(
    touches: tuple[Touch, ...], design: SensorDesign, mechanics: Mechanics, model: TouchModel | None
) -> Dents:
    """Deformation of the gel by touches.

    Raises ConfigurationError for presses beyond the range of the model.
    """
    world = _world(touches, design, mechanics, model)
    placed = tuple(
        PlacedDent(one.touch.x, one.touch.y, one.dent)
        for one in world.pressed
        if one.dent is not None
    )
    return Dents(placed, world.corrections)


def bent_dents(
    touches: tuple[Touch, ...],
    design: SensorDesign,
    mechanics: Mechanics,
    model: TouchModel | None,
    bend: Deformation,
    bent: BentState,
) -> BentPresses:
    """Deformation of the gel by touches on a sensor in the state `bent`, its bend included.

    Raises ConfigurationError for presses beyond the range of the model.
    """
    world = _world(touches, design, mechanics, model, bent)
    stack = mechanics.stack(design)
    placed = tuple(
        (contact_frame(one.touch.x, one.touch.y, stack, bent), one.dent)
        for one in world.pressed
        if one.dent is not None
    )
    return BentPresses(bend, placed, Dents((), world.corrections))


def _world(
    touches: tuple[Touch, ...],
    design: SensorDesign,
    mechanics: Mechanics,
    model: TouchModel | None,
    bent: BentState | None = None,
) -> _World:
    """Dents of touches, and their corrections in the whole stack.

    Without a model, corrections are tabulated where a table comes with the package, else solved;
    no table is of a bent stack.
    """
    search = DepthSearch(touches, design)
    for _ in range(_MOST_SEARCHED):
        pressed = tuple(
            _Pressed(touch, *_dent(touch, float(depth), design, mechanics))
            for touch, depth in zip(touches, search.depths, strict=True)
        )
        found, sunk = _corrected(pressed, design, mechanics, model, bent)
        dents = [0.0 if one.dent is None else one.dent.depth for one in pressed]
        if search.advance(np.array(dents), np.array(sunk)):
            return _World(pressed, found, sunk)
    raise ConfigurationError(
        f"no dents take these indenters to their depths within {TOLERANCE:.1%}; press less deep, "
        "or prescribe forces"
    )


def _corrected(
    pressed: tuple[_Pressed, ...],
    design: SensorDesign,
    mechanics: Mechanics,
    model: TouchModel | None,
    bent: BentState | None,
) -> tuple[tuple[ColumnField, ...], tuple[float, ...]]:
    """Corrections of dents, and how much deeper each indenter sinks [m]."""
    felt = [(k, one.touch, one.dent) for k, one in enumerate(pressed) if one.dent is not None]
    sunk = [0.0] * len(pressed)
    fields: list[ColumnField] = []
    way = way_of(tuple(touch for _, touch, _ in felt), design, mechanics, model)
    if felt and way == "tabulated":
        for k, touch, dent in felt:
            found, sunk[k] = corrections(design, mechanics, touch.indenter).at(
                touch.x, touch.y, dent.depth
            )
            fields += found
        for (k, one, dent), (j, other, beside) in combinations(felt, 2):
            changes, deeper = _pair((one, dent.depth), (other, beside.depth), design, mechanics)
            fields += changes
            sunk[k] += deeper
            sunk[j] += deeper
        fields = _summed(fields, design)
    elif felt:
        presses = tuple(_press(t, dent) for _, t, dent in felt)
        solved = solved_presses(design, mechanics, presses, bent)
        fields.append(SolvedField(solved))
        for (k, *_), below in zip(felt, solved.sunk.tolist(), strict=True):
            sunk[k] = below
    return tuple(fields), tuple(sunk)


def _summed(fields: list[ColumnField], design: SensorDesign) -> list[ColumnField]:
    """Fields of the same sum, those in the sensor's own frame as one field of splines."""
    own = [field for field in fields if isinstance(field, SmoothField | SplineField)]
    others = [field for field in fields if not isinstance(field, SmoothField | SplineField)]
    return [*others, spline_sum(own, _nodes(design))] if own else others


def require_model(
    touches: tuple[Touch, ...], design: SensorDesign, model: TouchModel | None
) -> None:
    """Raise ConfigurationError for tables of touches whose corrections cannot be tabulated."""
    if touches and model == "tabulated" and not tabulable(design):
        outline = type(design.outline).__name__.lower()
        raise ConfigurationError(
            "presses are tabulated on plane outlines of at least twice the thickness of their "
            f"stack, on the support 'rigid' or a substrate, got a {outline} on {design.support}; "
            "leave the touch model out, or let it be 'solved'"
        )


def way_of(
    touches: tuple[Touch, ...], design: SensorDesign, mechanics: Mechanics, model: TouchModel | None
) -> TouchModel:
    """Way to the corrections of touches: the model, or what ships."""
    if model is not None:
        return model
    pairs = len(touches) > 1
    known = tabulable(design) and all(
        is_shipped(design, mechanics, t.indenter, pairs=pairs) for t in touches
    )
    return "tabulated" if known else "solved"


def _press(touch: Touch, dent: TabulatedDent) -> Press:
    return Press(touch.x, touch.y, dent.depth, touch.indenter)


def _pair(
    one: tuple[Touch, float], other: tuple[Touch, float], design: SensorDesign, mechanics: Mechanics
) -> tuple[tuple[TurnedField | SmoothField, ...], float]:
    """Change of two dents by each other, and by how much deeper each sinks [m].

    Touches with their depths [m]. Between different indenters it is the change by those of the
    smaller one's kind.
    """
    (a, deep), (b, beside) = one, other
    indenter = min(a.indenter, b.indenter, key=lambda each: each.rims[1])
    pairs = pair_corrections(design, mechanics, indenter)
    return pairs.at((a.x, a.y, deep), (b.x, b.y, beside))


def pressed_touches(
    touches: tuple[Touch, ...],
    design: SensorDesign,
    mechanics: Mechanics,
    model: TouchModel | None,
    bent: BentState | None = None,
    bent_then: bool = False,
) -> tuple[PressedTouch, ...]:
    """Depth, contact and pressure of each touch, on a flat sensor or one in the state `bent`.

    `bent_then` says that the pressed sensor is bent, rolled or twisted afterwards.
    """
    world = _world(touches, design, mechanics, model, bent)
    flat = _POLYGON if isinstance(design.outline, Polygon) else _FLAT
    error = None if bent_then else flat if bent is None else _BENT
    known = [_THEN] * bent_then
    return tuple(
        _described(one, below, touches, design, error, known)
        for one, below in zip(world.pressed, world.sunk, strict=True)
    )


@lru_cache(maxsize=64)
def _nodes(design: SensorDesign) -> tuple[Array, Array]:
    """Nodes of splines for corrections along x and y [m], denser towards the long sides."""
    size, outline = _NODES * design.encapsulated_thickness, design.outline
    along, across = (
        max(_FEWEST, math.ceil(extent / size)) for extent in (outline.length, outline.width)
    )
    turned = 0.5 * (1.0 - np.cos(np.linspace(0.0, math.pi, across + 1)))
    return np.linspace(0.0, outline.length, along + 1), outline.width * turned


def _described(
    one: _Pressed,
    sunk: float,
    touches: tuple[Touch, ...],
    design: SensorDesign,
    error: float | None,
    known: list[str],
) -> PressedTouch:
    """Result of one touch.

    `error` is that found where presses were compared, None for none; `known` are cautions that
    hold for all touches of the scene.
    """
    touch, dent, force = one
    neighbour = min(
        (math.dist((touch.x, touch.y), (t.x, t.y)) for t in touches if t is not touch),
        default=math.inf,
    )
    # Without contact there is a dent, but no pressure.
    radius = dent.contact_radius if dent is not None and force > 0.0 else 0.0
    edge = _edge_distance(touch, design)
    depth = dent.depth + sunk if dent is not None else 0.0
    cautions = _cautions(touch, edge, neighbour, depth, design) + known
    return PressedTouch(
        touch=touch,
        force=force,
        depth=depth,
        contact_radius=radius,
        mean_pressure=force / (math.pi * radius**2) if radius else 0.0,
        peak_pressure=dent.peak_pressure * force / dent.force if dent is not None else 0.0,
        thinning=dent.thinning if dent is not None else 0.0,
        edge_distance=edge,
        neighbour_distance=neighbour,
        signal_error=None if cautions else error,
        caution="; ".join(cautions),
    )


def _dent(
    touch: Touch, depth: float, design: SensorDesign, mechanics: Mechanics
) -> tuple[TabulatedDent | None, float]:
    """Dent of a touch, None where it has faded, and the force on the indenter [N].

    `depth` is that of the first moment's dent [m] where a depth is prescribed.
    """
    table = press_table(design, mechanics, touch.indenter)
    first = table.at_force(touch.force) if touch.depth is None else table.at_depth(depth)
    if touch.held is None:
        return first, first.force
    prony = relaxation.mixture(
        (mechanics.gel_relaxation, mechanics.encapsulation_relaxation),
        (first.share, 1.0 - first.share),
    )
    if touch.depth is None:
        elastic = relaxation.elastic_force(prony, touch.force, touch.held, touch.released)
        acting = touch.force
    else:
        elastic = relaxation.elastic_force_at_depth(prony, first.force, touch.held, touch.released)
        acting = first.force * float(prony.relaxation(touch.held))
    dent = table.at_force(elastic) if elastic > 0.0 else None
    return dent, 0.0 if touch.released else acting


def _edge_distance(touch: Touch, design: SensorDesign) -> float:
    outline = design.outline
    if isinstance(outline, Surface):
        return math.inf
    _, depth = outline.nearest(np.array([touch.x, touch.y]))
    return float(depth)


def _cautions(
    touch: Touch, edge: float, neighbour: float, depth: float, design: SensorDesign
) -> list[str]:
    """Reasons why such a press was not compared with independent solutions."""
    reasons = []
    outline, thickness = design.outline, design.encapsulated_thickness
    if not isinstance(outline, Rectangle | Polygon):
        reasons.append("presses on this outline were not compared")
    elif re_entrant_distance(outline, touch.x, touch.y) < _CORNER * thickness:
        reasons.append("beside a re-entrant corner, where nothing was compared")
    if edge < _EDGE:
        reasons.append(f"{1e3 * edge:.1f} mm from the edge of the gel, where nothing was compared")
    if neighbour < _NEIGHBOUR:
        reasons.append(f"{1e3 * neighbour:.1f} mm from another, where nothing was compared")
    if depth > _DEEP * thickness:
        reasons.append(f"{1e3 * depth:.1f} mm deep, where nothing was compared")
    return reasons
