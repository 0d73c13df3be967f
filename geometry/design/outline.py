"""Plane outlines of a conductive layer: rectangle, disc, polygon.

A position on the rim is reported by its arc length, counter-clockwise.

An outline of straight sides is a frozen dataclass that derives from `_PolygonalOutline`, gives
`vertices`, `length` and `width`, and joins the union `PlaneOutline`; TOML files distinguish
outlines by their keys. A curved outline derives from `_Plane` and needs a branch wherever `Disc`
has one.
"""

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eitskin.bounds import MOST_POINTS, require_axes, require_count, require_length
from eitskin.errors import ConfigurationError
from eitskin.extras import old_names
from eitskin.geometry.design.surface import Surface

Array = NDArray[np.float64]

# largest distance from the rim of a position on it, relative to the outline's size
_MAX_RIM_DISTANCE = 1e-3
_POINT_TOLERANCE = 1e-9  # distance of points that count as one, relative to the outline's size


class _Plane:
    """Base class of plane outlines, on the nearest point of the rim.

    Attributes:
        corner: least x and least y [m].
    """

    __slots__ = ()
    corner = (0.0, 0.0)

    def rim_points(self, s: ArrayLike) -> Array:
        """Points (..., 2) [m] of the rim at arc lengths `s` (...) [m], counter-clockwise."""
        raise NotImplementedError

    def nearest(self, points: Array) -> tuple[Array, Array]:
        """Arc length of the nearest point of the rim, and depth [m], of points (..., 2) [m].

        The depth is the distance to the rim, negative outside; both have the shape (...).
        """
        raise NotImplementedError

    def contains(self, points: Array, margin: float = 0.0) -> NDArray[np.bool_]:
        """Whether points (..., 2) [m] are inside, at least `margin` [m] from the rim, (...)."""
        _, depth = self.nearest(np.asarray(points, dtype=float))
        return depth >= margin - _POINT_TOLERANCE * self._size()

    def locate(self, x: float, y: float) -> float:
        """Arc length [m] of the point of the rim nearest to (x, y) [m].

        Raises ConfigurationError, naming that point, for a position off the rim by more than a
        thousandth of the outline's larger extent: positions may be rounded.
        """
        return _rim_position(self, x, y)

    def _size(self) -> float:
        """Larger extent [m]."""
        raise NotImplementedError


@lru_cache(maxsize=1024)  # the same electrodes are placed for every change of a design
def _rim_position(outline: _Plane, x: float, y: float) -> float:
    s, depth = outline.nearest(np.array([x, y]))
    if not abs(depth) <= _MAX_RIM_DISTANCE * outline._size():
        near_x, near_y = outline.rim_points(s)
        raise ConfigurationError(
            f"({x:g}, {y:g}) m is {abs(depth):g} m off the outline; the nearest point on it is "
            f"({near_x:.9g}, {near_y:.9g}) m"
        )
    return float(s)


class _PolygonalOutline(_Plane):
    """Outline of straight sides; arc length runs counter-clockwise from the first vertex."""

    __slots__ = ()

    @property
    def vertices(self) -> Array:
        """Corners in order, counter-clockwise, (k, 2) [m]."""
        raise NotImplementedError

    @property
    def corners(self) -> Array:
        """Arc lengths of the corners, rising from 0, (k,) [m]."""
        return _sides(self).knots[:-1]

    @property
    def perimeter(self) -> float:
        """Length of the rim [m]."""
        return float(_sides(self).knots[-1])

    def rim_points(self, s: ArrayLike) -> Array:
        sides = _sides(self)
        along = np.mod(s, sides.knots[-1])
        return np.stack([np.interp(along, sides.knots, axis) for axis in sides.closed.T], axis=-1)

    def nearest(self, points: Array) -> tuple[Array, Array]:
        require_axes("points", points, 2)
        sides = _sides(self)
        step, lengths = sides.step, sides.lengths
        away = points[..., None, :] - sides.closed[:-1]
        along = np.clip((away * step).sum(-1) / lengths**2, 0.0, 1.0)
        gap = away - along[..., None] * step
        apart = np.hypot(gap[..., 0], gap[..., 1])
        side = apart.argmin(axis=-1)
        share = np.take_along_axis(along, side[..., None], axis=-1)[..., 0]
        s = np.mod(sides.knots[side] + share * lengths[side], sides.knots[-1])
        # A ray towards +x crosses the rim an odd number of times from inside.
        slope = step[:, 0] / np.where(step[:, 1] == 0.0, 1.0, step[:, 1])
        crossed = (away[..., 1] < 0.0) != (away[..., 1] < step[:, 1])
        inside = (crossed & (away[..., 0] < away[..., 1] * slope)).sum(axis=-1) % 2 == 1
        depth = apart.min(axis=-1)
        return s, np.where(inside, depth, -depth)

    def _size(self) -> float:
        return float(_sides(self).closed.max())


@dataclass(frozen=True, slots=True, eq=False)
class _Sides:
    """Sides of an outline: closed vertices (k + 1, 2), edge vectors, lengths, arc lengths [m]."""

    closed: Array
    step: Array
    lengths: Array
    knots: Array


@lru_cache(maxsize=64)
def _sides(outline: _PolygonalOutline) -> _Sides:
    closed = np.concatenate([outline.vertices, outline.vertices[:1]])
    step = np.diff(closed, axis=0)
    lengths = np.hypot(step[:, 0], step[:, 1])
    knots = np.concatenate([[0.0], np.cumsum(lengths)])
    knots.flags.writeable = False  # `corners` hands them out
    return _Sides(closed, step, lengths, knots)


@dataclass(frozen=True, slots=True)
class Rectangle(_PolygonalOutline):
    """Rectangular outline with a corner at the origin: length along x, width along y [m].

    Arc length runs counter-clockwise from the origin.

    Example:
        >>> from eitskin.geometry import Rectangle
        >>> round(Rectangle(0.150, 0.060).perimeter, 3)
        0.42
    """

    length: float
    width: float

    def __post_init__(self) -> None:
        require_length("outline.length", self.length)
        require_length("outline.width", self.width)

    @property
    def vertices(self) -> Array:
        """Corners in order, counter-clockwise, (4, 2) [m]."""
        x, y = self.length, self.width
        return np.array([[0.0, 0.0], [x, 0.0], [x, y], [0.0, y]])


@dataclass(frozen=True, slots=True)
class Polygon(_PolygonalOutline):
    """Polygonal outline through at least three points (x, y) [m]; the last joins the first.

    The minimum x and y must be 0. Clockwise points are reversed, the first point staying
    the first: arc length runs counter-clockwise from there.

    Example:
        >>> from eitskin.geometry import Polygon
        >>> round(Polygon(((0.0, 0.0), (0.04, 0.0), (0.0, 0.03))).perimeter, 3)
        0.12
    """

    points: tuple[tuple[float, float], ...]

    def __post_init__(self) -> None:
        """Check that the points make one simple polygon."""
        require_count("the number of outline.points", len(self.points), 3, MOST_POINTS)
        if any(len(point) != 2 for point in self.points):
            raise ConfigurationError("outline.points must be pairs (x, y), in m")
        vertices = np.array(self.points, dtype=float)
        if not np.isfinite(vertices).all():
            raise ConfigurationError("outline.points must be finite, in m")
        low, extent = vertices.min(axis=0), np.ptp(vertices, axis=0)
        require_length("outline.points' extent along x", float(extent[0]))
        require_length("outline.points' extent along y", float(extent[1]))
        same = _POINT_TOLERANCE * float(extent.max())
        if np.abs(low).max() > same:
            raise ConfigurationError(
                "the bounding box of outline.points must start at the origin; shift the points by "
                f"({-low[0]:.9g}, {-low[1]:.9g}) m"
            )
        _require_simple(vertices, same)
        x, y = vertices.T
        if (x * np.roll(y, -1) - np.roll(x, -1) * y).sum() < 0.0:
            vertices = np.concatenate([vertices[:1], vertices[:0:-1]])
        points = tuple((float(x), float(y)) for x, y in vertices)
        object.__setattr__(self, "points", points)

    @property
    def vertices(self) -> Array:
        return np.array(self.points)

    @property
    def length(self) -> float:
        """Extent along x [m]."""
        return max(x for x, _ in self.points)

    @property
    def width(self) -> float:
        """Extent along y [m]."""
        return max(y for _, y in self.points)

    @property
    def as_rectangle(self) -> Rectangle | None:
        """Rectangle of the same rim; None where the polygon is of another shape."""
        (x, y), box = np.array(self.points).T, self.length * self.width
        area = 0.5 * float((x * np.roll(y, -1) - np.roll(x, -1) * y).sum())
        return (
            Rectangle(self.length, self.width)
            if abs(area - box) <= _POINT_TOLERANCE * box
            else None
        )


@old_names(at="rim_points")
@dataclass(frozen=True, slots=True)
class Disc(_Plane):
    """Circular outline about (radius, radius) [m].

    Arc length runs counter-clockwise from angle 0, the point (2 radius, radius).

    Example:
        >>> from eitskin.geometry import Disc
        >>> round(Disc(0.050).perimeter, 3)
        0.314
    """

    radius: float

    def __post_init__(self) -> None:
        require_length("outline.radius", self.radius)

    @property
    def length(self) -> float:
        """Extent along x [m]."""
        return 2.0 * self.radius

    @property
    def width(self) -> float:
        """Extent along y [m]."""
        return 2.0 * self.radius

    @property
    def corners(self) -> Array:
        """Arc lengths of corners: none, (0,)."""
        return np.empty(0)

    @property
    def perimeter(self) -> float:
        """Length of the rim [m]."""
        return 2.0 * math.pi * self.radius

    def rim_points(self, s: ArrayLike) -> Array:
        angle = np.asarray(s, dtype=float) / self.radius
        return self.radius * (1.0 + np.stack([np.cos(angle), np.sin(angle)], axis=-1))

    def nearest(self, points: Array) -> tuple[Array, Array]:
        require_axes("points", points, 2)
        away = points - self.radius
        angle = np.mod(np.arctan2(away[..., 1], away[..., 0]), 2.0 * math.pi)
        return angle * self.radius, self.radius - np.hypot(away[..., 0], away[..., 1])

    def _size(self) -> float:
        return 2.0 * self.radius


PlaneOutline = Rectangle | Disc | Polygon
Outline = PlaneOutline | Surface


def overhang(outline: PlaneOutline, corners: Array) -> float:
    """Distance by which a convex polygon (k, 2) [m] reaches beyond an outline [m]; 0 inside."""
    _, depth = outline.nearest(corners)
    excess = -float(depth.min())
    if not isinstance(outline, Disc):
        # The rim of an outline that is not convex may enter the polygon between its corners.
        start = outline.vertices
        step = np.roll(start, -1, axis=0) - start
        planes = half_planes(corners)
        room = planes[:, 2] - start @ planes[:, :2].T
        speed = step @ planes[:, :2].T
        with np.errstate(divide="ignore", invalid="ignore"):
            when = room / speed
        enter = np.where(speed < 0.0, when, 0.0).max(axis=1)
        leave = np.where(speed > 0.0, when, 1.0).min(axis=1)
        middle = start + 0.5 * np.clip(enter + leave, 0.0, 2.0)[:, None] * step
        inside = (planes[:, 2] - middle @ planes[:, :2].T).min(axis=1)
        excess = max(excess, float(inside[enter < leave].max(initial=-np.inf)))
    return excess if excess > _POINT_TOLERANCE * max(outline.length, outline.width) else 0.0


def half_planes(corners: Array) -> Array:
    """Half-planes (k, 3) of a counter-clockwise convex polygon (k, 2) [m].

    The polygon is {x: planes[:, :2] @ x <= planes[:, 2]}.
    """
    step = np.roll(corners, -1, axis=0) - corners
    outward = np.column_stack([step[:, 1], -step[:, 0]]) / np.hypot(*step.T)[:, None]
    return np.column_stack([outward, (outward * corners).sum(axis=1)])


def _require_simple(points: Array, same: float) -> None:
    """Raise ConfigurationError where the polygon through `points` (k, 2) meets itself."""
    count = len(points)
    step = np.roll(points, -1, axis=0) - points
    short = np.flatnonzero(np.hypot(*step.T) <= same)
    if short.size:
        i, j = int(short[0]), int((short[0] + 1) % count)
        close = "; leave out the last, the outline closes automatically" if j == 0 else ""
        raise ConfigurationError(
            f"outline.points {i} and {j} are the same point, so the side between them has no "
            f"length{close}"
        )
    squared = (step**2).sum(axis=1)
    numbers = np.arange(count)
    for i, (point, next_point) in enumerate(zip(points, points + step, strict=True)):
        apart = [(i - numbers) % count > 1, (numbers - i) % count > 1]
        away = point - points
        along = np.clip((away * step).sum(axis=1) / squared, 0.0, 1.0)
        gap = np.linalg.norm(away - along[:, None] * step, axis=1)
        touched = (gap <= same) & (numbers != i) & ((numbers + 1) % count != i)
        # Sides cross where the ends of each lie on different sides of the other.
        ends = [_cross(step, p - points) for p in (point, next_point)]
        other = [_cross(step[i], p - point) for p in (points, points + step)]
        crossed = (ends[0] * ends[1] < 0.0) & (other[0] * other[1] < 0.0)
        wrong = np.flatnonzero(touched | (crossed & apart[0] & apart[1]))
        if wrong.size:
            raise ConfigurationError(
                f"the outline touches or crosses itself: its side from point {i} meets the one "
                f"from point {wrong[0]}; give the points in order around the outline, each once"
            )


def _cross(a: Array, b: Array) -> Array:
    product: Array = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    return product
