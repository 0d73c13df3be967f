"""Presses that were compared with other solutions: errors of their signals, and cautions."""

import math

from eitskin.errors import ConfigurationError
from eitskin.geometry.design.outline import Polygon, Rectangle
from eitskin.geometry.design.sensor import Plates, SensorDesign
from eitskin.simulator.deformation.outline_sides import corner_distance
from eitskin.simulator.deformation.tabled_corrections import has_strip
from eitskin.simulator.mechanics.layer_stack import Mechanics
from eitskin.simulator.scene.indenters import Footprint
from eitskin.simulator.scene.scene import AnyIndenter, Touch

# Least compared distances of the axis from the gel's edge and from another touch [m].
_MIN_EDGE_DISTANCE, _MIN_TOUCH_SPACING = 0.0035, 0.020
_MAX_RELATIVE_DEPTH = 0.55  # over the stack's thickness, to which presses were compared
# Ratios of cover to gel, in thickness and in shear modulus, and radii of indenters [m] to which
# presses were compared. On a cover of 0.3 mm they are 5 % off a finer solution.
_MIN_COVER, _MODULI, _MIN_RADIUS = 1.0 / 3.0, (1.0 / 3.0, 3.0), 0.003
# Thickness and modulus of a cover over the gel's from which presses are 11 % off a finer solution.
_MEMBRANE = (0.1, 50.0)
_ALIKE = 1e-6  # relative difference of values that count as equal
# Extent over the width of a footprint: one of 2.7 came 6 % deeper turned by 30 degrees.
_MAX_SLENDERNESS = 1.5
# Distance from a re-entrant corner over the stack's thickness, within which sums leave over 7 %.
_MIN_CORNER_DISTANCE = 2.0
# Errors of the signal beyond these distances, with 0.7 % of the mesh of "fast". On a flat sensor 95
# of 100 are below 3.1 % (32 in `bench world`), by sides of a polygon below 4.6 % of the tables of a
# like rectangle (41; on an L once 7.4 %). Few were compared on plates (6, 2.2 % at most) and over
# their gap (3, 5.1 %; 12 between places of the table, with 3D solutions: 5.5 %).
_FLAT, _POLYGON, _ON_PLATES, _OVER_GAP, _BENT_AFTER = 0.04, 0.08, 0.05, 0.10, 0.15
# Touches over the gap that are shallower than this part of the deepest dent: 17 % at 0.4 N.
_SHALLOW, _SHALLOW_OVER_GAP = 0.2, 0.2
# The same beside a side, and in a corner nearer to its vertex than so many radii of the indenter:
# of 8 compared the tables are 7.4 % off a solution in one corner, and at most 4.7 % elsewhere.
_AT_EDGE, _SIDE_DISTANCE, _CORNER_RADII = 0.08, 0.005, 1.8
NOT_VALIDATED_AFTER_BEND = (
    "bent, rolled or twisted after the touch, with an unmeasured error; with the support "
    "'plates' and a clamp, without roll and twist, touch and bend are solved together"
)


def require_compared(
    touches: tuple[Touch, ...], design: SensorDesign, mechanics: Mechanics
) -> None:
    """Raise ConfigurationError for touches that are like none compared.

    Those are touches of which neither cover nor moduli nor indenter is like any compared, and
    those on a cover that is thin and much stiffer than the gel.
    """
    cover = 0.5 * (design.encapsulated_thickness / design.thickness - 1.0)
    stiffness = mechanics.encapsulation.shear_modulus / mechanics.gel.shear_modulus
    is_membrane = 0.0 < cover < _MEMBRANE[0] and stiffness > _MEMBRANE[1]
    for touch in touches:
        reasons = uncompared_properties(touch.indenter, design, mechanics)
        if is_membrane or len(reasons) > 2:  # beyond all three properties at once
            raise ConfigurationError(
                f"no press was ever compared that is like this one: {'; '.join(reasons)}. Bring "
                "one of these within what was compared"
            )


def signal_error(
    touch: Touch, edge: float, design: SensorDesign, part: float, bent_after: bool
) -> float:
    """Error of the signal of 95 of 100 such touches, relative to it.

    Args:
        touch: the touch.
        edge: distance of its axis from the gel's edge [m].
        design: design of the sensor.
        part: depth of its dent over the deepest in the table of the plates, if any.
        bent_after: whether the pressed sensor is bent, rolled or twisted afterwards.
    """
    error = _FLAT if has_strip(design) else _POLYGON
    if bent_after:
        error = _BENT_AFTER
    elif isinstance(design.support, Plates):
        start, end = design.support.gap(design.outline)
        over_gap = _OVER_GAP if part > _SHALLOW else _SHALLOW_OVER_GAP
        error = over_gap if start < touch.x < end else _ON_PLATES
    reach = _CORNER_RADII * touch.indenter.rims[1]
    if edge < _SIDE_DISTANCE or corner_distance(design.outline, touch.x, touch.y) < reach:
        error = max(error, _AT_EDGE)
    return error


def find_cautions(
    touch: Touch,
    edge: float,
    neighbour: float,
    depth: float,
    design: SensorDesign,
    mechanics: Mechanics,
) -> list[str]:
    """Reasons why the error of such a touch was not measured.

    Args:
        touch: the touch.
        edge, neighbour: distances of its axis from the gel's edge and the next touch [m].
        depth: depth to which it sinks [m].
        design: design of the sensor.
        mechanics: its materials.
    """
    reasons = uncompared_properties(touch.indenter, design, mechanics)
    outline, thickness = design.outline, design.encapsulated_thickness
    if not isinstance(outline, Rectangle | Polygon):
        reasons.append("on this outline the error was not measured")
    elif corner_distance(outline, touch.x, touch.y, math.pi) < _MIN_CORNER_DISTANCE * thickness:
        reasons.append("next to a re-entrant corner the error was not measured")
    if (
        isinstance(touch.indenter, Footprint)
        and not touch.indenter.is_aligned
        and touch.indenter.slenderness > _MAX_SLENDERNESS
    ):
        reasons.append("the error of narrow turned footprints was not measured")
    if edge < _MIN_EDGE_DISTANCE:
        reasons.append(f"{1e3 * edge:.1f} mm from the edge of the gel, closer than was measured")
    if neighbour < _MIN_TOUCH_SPACING:
        reasons.append(f"{1e3 * neighbour:.1f} mm from another touch, closer than was measured")
    if depth > _MAX_RELATIVE_DEPTH * thickness:
        reasons.append(f"{1e3 * depth:.1f} mm deep, deeper than was measured")
    return reasons


def uncompared_properties(
    indenter: AnyIndenter, design: SensorDesign, mechanics: Mechanics
) -> list[str]:
    """Properties of a stack and an indenter beyond those whose signals were compared, in words."""
    reasons = []
    cover = 0.5 * (design.encapsulated_thickness - design.thickness) / design.thickness
    if cover < _MIN_COVER * (1.0 - _ALIKE):
        least = f"{_MIN_COVER:.2g} or more"
        reasons.append(f"a cover of {cover:.2g} times the gel's thickness, {least} was compared")
    moduli = mechanics.encapsulation.shear_modulus / mechanics.gel.shear_modulus
    low, high = _MODULI
    if cover > 0.0 and not low * (1.0 - _ALIKE) <= moduli <= high * (1.0 + _ALIKE):
        within = f"{low:.2g} to {high:g} was compared"
        reasons.append(f"a cover {moduli:.3g} times as stiff as the gel, {within}")
    if (radius := indenter.rims[1]) < _MIN_RADIUS * (1.0 - _ALIKE):
        least = f"{1e3 * _MIN_RADIUS:g} mm or more was compared"
        reasons.append(f"an indenter of {1e3 * radius:.2g} mm radius, {least}")
    return reasons
