"""Contacts of electrodes on the side of a layer."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eitskin.errors import ConfigurationError
from eitskin.geometry.design.electrode import Electrode
from eitskin.geometry.design.outline import Disc, PlaneOutline
from eitskin.geometry.design.patches import Patch, Region

Array = NDArray[np.float64]

_SAME = 1e-9  # distance of points that count as one, relative to the size of the layer
_WIDEST_ARC = 0.5  # of one region [rad]
_DEEPEST = 0.1  # largest depth of a region behind its side, relative to the perimeter
_UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True, slots=True)
class Strip:
    """Contact on the side of a layer: an interval of arc length times one of height.

    Attributes:
        outline: of the layer.
        thickness: of the layer [m].
        start, end: arc lengths, not limited to one turn around the outline [m].
        low, high: heights [m].
    """

    outline: PlaneOutline
    thickness: float
    start: float
    end: float
    low: float
    high: float

    @property
    def centre(self) -> Array:
        """Middle of the strip, (3,) [m]."""
        x, y = self.outline.at(0.5 * (self.start + self.end))
        return np.array([x, y, 0.5 * (self.low + self.high)])

    @property
    def reach(self) -> float:
        """Radius about the centre that contains the strip [m]."""
        return 0.5 * math.hypot(self.end - self.start, self.high - self.low)

    def patch(self) -> Patch:
        """Contact patch: a region for every side of the outline, or every 0.5 rad of an arc."""
        area = (self.end - self.start) * (self.high - self.low)
        return Patch(tuple(self._region(a, b) for a, b in self._pieces()), area)

    def edges(self, spacing: float) -> Array:
        """Points along the rim of the strip, except on the rim of the layer, (k, 3) [m]."""
        rows = _divided(self.low, self.high, spacing)
        around = np.concatenate([_divided(a, b, spacing) for a, b in self._pieces()])
        lines = [(np.full_like(rows, s), rows) for s in (self.start, self.end)]
        # At the rim of the layer the potential has no singularity: it continues mirrored.
        same = _SAME * self.thickness
        free = [z for z in (self.low, self.high) if same < z < self.thickness - same]
        lines += [(around, np.full_like(around, z)) for z in free]
        s, z = (np.concatenate(parts) for parts in zip(*lines, strict=True))
        return np.column_stack([self.outline.at(s), z])

    def _pieces(self) -> list[tuple[float, float]]:
        """Intervals of arc length of constant or nearly constant normal."""
        if isinstance(self.outline, Disc):
            count = math.ceil((self.end - self.start) / (_WIDEST_ARC * self.outline.radius))
            breaks = np.linspace(self.start, self.end, count + 1)
        else:
            turns = np.array([[-1.0], [0.0], [1.0]]) * self.outline.perimeter
            corners = (turns + self.outline.corners).ravel()
            same = _SAME * self.outline.perimeter
            within = (corners > self.start + same) & (corners < self.end - same)
            breaks = np.concatenate([[self.start], corners[within], [self.end]])
        return list(zip(breaks[:-1].tolist(), breaks[1:].tolist(), strict=True))

    def _region(self, start: float, end: float) -> Region:
        a, b = np.column_stack([self.outline.at([start, end]), np.zeros(2)])
        along = (b - a) / np.linalg.norm(b - a)
        normal = np.cross(along, _UP)
        if isinstance(self.outline, Disc):
            # Between two radii, so that neighbouring regions share a rim.
            middle = np.array([self.outline.radius, self.outline.radius, 0.0])
            to_a, to_b = (a - middle) / self.outline.radius, (b - middle) / self.outline.radius
            rims = [(np.cross(to_a, _UP), middle), (np.cross(_UP, to_b), middle)]
        else:
            deep = _depth(self.outline, a[:2], b[:2]) * normal
            rims = [(-along, a), (along, b), (normal, a + deep), (-normal, a - deep)]
        rims += [(-_UP, self.low * _UP), (_UP, self.high * _UP)]
        planes = [np.append(outward, outward @ point) for outward, point in rims]
        return Region(np.array(planes), normal)


def on_side(electrode: Electrode, outline: PlaneOutline, thickness: float) -> Strip:
    """Strip of an electrode; raises ConfigurationError where the strip does not fit the side."""
    centre = outline.locate(electrode.x, electrode.y)
    if electrode.width > outline.perimeter * (1.0 - _SAME):
        raise ConfigurationError(
            f"its width of {electrode.width:g} m must be less than the outline's perimeter of "
            f"{outline.perimeter:g} m"
        )
    start, end = centre - 0.5 * electrode.width, centre + 0.5 * electrode.width
    if electrode.height is None:
        return Strip(outline, thickness, start, end, 0.0, thickness)
    z = 0.5 * thickness if electrode.z is None else electrode.z
    low, high = z - 0.5 * electrode.height, z + 0.5 * electrode.height
    if low < -_SAME * thickness or high > thickness * (1.0 + _SAME):
        raise ConfigurationError(
            f"it reaches from z = {low:g} to {high:g} m, beyond the layer's 0 to {thickness:g} m; "
            "lower its height or move its z"
        )
    return Strip(outline, thickness, start, end, max(low, 0.0), min(high, thickness))


def _divided(start: float, end: float, spacing: float) -> Array:
    """Evenly spaced numbers from `start` to `end`, at most `spacing` apart."""
    return np.linspace(start, end, max(2, math.ceil((end - start) / spacing - 1e-9) + 1))


def _depth(outline: PlaneOutline, a: Array, b: Array) -> float:
    """Depth of a region behind the side from `a` to `b` (2,) that meets no other region [m].

    The depth is half the distance to the nearest side with overlapping extent and equal direction.
    """
    corners = outline.at(outline.corners)
    start, step = corners - a, np.roll(corners, -1, axis=0) - corners
    length = float(np.hypot(*(b - a)))
    along = (b - a) / length
    normal = np.array([along[1], -along[0]])
    rise, forward = step @ normal, step @ along
    alike = forward > 0.5 * np.hypot(*step.T)
    share = [
        np.clip((end - start @ along) / np.where(alike, forward, 1.0), 0.0, 1.0)
        for end in (0.0, length)
    ]
    offsets = np.abs([start @ normal + part * rise for part in share])
    same = _SAME * outline.perimeter
    other = alike & ((share[1] - share[0]) * forward > same) & (offsets.max(axis=0) > same)
    nearest = offsets.min(axis=0)[other].min(initial=np.inf)
    return float(min(0.5 * nearest, _DEEPEST * outline.perimeter))
