"""Flat punches of any footprint: touches of a cylinder, and what their shape changes.

A punch presses like cylinders side by side that share its force, at finite strain, and the field of
the difference between its tractions and theirs, which is linear. All tables are those of the
cylinder.
"""

from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import NDArray

from eitskin.simulator.deformation.field import CubicSplines, Field, Frame
from eitskin.simulator.deformation.press_table import PressTable, TabulatedDent, press_table
from eitskin.simulator.deformation.pressed_sensor import PressedSensor
from eitskin.simulator.mechanics import viscoelasticity as relaxation
from eitskin.simulator.mechanics.flat_punch import LayeredFace
from eitskin.simulator.mechanics.layer_stack import Stack
from eitskin.simulator.scene.indenters import Cylinder, Footprint
from eitskin.simulator.scene.scene import Touch

Array = NDArray[np.float64]

_PIXEL, _PER_WIDTH, _MAX_PIXELS = 1.0 / 16.0, 12, 320  # over the thickness; across a punch; in all
_REACH = 4.0  # of the field beyond the punch, over the thickness
_SUBPIXELS = 8  # along a pixel, of which the covered ones are counted
_SPACING = 0.9  # between the cylinders that stand for a punch, over their diameter
_MIN_SHARE = 0.02  # of the force, that a cylinder takes
_LEVELS = 4  # over the height of the gel
_TOUCHING = 4  # number of the tabulated depth at which a cylinder's whole end touches


class Cylinders(NamedTuple):
    """Cylinders that share the force of a punch.

    Attributes:
        indenter: each of them.
        places: places in the frame of the footprint's length, (n, 2) [m].
        shares: shares of the force, (n,).
    """

    indenter: Cylinder
    places: Array
    shares: Array


class Punch(NamedTuple):
    """Flat punch as cylinders and a field.

    Attributes:
        footprint: footprint of the punch.
        dents: cylinders whose dents make that of the punch.
        corrected: default cylinders whose corrections make those of the punch.
        area: over that of the cylinder of the dents.
        depth: over that of the cylinder at the same mean pressure.
        field: linear difference to the cylinders, by the force [1/N].
    """

    footprint: Footprint
    dents: "Cylinders"
    corrected: "Cylinders"
    area: float
    depth: float
    field: Field

    def parts(
        self, cylinders: "Cylinders", touch: Touch, dent: TabulatedDent, table: PressTable
    ) -> list[tuple[Touch, TabulatedDent]]:
        """Cylinders at their places, with the dents by their shares of the force, of a table.

        `dent` is that of the cylinder at the mean pressure of the punch.
        """
        force = self.area * dent.force
        places = cylinders.places @ self.footprint.rotation.T + np.array([touch.x, touch.y])
        return [
            (Touch(x, y, indenter=cylinders.indenter), table.dent_from_force(share * force))
            for (x, y), share in zip(places.tolist(), cylinders.shares.tolist(), strict=True)
        ]

    def shape(self, touch: Touch, dent: TabulatedDent, table: PressTable) -> Field:
        """Field of the shape, as much stiffer as the dent at the mean pressure is."""
        first = table.dent_from_depth(float(table.depths[_TOUCHING]))
        stiffening = dent.depth / dent.force * first.force / first.depth
        (cos, _), (sin, _) = self.footprint.rotation.tolist()
        return replace(
            self.field,
            coefficients=self.field.coefficients * (stiffening * self.area * dent.force),
            frame=Frame(touch.x, touch.y, cos, sin),
        )


def punch(stack: Stack, footprint: Footprint) -> Punch:
    """Punch on the unbounded stack, which takes a second; that of any angle is the same."""
    solved = _solve_punch(stack, replace(footprint, angle_deg=0.0))
    return solved._replace(footprint=footprint)


@lru_cache(maxsize=16)
def _solve_punch(stack: Stack, footprint: Footprint) -> Punch:
    corners, H = footprint.outline, stack.levels[-1]
    extents = np.ptp(corners, axis=0)
    half = float(np.abs(corners).max()) + _REACH * H
    size = max(min(_PIXEL * H, extents.min() / _PER_WIDTH), 2.0 * half / _MAX_PIXELS)
    face, cylinder = LayeredFace(stack, half, size), footprint.table_indenter
    x = face.x[:, None] + size * ((np.arange(_SUBPIXELS) + 0.5) / _SUBPIXELS - 0.5)
    points = np.stack(np.meshgrid(x, x, indexing="ij"), axis=-1)  # pixels and subpixels mixed
    points = points.reshape(len(face.x), _SUBPIXELS, len(face.x), _SUBPIXELS, 2)
    pressed = face.solve_punch(
        (footprint.depth_inside(points) > 0.0).mean(axis=(1, 3)), footprint.rough
    )
    disc = (np.hypot(*np.moveaxis(points, -1, 0)) < cylinder.radius).mean(axis=(1, 3))
    alone = face.solve_punch(disc, footprint.rough)
    pressure, long = -pressed.tractions[2], int(extents[1] > extents[0])
    side_by_side = np.where(np.arange(2) == long, footprint.count, 1)
    places, shares = _split(face, pressure, corners, side_by_side)
    steps = np.rint(places / size).astype(int)
    default = footprint.correction_indenter
    rows = np.maximum(np.rint(extents / (2.0 * _SPACING * default.radius)), 1).astype(int)
    tractions = pressed.tractions - np.sum(
        [
            share * np.roll(alone.tractions, step, axis=(1, 2))
            for share, step in zip(shares.tolist(), steps.tolist(), strict=True)
        ],
        axis=0,
    )
    levels = legendre.leggauss(_LEVELS)[0]
    bottom, top = stack.levels[stack.gel : stack.gel + 2]
    heights = bottom + 0.5 * (top - bottom) * (levels + 1.0)
    moved = np.stack([face.motion(tractions, float(z)) for z in heights], axis=-1)
    values = moved.transpose(1, 2, 3, 0) - moved[:, :1, :1].transpose(1, 2, 3, 0)  # 0 at the end
    splines = CubicSplines(face.x)
    area = footprint.rims[1] ** 2 / cylinder.radius**2
    return Punch(
        footprint,
        Cylinders(cylinder, steps * size, shares),
        Cylinders(default, *_split(face, pressure, corners, rows)),
        area,
        area * pressed.compliance / alone.compliance,
        Field.from_values(values, (splines, splines), top - bottom, levels),
    )


def _split(
    face: LayeredFace, pressure: Array, corners: Array, counts: NDArray[np.int64]
) -> tuple[Array, Array]:
    """Places (n, 2) [m] and shares (n,) of the force on parts of a punch along both axes."""
    low, extents = corners.min(axis=0), np.ptp(corners, axis=0)
    numbers = [
        np.clip(np.floor((face.x - start) / extent * count), 0, count - 1).astype(int)
        for start, extent, count in zip(low, extents, counts, strict=True)
    ]
    cell = (numbers[0][:, None] * counts[1] + numbers[1]).ravel()
    x, y = np.meshgrid(face.x, face.x, indexing="ij")
    force, *moments = (
        np.bincount(cell, (pressure * arm).ravel(), int(counts.prod())) for arm in (1.0, x, y)
    )
    chosen = force > _MIN_SHARE * force.sum()
    places = np.stack(moments, axis=1)[chosen] / force[chosen, None]
    return places, force[chosen] / force[chosen].sum()


class DentedTouch(NamedTuple):
    """Touch with its dent in the unbounded stack.

    Attributes:
        touch: touch of the scene.
        dent: dent of its body of revolution, of the cylinder at the mean pressure of a flat punch;
            None where it has faded.
        force: force on the indenter [N].
        punch: where the indenter is a flat punch.
    """

    touch: Touch
    dent: TabulatedDent | None
    force: float
    punch: Punch | None

    @property
    def area(self) -> float:
        """Area over that of the dent's indenter, and force likewise."""
        return 1.0 if self.punch is None else self.punch.area

    @property
    def depth(self) -> float:
        """Depth in the unbounded stack [m]; 0 without a dent."""
        if self.dent is None:
            return 0.0
        return self.dent.depth * (1.0 if self.punch is None else self.punch.depth)


def _table(touch: Touch, sensor: PressedSensor) -> PressTable:
    """Table of the dents of a touch."""
    return press_table(sensor.design, sensor.mechanics, touch.indenter, sensor.grid)


def dent_touch(touch: Touch, depth: float, sensor: PressedSensor) -> DentedTouch:
    """Dent of a touch, None where it has faded, and the force on the indenter.

    `depth` is that of the first moment's dent [m] where a depth is prescribed.
    """
    mechanics, table, shape = sensor.mechanics, _table(touch, sensor), None
    if isinstance(touch.indenter, Footprint):
        shape = punch(mechanics.stack(sensor.design), touch.indenter)
    area, deeper = (1.0, 1.0) if shape is None else (shape.area, shape.depth)
    if touch.depth is None:
        first = table.dent_from_force(touch.force / area)
    else:
        first = table.dent_from_depth(depth / deeper)
    force = area * first.force
    if touch.held is None:
        return DentedTouch(touch, first, force, shape)
    prony = relaxation.mixture(
        (mechanics.gel_relaxation, mechanics.encapsulation_relaxation),
        (first.share, 1.0 - first.share),
    )
    if touch.depth is None:
        elastic = relaxation.elastic_force(prony, touch.force, touch.held, touch.released)
        acting = touch.force
    else:
        elastic = relaxation.elastic_force_at_depth(prony, force, touch.held, touch.released)
        acting = force * float(prony.relaxation(touch.held))
    dent = table.dent_from_force(elastic / area) if elastic > 0.0 else None
    return DentedTouch(touch, dent, 0.0 if touch.released else acting, shape)


def corrected_parts(
    number: int, dented: DentedTouch, sensor: PressedSensor
) -> list[tuple[int, Touch, TabulatedDent]]:
    """Corrected parts of a touch with its number: of a flat punch default cylinders."""
    touch, dent, _, shape = dented
    if dent is None:
        return []
    if shape is None:
        return [(number, touch, dent)]
    cylinder = replace(touch, indenter=shape.corrected.indenter)
    parts = shape.parts(shape.corrected, touch, dent, _table(cylinder, sensor))
    return [(number, *part) for part in parts]


def placed_dents(dented: DentedTouch, sensor: PressedSensor) -> list[tuple[Touch, TabulatedDent]]:
    """Dents of a touch: of a flat punch those of cylinders of its area."""
    touch, dent, _, shape = dented
    if dent is None or shape is None:
        return [] if dent is None else [(touch, dent)]
    return shape.parts(shape.dents, touch, dent, _table(touch, sensor))


def shape_fields(dented: DentedTouch, sensor: PressedSensor) -> list[tuple[Touch, Field]]:
    """Field by which the footprint of a flat punch changes its dents; none for other touches."""
    touch, dent, _, shape = dented
    if dent is None or shape is None:
        return []
    return [(touch, shape.shape(touch, dent, _table(touch, sensor)))]


def solved_press(dented: DentedTouch) -> Touch:
    """Press whose correction is solved: to its dent's depth, or of a flat punch with its force."""
    touch, dent, _, shape = dented
    if dent is None:
        raise ValueError("a dent that has faded does not press")
    how = {"depth": dent.depth} if shape is None else {"force": shape.area * dent.force}
    return Touch(touch.x, touch.y, indenter=touch.indenter, **how)
