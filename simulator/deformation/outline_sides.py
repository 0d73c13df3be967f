"""Sides of an outline, as presses see them, and the fade of a field next to one that ends."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from eitskin.geometry.design.outline import Outline, Polygon, Rectangle

Array = NDArray[np.float64]

# Widths of the parts of a line that count for a point on it and for a press on it, and distance
# from a re-entrant corner at which half of the correction is left, over the thickness of the stack.
# They were fitted to twelve presses that were solved on an L-shaped outline.
_OF_POINT, _OF_PRESS, _STIFF = 0.3, 0.6, 0.3
# Share of a side's correction for the image of a press in the other side of a right corner. It was
# fitted to twelve presses that were solved on a rectangle, an L-shaped and a hexagonal outline.
_CORNER = -0.3


class SideEnd(NamedTuple):
    """End of a side, as a press sees it.

    Attributes:
        inward: inward from the end to the foot of the press, along the side; negative beyond the
            end [m].
        way: 1 for the end that comes last counter-clockwise, else -1.
        image: share of what lies beyond the end that a convex corner throws back.
        stiff: 1 at a re-entrant right angle, 0 where the rim goes straight on or turns inwards.
    """

    inward: float
    way: float
    image: float
    stiff: float


class Side(NamedTuple):
    """Side of an outline, as a press sees it.

    Attributes:
        foot: foot of the press on the line through the side, (x, y) [m].
        along: unit vector, counter-clockwise.
        aside: distance of the press from that line [m].
        ends: ends at which the rest of the line is missing.
        share: share of the correction next to the line that is added.
    """

    foot: tuple[float, float]
    along: tuple[float, float]
    aside: float
    ends: tuple[SideEnd, ...]
    share: float = 1.0

    def corner_images(self, reach: float, thickness: float) -> Iterator["Side"]:
        """The side as the images of the press beyond its convex corners see it, within a reach.

        An image that comes near the press itself fades over half the thickness of the stack.
        """
        for end in self.ends:
            if end.image > 0.0 and end.inward > 0.0 and math.hypot(self.aside, end.inward) < reach:
                beyond = 2.0 * end.way * end.inward
                x, y = (a + beyond * b for a, b in zip(self.foot, self.along, strict=True))
                apart = end.inward**2 / (end.inward**2 + (0.5 * thickness) ** 2)
                yield self._replace(foot=(x, y), ends=(), share=_CORNER * end.image * apart)


@dataclass(frozen=True, slots=True, eq=False)
class SideFade:
    """Fade of the correction next to a straight line, of which only one side of an outline exists.

    Next to a line without ends the correction is that of the table. Tractions on the part of the
    line that is missing have no counterpart. A place on the line counts for a point at a distance
    y by a bell about its foot x whose width b grows with y, and is loaded by a press by another
    about its foot x_p of width a. Their product has its middle at m = (x a^2 + x_p b^2) / (a^2 +
    b^2) and the width s = a b / sqrt(a^2 + b^2), so that (1 - m / sqrt(m^2 + s^2)) / 2 of it is
    beyond an end at 0. That is taken away, but for what a convex corner throws back, as images
    would: nothing where the rim goes straight on, all at a right angle. A re-entrant corner moves
    less than a straight side does, by r^2 / (r^2 + d^2) at a distance r.

    Attributes:
        side: side of the outline.
        below: distance of the line from the origin of the field's frame [m].
        thickness: thickness of the stack [m].
    """

    side: Side
    below: float
    thickness: float

    def weight(self, x: Array, y: Array) -> tuple[Array, Array]:
        """Part of the field that is left at (x, y) of its frame, (n,), and its slopes (2, n)."""
        y = np.maximum(y + self.below, 0.0)
        weight, slopes = np.ones_like(x), np.zeros((2, len(x)))
        for end in self.side.ends:
            if end.image < 1.0:
                part, rates = self._missing(end, x, y)
                weight -= (1.0 - end.image) * part
                slopes -= (1.0 - end.image) * rates
        for end in self.side.ends:
            if end.stiff > 0.0:
                part, rates = self._softness(end, x, y)
                slopes = part * slopes + weight * rates
                weight = part * weight
        return weight, slopes

    def press_fraction(self) -> float:
        """Part of the field that is left at the press itself."""
        weight, _ = self.weight(np.zeros(1), np.array([self.side.aside - self.below]))
        return float(weight[0])

    def _missing(self, end: SideEnd, x: Array, y: Array) -> tuple[Array, Array]:
        """Part of the line beyond an end, (n,), and its slopes along and across it (2, n)."""
        a2 = self.side.aside**2 + (_OF_PRESS * self.thickness) ** 2
        b2 = y**2 + (_OF_POINT * self.thickness) ** 2
        total = a2 + b2
        own, press = end.inward - end.way * x, end.inward
        m, s2 = (own * a2 + press * b2) / total, a2 * b2 / total
        m_y, s2_y = 2.0 * y * a2 * (press - own) / total**2, 2.0 * y * a2**2 / total**2
        root = np.sqrt(m**2 + s2)
        by_x = 0.5 * end.way * a2 / total * s2 / root**3
        by_y = -0.5 * (m_y * s2 - 0.5 * m * s2_y) / root**3
        return 0.5 * (1.0 - m / root), np.stack([by_x, by_y])

    def _softness(self, end: SideEnd, x: Array, y: Array) -> tuple[Array, Array]:
        """Part of a motion that a re-entrant corner leaves, and its slopes, as of `_missing`."""
        own = end.inward - end.way * x
        d2 = (end.stiff * _STIFF * self.thickness) ** 2
        total = own**2 + y**2 + d2
        rates = 2.0 * d2 / total**2 * np.stack([-end.way * own, y])
        return 1.0 - d2 / total, rates


def sides_in_reach(
    outline: Polygon | Rectangle, x: float, y: float, reach: float
) -> Iterator[Side]:
    """Sides within a reach of a press at (x, y) [m].

    A side that turns its back to a press, which stands beyond its end, is loaded as it would be in
    a mirror: its normal tractions are the same.
    """
    sides = _sides(outline)
    for corner, (cos, sin), length, first, last in zip(
        sides.corners, sides.along, sides.lengths, sides.angles, sides.angles[1:], strict=False
    ):
        dx, dy = x - corner[0], y - corner[1]
        foot, aside = cos * dx + sin * dy, cos * dy - sin * dx
        gap = max(-foot, foot - length, 0.0)
        if math.hypot(aside, gap) < reach and (aside > 0.0 or gap > 0.0):
            ends = _end(foot, -1.0, first), _end(length - foot, 1.0, last)
            at = corner[0] + foot * cos, corner[1] + foot * sin
            yield Side(at, (cos, sin), abs(aside), ends)


def corner_distance(outline: Outline, x: float, y: float, angle: float = 0.0) -> float:
    """Distance of (x, y) from the nearest corner of an inner angle above `angle` [m]; or infinity.

    Re-entrant corners are above pi.
    """
    if not isinstance(outline, Polygon | Rectangle):
        return math.inf
    sides = _sides(outline)
    corners = zip(sides.corners, sides.angles, strict=False)
    away = [math.dist((x, y), corner) for corner, own in corners if own > angle]
    return min(away, default=math.inf)


def _end(inward: float, way: float, angle: float) -> SideEnd:
    """End of a side at a corner of an inner angle."""
    image = min(max(math.pi / angle - 1.0, 0.0), 1.0)
    stiff = min(max(2.0 * angle / math.pi - 2.0, 0.0), 1.0)
    return SideEnd(inward, way, image, stiff)


class _Sides(NamedTuple):
    """Corners, unit vectors and lengths of sides, and inner angles of the corners, closed."""

    corners: list[tuple[float, float]]
    along: list[tuple[float, float]]
    lengths: list[float]
    angles: list[float]


@lru_cache(maxsize=64)
def _sides(outline: Polygon | Rectangle) -> _Sides:
    corners = outline.vertices
    steps = np.roll(corners, -1, axis=0) - corners
    lengths = np.hypot(*steps.T)
    along = steps / lengths[:, None]
    before = np.roll(along, 1, axis=0)
    crossed = before[:, 0] * along[:, 1] - before[:, 1] * along[:, 0]
    angles = math.pi - np.arctan2(crossed, (before * along).sum(axis=1))
    closed = np.append(angles, angles[0])
    pairs = [[(float(a), float(b)) for a, b in each] for each in (corners, along)]
    return _Sides(pairs[0], pairs[1], lengths.tolist(), closed.tolist())
