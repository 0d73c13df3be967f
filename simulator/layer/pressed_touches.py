"""Touches of a scene, pressed: their dents and images, depth, contact and pressure."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product
from typing import Literal

import numpy as np

from eitskin.errors import ConfigurationError
from eitskin.geometry.design.outline import Rectangle
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.geometry.design.surface import Surface
from eitskin.simulator.layer.dents import Dents, PlacedDent
from eitskin.simulator.layer.smooth_field import Box
from eitskin.simulator.mechanics import viscoelasticity as relaxation
from eitskin.simulator.mechanics.closed_form_dent import ClosedFormDent
from eitskin.simulator.mechanics.layer_stack import Mechanics
from eitskin.simulator.mechanics.press_store import press_table
from eitskin.simulator.mechanics.tabulated_dent import TabulatedDent
from eitskin.simulator.scene.touch import Touch

TouchModel = Literal["tabulated", "closed form"]

# Distances of the axis from the gel's edge and from another touch, below which signals are more
# than a tenth off the full model's, or not compared with it (docs/deformation.md) [m].
EDGE = 0.0075
NEIGHBOUR = 0.030
# Largest errors of the signal that were found up to these distances, from the edge and from another
# touch [m], [-]; none where nothing was compared. Beside the edge signals are large, and so exact.
_BY_EDGE = ((0.005, None), (EDGE, 0.10), (0.0121, 0.03), (math.inf, 0.21))
_BY_NEIGHBOUR = ((0.020, None), (NEIGHBOUR, 0.40), (0.0451, 0.16), (math.inf, 0.0))


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
            found at such distances, for 10 N by the 15 mm cylinder on the reference sensor
            (docs/deformation.md); None at smaller distances than any comparison.
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


def dents(
    touches: tuple[Touch, ...], design: SensorDesign, mechanics: Mechanics, model: TouchModel
) -> Dents:
    """Deformation of the gel by touches.

    Raises ConfigurationError for presses beyond the range of the model.
    """
    if model == "closed form":
        _check_closed_form(touches)
        return Dents(
            tuple(PlacedDent(t.x, t.y, ClosedFormDent.of(t.indenter, t.force)) for t in touches)
        )
    found = [(touch, _dent(touch, design, mechanics)[0]) for touch in touches]
    return Dents(
        tuple(
            press
            for touch, dent in found
            if dent is not None
            for press in press_images(PlacedDent(touch.x, touch.y, dent), design, mechanics.margin)
        ),
        _box(design, mechanics.margin),
    )


def _box(design: SensorDesign, margin: float) -> Box | None:
    """Box around the gel and the encapsulation beside it."""
    outline = design.outline
    if isinstance(outline, Surface):
        return None
    high = (outline.length + margin, outline.width + margin, design.thickness)
    return Box((-margin, -margin, 0.0), high)


def press_images(press: PlacedDent, design: SensorDesign, margin: float) -> Iterator[PlacedDent]:
    """Press and its images beyond the free edges of the stack, of alternating sign.

    Method of images: at a free edge the pressure of the stack vanishes, as half-way between a press
    and its negative mirror image. Outlines other than rectangles have one image, beyond the nearest
    point of the edge.
    """
    outline, thickness = design.outline, design.encapsulated_thickness
    if isinstance(outline, Surface):
        yield press
    elif isinstance(outline, Rectangle):
        along = _mirrored(press.x, outline.length, margin, thickness)
        across = _mirrored(press.y, outline.width, margin, thickness)
        for (x, one), (y, other) in product(along, across):
            image = PlacedDent(x, y, press.dent, one * other)
            outside = np.hypot(max(-x, x - outline.length, 0.0), max(-y, y - outline.width, 0.0))
            if outside < press.dent.reach:
                yield image
    else:
        position = np.array([press.x, press.y])
        s, depth = outline.nearest(position)
        normal = (outline.at(s) - position) / max(float(depth), 1e-12)
        distance = float(depth) + margin
        x, y = position + 2.0 * (distance - mirror_inside(distance, thickness)) * normal
        yield press
        yield PlacedDent(float(x), float(y), press.dent, -1.0)


def mirror_inside(distance: float, thickness: float) -> float:
    """Distance of the mirror plane of a press inside a free edge [m]; negative outside.

    Fitted to the full model (docs/deformation.md): the far field of a press decays slowly and
    meets an edge further in, the near field bulges the edge.

    Args:
        distance: of the press from the edge [m].
        thickness: of the stack [m].
    """
    fitted = 0.15 - 0.25 * math.exp(2.0 * (1.04 - distance / thickness))
    return thickness * max(fitted, -0.3)


def _mirrored(
    position: float, extent: float, margin: float, thickness: float
) -> tuple[tuple[float, float], ...]:
    """Coordinate between two edges, with its images of first and second order, and signs."""
    low = -margin + mirror_inside(position + margin, thickness)
    high = extent + margin - mirror_inside(extent + margin - position, thickness)
    period = 2.0 * (high - low)
    return (
        (position, 1.0),
        (2.0 * low - position, -1.0),
        (2.0 * high - position, -1.0),
        (position - period, 1.0),
        (position + period, 1.0),
    )


def pressed_touches(
    touches: tuple[Touch, ...], design: SensorDesign, mechanics: Mechanics
) -> tuple[PressedTouch, ...]:
    """Depth, contact and pressure of each touch, from the tabulated presses."""
    return tuple(_pressed(touch, touches, design, mechanics) for touch in touches)


def _pressed(
    touch: Touch, touches: tuple[Touch, ...], design: SensorDesign, mechanics: Mechanics
) -> PressedTouch:
    dent, force = _dent(touch, design, mechanics)
    edge = _edge_distance(touch, design)
    neighbour = min(
        (math.dist((touch.x, touch.y), (t.x, t.y)) for t in touches if t is not touch),
        default=math.inf,
    )
    # Without contact there is a dent, but no pressure.
    radius = dent.contact_radius if dent is not None and force > 0.0 else 0.0
    return PressedTouch(
        touch=touch,
        force=force,
        depth=dent.depth if dent is not None else 0.0,
        contact_radius=radius,
        mean_pressure=force / (math.pi * radius**2) if radius else 0.0,
        peak_pressure=dent.peak_pressure * force / dent.force if dent is not None else 0.0,
        thinning=dent.thinning if dent is not None else 0.0,
        edge_distance=edge,
        neighbour_distance=neighbour,
        signal_error=_signal_error(edge, neighbour),
        caution=_caution(edge, neighbour),
    )


def _dent(
    touch: Touch, design: SensorDesign, mechanics: Mechanics
) -> tuple[TabulatedDent | None, float]:
    """Dent of a touch, None where it has faded, and the force on the indenter [N]."""
    table = press_table(design, mechanics, touch.indenter)
    first = table.at_force(touch.force) if touch.depth is None else table.at_depth(touch.depth)
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


def _signal_error(edge: float, neighbour: float) -> float | None:
    alone, together = (
        next(error for limit, error in table if distance < limit or limit == math.inf)
        for distance, table in ((edge, _BY_EDGE), (neighbour, _BY_NEIGHBOUR))
    )
    return None if alone is None or together is None else max(alone, together)


def _caution(edge: float, neighbour: float) -> str:
    reasons = []
    if edge < EDGE:
        reasons.append(f"{1e3 * edge:.1f} mm from the edge of the gel, felt by images only")
    if neighbour < NEIGHBOUR:
        reasons.append(f"{1e3 * neighbour:.1f} mm from another, whose dent is only added")
    return "; ".join(reasons)


def _check_closed_form(touches: tuple[Touch, ...]) -> None:
    for touch in touches:
        if touch.depth is not None or touch.held is not None:
            raise ConfigurationError(
                "the closed form knows forces only, no depth, held or released; use the touch "
                "model 'tabulated'"
            )
