"""Touches of a scene: their dents, depth, contact and pressure."""

import math
from collections.abc import Iterable
from functools import lru_cache
from itertools import combinations
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from eitskin.errors import ConfigurationError
from eitskin.geometry.deformation.kinematics import Deformation
from eitskin.geometry.design.outline import Polygon, Rectangle
from eitskin.geometry.design.sensor import Free, Plates, SensorDesign
from eitskin.geometry.design.surface import Surface
from eitskin.simulator.deformation.contact import BentState, ContactFrame
from eitskin.simulator.deformation.corrections import (
    correction_problems,
    corrections,
    is_tabulable,
    pair_corrections,
)
from eitskin.simulator.deformation.dents import BentPresses, ColumnField, Dents, PlacedDent
from eitskin.simulator.deformation.field import Field, resampled_sum
from eitskin.simulator.deformation.finite_stack import solved_presses
from eitskin.simulator.deformation.outline_sides import re_entrant_distance
from eitskin.simulator.deformation.press_table import TabulatedDent, press_table
from eitskin.simulator.deformation.sensor_grid import OWN_GRID, SensorGrid
from eitskin.simulator.mechanics import viscoelasticity as relaxation
from eitskin.simulator.mechanics.layer_stack import Mechanics
from eitskin.simulator.scene.indenters import Cylinder
from eitskin.simulator.scene.scene import AnyIndenter, PressedTouch, Touch, neighbour_distance

Array = NDArray[np.float64]
TouchModel = Literal["tabulated", "solved"]

# Distances of the axis from the gel's edge and from another touch, below which signals are more
# than 4 % off independent solutions, or not compared with them (docs/deformation.md) [m].
_MIN_EDGE_DISTANCE, _MIN_TOUCH_SPACING = 0.005, 0.020
# Depth over the thickness of the stack, to which presses were compared.
_MAX_RELATIVE_DEPTH = 0.55
# Distance from a re-entrant corner, over the thickness of the stack, within which sums over sides
# leave more than 5 %.
_MIN_CORNER_DISTANCE = 1.0
# Largest errors of the signal found beyond these distances, on a flat sensor, on a flat polygon
# and on a bent sensor.
_FLAT, _POLYGON, _BENT = 0.04, 0.05, 0.05
_NOT_VALIDATED_AFTER_BEND = (
    "pressed and bent, rolled or twisted then, which was not compared; a sensor on a support "
    "'plates' that its clamp bends, without roll and twist, is pressed as one problem"
)
_NODES, _FEWEST = 0.18, 12  # of splines for corrections, over the thickness of the stack

# Search for dents to given depths: most dents tried, error of the depths, first dent where the base
# gives way over the thickness of the stack, largest step, and least sinking over a dent's depth.
_MOST_SEARCHED, _TOLERANCE, _SHALLOW = 10, 1e-3, 0.1
_LARGEST_STEP, _LEAST_SUNK = math.log(4.0), -0.9


class PressedSensor(NamedTuple):
    """Sensor that is touched.

    Attributes:
        design: of the sensor, with its support.
        mechanics: materials.
        model: way to the corrections of dents; None chooses.
        grid: nominal values about which tables are solved.
    """

    design: SensorDesign
    mechanics: Mechanics
    model: TouchModel | None = None
    grid: SensorGrid = OWN_GRID


class _DentedTouch(NamedTuple):
    """Touch with its dent, None where it has faded.

    Attributes:
        force: on the indenter [N].
        sunk: by which the indenter sinks deeper than the dent [m].
    """

    touch: Touch
    dent: TabulatedDent | None
    force: float
    sunk: float = 0.0


def dents(touches: tuple[Touch, ...], sensor: PressedSensor) -> Dents:
    """Deformation of the gel by touches.

    Raises ConfigurationError for presses beyond the range of the model.
    """
    dented, fields = _solve_dents(touches, sensor)
    placed = [PlacedDent(t.x, t.y, dent) for t, dent, *_ in dented if dent is not None]
    return Dents(tuple(placed), tuple(fields))


def sketched_dents(touches: Iterable[Touch], design: SensorDesign) -> Dents:
    """Superposed dents of the 15 mm cylinder on the reference sensor, stretched to a design.

    A sketch for drawings, of which nothing has to be solved; greater forces than those solved
    count as the largest.
    """
    table = press_table(SensorDesign.reference(), Mechanics(), Cylinder())
    table = table.stretched(design.thickness / float(table.thickness))
    most = table.largest_force
    return Dents(tuple(PlacedDent(t.x, t.y, table.at_force(min(t.force, most))) for t in touches))


def bent_dents(
    touches: tuple[Touch, ...], sensor: PressedSensor, bend: Deformation, bent: BentState
) -> BentPresses:
    """Deformation of the gel by touches on a sensor in the state `bent`, its bend included.

    Raises ConfigurationError for presses beyond the range of the model.
    """
    dented, fields = _solve_dents(touches, sensor, bent)
    stack = sensor.mechanics.stack(sensor.design)
    placed = [
        (ContactFrame.at(bent, t.x, t.y, stack), dent) for t, dent, *_ in dented if dent is not None
    ]
    return BentPresses(bend, tuple(placed), Dents((), tuple(fields)))


def _solve_dents(
    touches: tuple[Touch, ...], sensor: PressedSensor, bent: BentState | None = None
) -> tuple[list[_DentedTouch], list[ColumnField]]:
    """Dents of touches, and their corrections in the whole stack."""
    search = DepthSearch(touches, sensor.design)
    for _ in range(_MOST_SEARCHED):
        dented = [
            _DentedTouch(touch, *_dent(touch, float(depth), sensor))
            for touch, depth in zip(touches, search.depths, strict=True)
        ]
        fields, sunk = _corrections(dented, sensor, bent)
        depths = [0.0 if one.dent is None else one.dent.depth for one in dented]
        if search.advance(np.array(depths), np.array(sunk)):
            found = zip(dented, sunk, strict=True)
            return [one._replace(sunk=below) for one, below in found], fields
    raise ConfigurationError(
        f"no dents take these indenters to their depths within {_TOLERANCE:.1%}; press less deep, "
        "or prescribe forces"
    )


def _corrections(
    dented: list[_DentedTouch], sensor: PressedSensor, bent: BentState | None
) -> tuple[list[ColumnField], list[float]]:
    """Corrections of dents, and how much deeper each indenter sinks [m].

    No table is of a bent stack.
    """
    acting = [(k, one.touch, one.dent) for k, one in enumerate(dented) if one.dent is not None]
    extra = [0.0] * len(dented)
    design, mechanics, _, grid = sensor
    if not acting:
        return [], extra
    if resolve_touch_model(tuple(touch for _, touch, _ in acting), sensor) == "solved":
        presses = tuple(
            Touch(t.x, t.y, indenter=t.indenter, depth=dent.depth) for _, t, dent in acting
        )
        solved = solved_presses(design, mechanics, presses, bent)
        for (k, *_), below in zip(acting, solved.sunk.tolist(), strict=True):
            extra[k] = below
        return [solved], extra
    fields: list[Field] = []
    for k, touch, dent in acting:
        table = corrections(design, mechanics, touch.indenter, grid)
        added, extra[k] = table.at(touch.x, touch.y, dent.depth)
        fields += added
    for (k, one, dent), (j, other, beside) in combinations(acting, 2):
        # Between different indenters the change is that by those of the smaller one's kind.
        indenter = min(one.indenter, other.indenter, key=lambda each: each.rims[1])
        pairs = pair_corrections(design, mechanics, indenter, grid)
        added, deeper = pairs.at((one.x, one.y, dent.depth), (other.x, other.y, beside.depth))
        fields += added
        extra[k] += deeper
        extra[j] += deeper
    own = [field for field in fields if field.frame is None]
    others: list[ColumnField] = [field for field in fields if field.frame is not None]
    return [*others, *([resampled_sum(own, _nodes(design))] if own else [])], extra


def require_model(touches: tuple[Touch, ...], sensor: PressedSensor) -> None:
    """Raise ConfigurationError for tables of touches whose corrections cannot be tabulated."""
    if touches and sensor.model == "tabulated" and not is_tabulable(sensor.design):
        outline = type(sensor.design.outline).__name__.lower()
        raise ConfigurationError(
            "presses are tabulated on plane outlines of at least twice the thickness of their "
            f"stack, on the support 'rigid' or a substrate, got a {outline} on "
            f"{sensor.design.support}; leave the touch model out, or let it be 'solved'"
        )


def resolve_touch_model(touches: tuple[Touch, ...], sensor: PressedSensor) -> TouchModel:
    """Way to the corrections of touches: the model, or by tables where all of them ship."""
    if sensor.model is not None:
        return sensor.model
    pairs = len(touches) > 1
    shipped = [
        corrections_ship(sensor, indenter, pairs) for indenter in {t.indenter for t in touches}
    ]
    return "tabulated" if all(shipped) else "solved"


def corrections_ship(sensor: PressedSensor, indenter: AnyIndenter, pairs: bool) -> bool:
    """Whether all tables of corrections come with the package, those of pairs if wanted."""
    design, mechanics, _, grid = sensor
    problems = correction_problems(design, mechanics, indenter, grid, pairs)
    return bool(problems) and all(problem.is_shipped for problem in problems)


def pressed_touches(
    touches: tuple[Touch, ...],
    sensor: PressedSensor,
    bent: BentState | None = None,
    bent_after: bool = False,
) -> tuple[PressedTouch, ...]:
    """Depth, contact and pressure of each touch, on a flat sensor or one in the state `bent`.

    `bent_after` says that the pressed sensor is bent, rolled or twisted afterwards.
    """
    design, outline = sensor.design, sensor.design.outline
    flat = _POLYGON if isinstance(outline, Polygon) else _FLAT
    error = None if bent_after else flat if bent is None else _BENT
    found = []
    for touch, dent, force, sunk in _solve_dents(touches, sensor, bent)[0]:
        edge = float(outline.nearest(np.array([touch.x, touch.y]))[1])
        neighbour = neighbour_distance(touch, touches)
        depth = dent.depth + sunk if dent is not None else 0.0
        cautions = _cautions(touch, edge, neighbour, depth, design)
        cautions += [_NOT_VALIDATED_AFTER_BEND] * bent_after
        pressed = PressedTouch(
            touch=touch,
            force=force,
            depth=depth,
            # Without contact there is a dent, but no pressure.
            contact_radius=dent.contact_radius if dent is not None and force > 0.0 else 0.0,
            peak_pressure=dent.peak_pressure * force / dent.force if dent is not None else 0.0,
            thinning=dent.thinning if dent is not None else 0.0,
            edge_distance=edge,
            neighbour_distance=neighbour,
            signal_error=None if cautions else error,
            caution="; ".join(cautions),
        )
        found.append(pressed)
    return tuple(found)


@lru_cache(maxsize=64)
def _nodes(design: SensorDesign) -> tuple[Array, Array]:
    """Nodes of splines for corrections along x and y [m], denser towards the long sides."""
    size, outline = _NODES * design.encapsulated_thickness, design.outline
    along, across = (
        max(_FEWEST, math.ceil(extent / size)) for extent in (outline.length, outline.width)
    )
    turned = 0.5 * (1.0 - np.cos(np.linspace(0.0, math.pi, across + 1)))
    return np.linspace(0.0, outline.length, along + 1), outline.width * turned


def _dent(touch: Touch, depth: float, sensor: PressedSensor) -> tuple[TabulatedDent | None, float]:
    """Dent of a touch, None where it has faded, and the force on the indenter [N].

    `depth` is that of the first moment's dent [m] where a depth is prescribed.
    """
    mechanics = sensor.mechanics
    table = press_table(sensor.design, mechanics, touch.indenter, sensor.grid)
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


def _cautions(
    touch: Touch, edge: float, neighbour: float, depth: float, design: SensorDesign
) -> list[str]:
    """Reasons why such a press was not compared with independent solutions."""
    reasons = []
    outline, thickness = design.outline, design.encapsulated_thickness
    if not isinstance(outline, Rectangle | Polygon):
        reasons.append("presses on this outline were not compared")
    elif re_entrant_distance(outline, touch.x, touch.y) < _MIN_CORNER_DISTANCE * thickness:
        reasons.append("beside a re-entrant corner, where nothing was compared")
    if edge < _MIN_EDGE_DISTANCE:
        reasons.append(f"{1e3 * edge:.1f} mm from the edge of the gel, where nothing was compared")
    if neighbour < _MIN_TOUCH_SPACING:
        reasons.append(f"{1e3 * neighbour:.1f} mm from another, where nothing was compared")
    if depth > _MAX_RELATIVE_DEPTH * thickness:
        reasons.append(f"{1e3 * depth:.1f} mm deep, where nothing was compared")
    return reasons


class DepthSearch:
    """Search for dents whose depths, with what the finite stack sinks, are the prescribed ones.

    Broyden's method (Broyden 1965) for the logarithms of the depths, since dents and sinking grow
    nearly in proportion; for one touch it is the secant method. Over a gap the stack sinks much
    more than a dent is deep, so that a fixed-point iteration would not converge.

    Attributes:
        depths: of the dents in the unbounded stack to try next [m]; NaN for prescribed forces.
    """

    def __init__(self, touches: tuple[Touch, ...], design: SensorDesign) -> None:
        wanted = [math.nan if touch.depth is None else touch.depth for touch in touches]
        self._wanted = np.array(wanted)
        self.depths = np.array(
            [
                min(depth, _SHALLOW * design.encapsulated_thickness)
                if _gives_way(touch, design)
                else depth
                for touch, depth in zip(touches, wanted, strict=True)
            ]
        )
        self._given = np.isfinite(self.depths)
        self._jacobian = np.eye(int(self._given.sum()))
        self._last: tuple[Array, Array] | None = None

    def advance(self, dents: Array, sunk: Array) -> bool:
        """Whether the wanted depths are met; otherwise `depths` are those to try next.

        Args:
            dents: present depths of the dents, which may have faded since their release [m].
            sunk: by which each indenter now sinks deeper than its dent [m].
        """
        part = np.divide(sunk, dents, out=np.zeros(len(dents)), where=dents > 0.0)[self._given]
        tried = np.log(self.depths[self._given])
        reached = tried + np.log1p(np.maximum(part, _LEAST_SUNK))
        error = reached - np.log(self._wanted[self._given])
        if np.all(np.abs(error) < _TOLERANCE):
            return True
        if self._last is not None:
            step, change = tried - self._last[0], error - self._last[1]
            self._jacobian += np.outer(change - self._jacobian @ step, step) / (step @ step)
        self._last = tried, error
        step = -np.linalg.lstsq(self._jacobian, error)[0]
        step *= min(1.0, _LARGEST_STEP / np.abs(step).max())
        self.depths[self._given] = np.exp(tried + step)
        return False


def _gives_way(touch: Touch, design: SensorDesign) -> bool:
    """Whether the base under a touch is free, so that the stack may sink more than it is dented."""
    if isinstance(design.support, Free):
        return True
    if not isinstance(design.support, Plates) or isinstance(design.outline, Surface):
        return False
    start, end = design.support.gap(design.outline)
    beside = design.encapsulated_thickness
    return start - beside < touch.x < end + beside
