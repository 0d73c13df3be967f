"""Map from a nominal sensor to one of its specimens, whose electrodes are moved along the rim."""

import dataclasses
import math
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from eitskin.geometry.deformation.kinematics import Deformation, Gradients, Points
from eitskin.geometry.design.electrode import Electrode
from eitskin.geometry.design.outline import Rectangle
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.geometry.design.surface import Surface

Array = NDArray[np.float64]

_CACHE_SIZE = 4  # sets of points whose images are kept: those of cells and contacts of two meshes
_TOLERANCE = 1e-9  # [m]


class ElectrodeShift(Deformation):
    """Map of a rectangular layer onto itself that moves side electrodes and scales the thickness.

    Along each side the map is linear between the edges of electrodes, and blended linearly across
    the layer (transfinite interpolation, Gordon and Hall 1973). Its gradient jumps only at the
    nominal edges, where meshes have faces.
    """

    def __init__(self, sides: dict[str, tuple[Array, Array]], size: Array, thicker: float) -> None:
        """Keep the map.

        Args:
            sides: nominal and moved positions [m] along "bottom", "top", "left" and "right", each
                rising from corner to corner; none for a map that scales the thickness alone.
            size: length and width [m].
            thicker: thickness of the specimen over the nominal one.
        """
        self._sides, self._size, self._thicker = sides, size, thicker
        self._images: dict[int, tuple[Points, Points, Gradients]] = {}

    def map_points(self, points: Points) -> tuple[Points, Gradients]:
        """Positions [m], (..., 3), and gradients, (..., 3, 3), of nominal points [m].

        Images of the last sets of points are kept, since all scenes share them.
        """
        cached = self._images.get(id(points))
        if cached is None:
            while len(self._images) >= _CACHE_SIZE:
                self._images.pop(next(iter(self._images)))
            cached = self._images[id(points)] = (points, *self._evaluate(points))
        return cached[1], cached[2]

    def _evaluate(self, points: Points) -> tuple[Points, Gradients]:
        if not self._sides:
            scales = np.array([1.0, 1.0, self._thicker])
            return scales * points, np.broadcast_to(np.diag(scales), (*points.shape, 3)).copy()
        x, y = points[..., 0], points[..., 1]
        across, along = y / self._size[1], x / self._size[0]
        bottom, left_side = self._shift_along_side("bottom", x), self._shift_along_side("left", y)
        top, right = self._shift_along_side("top", x), self._shift_along_side("right", y)
        moved, F = self._thicker * points, np.zeros((*points.shape, 3))
        moved[..., 0] = (1.0 - across) * bottom[0] + across * top[0]
        moved[..., 1] = (1.0 - along) * left_side[0] + along * right[0]
        F[..., 0, 0] = (1.0 - across) * bottom[1] + across * top[1]
        F[..., 0, 1] = (top[0] - bottom[0]) / self._size[1]
        F[..., 1, 0] = (right[0] - left_side[0]) / self._size[0]
        F[..., 1, 1] = (1.0 - along) * left_side[1] + along * right[1]
        F[..., 2, 2] = self._thicker
        return moved, F

    def _shift_along_side(self, side: str, positions: Array) -> tuple[Array, Array]:
        """Moved positions along a side and their derivatives."""
        nominal, moved = self._sides[side]
        slopes = np.diff(moved) / np.diff(nominal)
        piece = np.clip(np.searchsorted(nominal, positions, side="right") - 1, 0, len(slopes) - 1)
        return moved[piece] + slopes[piece] * (positions - nominal[piece]), slopes[piece]


def electrode_shift(nominal: SensorDesign, design: SensorDesign) -> ElectrodeShift | None:
    """Map from a nominal sensor to a design that differs in electrode positions and thickness.

    None for designs that differ otherwise in shape. Electrodes can be moved on rectangles, those
    that are as high as the layer and meet no corner. Conductivities and contact impedances are
    free.
    """
    outline, thicker = nominal.outline, design.thickness / nominal.thickness
    if outline != design.outline or isinstance(outline, Surface):
        return None
    if _same_places(nominal, design, thicker):
        return ElectrodeShift({}, np.array([outline.length, outline.width]), thicker)
    if not isinstance(outline, Rectangle) or len(nominal.electrodes) != len(design.electrodes):
        return None
    sides: dict[str, list[tuple[float, float, float, float]]] = {}
    for one, after in zip(nominal.electrodes, design.electrodes, strict=True):
        side = _side(one, outline)
        whole = all(e.on == "side" and e.height is None for e in (one, after))
        if not whole or side is None or side != _side(after, outline) or one.width != after.width:
            return None
        at, moved = (e.x if side in ("bottom", "top") else e.y for e in (one, after))
        half = 0.5 * one.width
        sides.setdefault(side, []).append((at - half, at + half, moved - half, moved + half))
    size = np.array([outline.length, outline.width])
    maps = {}
    for side, length in zip(("bottom", "top", "left", "right"), size[[0, 0, 1, 1]], strict=True):
        edges = sorted(sides.get(side, []))
        knots = np.array([[0.0, 0.0], *(e[i::2] for e in edges for i in (0, 1)), [length, length]])
        if any((after <= before).any() for before, after in pairwise(knots)):
            return None
        maps[side] = knots[:, 0], knots[:, 1]
    return ElectrodeShift(maps, size, thicker)


def _same_places(nominal: SensorDesign, design: SensorDesign, thicker: float) -> bool:
    """Whether all electrodes are alike but for contact impedances and the sensor's thickness."""
    if len(nominal.electrodes) != len(design.electrodes):
        return False
    for before, after in zip(nominal.electrodes, design.electrodes, strict=True):
        free = dataclasses.replace(
            after, contact_impedance=before.contact_impedance, z=before.z, height=before.height
        )
        upright = thicker if before.on == "side" else 1.0
        heights = _same(before.z, after.z, thicker), _same(before.height, after.height, upright)
        if free != before or not all(heights):
            return False
    return True


def _same(first: float | None, second: float | None, factor: float) -> bool:
    """Whether one length times a factor is the other, or neither is given."""
    if first is None or second is None:
        return first is second
    return math.isclose(factor * first, second, rel_tol=0.0, abs_tol=_TOLERANCE)


def _side(electrode: Electrode, outline: Rectangle) -> str | None:
    """Side of a rectangle on which an electrode lies, clear of corners; None on none."""
    x, y, half = electrode.x, electrode.y, 0.5 * electrode.width
    if half < x < outline.length - half:
        near = {"bottom": abs(y), "top": abs(y - outline.width)}
    elif half < y < outline.width - half:
        near = {"left": abs(x), "right": abs(x - outline.length)}
    else:
        return None
    side = min(near, key=lambda name: near[name])
    return side if near[side] < _TOLERANCE else None
