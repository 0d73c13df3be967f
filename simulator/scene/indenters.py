"""Indenters: convex rigid bodies of revolution, given as height maps, and flat punches."""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from eitskin.bounds import LONGEST, require_length
from eitskin.errors import ConfigurationError
from eitskin.geometry.design.surface import Surface

Array = NDArray[np.float64]

# Walls are as steep as this at most: 80 degrees, so that every indenter is a height map.
_MAX_WALL_SLOPE = math.tan(math.radians(80.0))
_PROJECTIONS = 12
_MAX_WIDTH = 0.5  # m; no finger or tool is wider, but 1 mm written as 1 is
_MIN_WIDTH = 1e-4  # m, a needle; the mesh of a sharper contact has more cells than memory holds
_CLOSEST = 1e-9  # m, between radii of a profile, whose slope is a quotient
_SHARPEST = 1e-3  # radius of a rim over that of the cylinder, for the same reason
_RADII, _AZIMUTHS = 48, 72
_ROUND_CORNERS = 64  # of an ellipse
_UPRIGHT = 0.02  # facets of the hull whose normals point down by less are its wall
_ROUND = 0.1  # largest difference of height round the axis, of the radius


class Indenter(ABC):
    """Convex body of revolution with a vertical axis."""

    __slots__ = ()

    @property
    @abstractmethod
    def rough(self) -> bool:
        """Whether the indenter sticks to the touched face; else contact is frictionless."""

    @property
    @abstractmethod
    def rims(self) -> tuple[float, float]:
        """Smallest and largest radius at which contact may end under any load [m]."""

    @abstractmethod
    def profile(self, r: Array) -> tuple[Array, Array, Array]:
        """Height h(r) over the lowest point [m], dh/dr, and d2h/dr2 [1/m] at distance r [m]."""

    def reach(self, directions: Array) -> Array:
        """Farthest distance from the touch along unit vectors (n, 2) [m], (n,)."""
        return np.full(np.shape(directions)[:-1], self.rims[1])


@dataclass(frozen=True, slots=True)
class Cylinder(Indenter):
    """Flat-ended cylinder.

    Attributes:
        radius: radius of the cylinder [m].
        edge: radius of the rounded rim over the radius of the cylinder.

    Example:
        >>> from eitskin.simulator import Cylinder, Touch
        >>> Touch(0.075, 0.030, indenter=Cylinder(radius=0.010)).indenter.radius
        0.01
    """

    radius: float = 0.0075
    edge: float = 0.05
    rough: bool = True

    def __post_init__(self) -> None:
        _require_radius(self.radius)
        if not _SHARPEST <= self.edge <= 1.0:
            raise ConfigurationError(
                f"the rim of a cylinder needs an edge from {_SHARPEST:g} to 1 of its radius, got "
                f"{self.edge}"
            )

    @property
    def rims(self) -> tuple[float, float]:
        return self.radius * (1.0 - self.edge), self.radius

    def profile(self, r: Array) -> tuple[Array, Array, Array]:
        rounding = self.edge * self.radius
        return _arc(np.maximum(r - self.radius + rounding, 0.0), rounding)


@dataclass(frozen=True, slots=True)
class Sphere(Indenter):
    """Ball, or rod with a hemispherical end.

    Attributes:
        radius: radius of the ball [m].
        shape: distinguishes a sphere from a cylinder in files.

    Example:
        >>> from eitskin.simulator import Sphere, Touch
        >>> Touch(0.075, 0.030, depth=0.003, indenter=Sphere(0.008)).indenter.shape
        'sphere'
    """

    radius: float
    rough: bool = True
    shape: Literal["sphere"] = "sphere"

    def __post_init__(self) -> None:
        _require_radius(self.radius)

    @property
    def rims(self) -> tuple[float, float]:
        return 0.0, self.radius

    def profile(self, r: Array) -> tuple[Array, Array, Array]:
        return _arc(r, self.radius)


@dataclass(frozen=True, slots=True)
class Profile(Indenter):
    """Convex body of revolution given by heights at some radii.

    The slope is linear between the middles of the segments, so that the surface is smooth; past
    the last radius there is a wall.

    Attributes:
        radii: radii, rising from 0 [m].
        heights: heights over the lowest point, from 0, with rising slope [m].

    Example:
        >>> from eitskin.simulator import Profile
        >>> Profile(radii=(0.0, 0.004, 0.008), heights=(0.0, 0.001, 0.004)).rough
        True
    """

    radii: tuple[float, ...]
    heights: tuple[float, ...]
    rough: bool = True

    def __post_init__(self) -> None:
        """Check that the heights are those of a convex body."""
        r, h = np.array(self.radii, dtype=float), np.array(self.heights, dtype=float)
        if len(r) < 2 or r.shape != h.shape:
            raise ConfigurationError(
                "a profile needs two or more radii and as many heights, got "
                f"{len(self.radii)} and {len(self.heights)}"
            )
        if not np.all(np.abs([r, h]) <= LONGEST):
            raise ConfigurationError(
                f"a profile needs radii and heights up to {LONGEST:g} m, got radii {self.radii} "
                f"and heights {self.heights}"
            )
        if r[0] != 0.0 or h[0] != 0.0 or np.any(np.diff(r) < _CLOSEST):
            raise ConfigurationError(
                f"a profile starts with radius 0 and height 0, and its radii rise by {_CLOSEST:g} "
                f"m at least; got radii {self.radii} and first height {h[0]}"
            )
        _require_radius(self.radii[-1])
        slopes = np.diff(h) / np.diff(r)
        if slopes[0] < 0.0 or np.any(np.diff(slopes) < -1e-9 * (1.0 + np.abs(slopes[1:]))):
            raise ConfigurationError(
                "a profile must be convex: its slope never falls, got slopes "
                f"{', '.join(f'{s:g}' for s in slopes)}"
            )

    @property
    def rims(self) -> tuple[float, float]:
        h = np.array(self.heights)
        flat = float(np.array(self.radii)[np.flatnonzero(h <= 1e-9 * h.max() + 0.0)[-1]])
        return flat, self.radii[-1]

    def profile(self, r: Array) -> tuple[Array, Array, Array]:
        radii, heights = np.array(self.radii), np.array(self.heights)
        middles = 0.5 * (radii[1:] + radii[:-1])
        slopes = np.minimum(np.diff(heights) / np.diff(radii), _MAX_WALL_SLOPE)
        end = radii[-1]
        knots = np.concatenate([[0.0], middles, [end, 1.02 * end]])
        values = np.concatenate([slopes[:1], slopes, slopes[-1:], [_MAX_WALL_SLOPE]])
        # Piecewise linear slope: heights at the knots by the trapezoidal rule, parabolas between.
        at_knots = np.concatenate(
            [[0.0], np.cumsum(0.5 * (values[1:] + values[:-1]) * np.diff(knots))]
        )
        piece = np.clip(np.searchsorted(knots, r, side="right") - 1, 0, len(knots) - 1)
        bends = np.append(np.diff(values) / np.diff(knots), 0.0)
        along = r - knots[piece]
        slope = values[piece] + bends[piece] * along
        height = at_knots[piece] + (values[piece] + 0.5 * bends[piece] * along) * along
        return height, slope, bends[piece]


@dataclass(frozen=True, slots=True)
class Footprint(Indenter):
    """Flat-ended punch of a convex footprint: a rectangle, an ellipse or a polygon.

    The force acts at the position of the touch. A polygon around another point than its middle
    tilts, and may leave the contact in part.

    Attributes:
        length: extent of a rectangle, or diameter of an ellipse [m].
        width: extent across the length, or the other diameter [m].
        angle_deg: angle from the sensor's x axis to the length.
        round: whether it is an ellipse.
        corners: corners of a polygon, (x, y) from where the force acts [m]; instead of the length
            and width.

    Example:
        >>> from eitskin.simulator import Footprint, Touch
        >>> Touch(0.075, 0.030, indenter=Footprint(length=0.020, width=0.010)).indenter.round
        False
    """

    length: float = 0.0
    width: float = 0.0
    angle_deg: float = 0.0
    round: bool = False
    corners: tuple[tuple[float, float], ...] = ()
    rough: bool = True

    def __post_init__(self) -> None:
        """Check that the footprint is convex, and neither a needle nor wider than any tool."""
        if bool(self.corners) == bool(self.length or self.width):
            raise ConfigurationError(
                "a footprint has a length and a width, or corners, got "
                f"{self.length:g} x {self.width:g} m and {len(self.corners)} corners"
            )
        if not self.corners:
            for name in ("length", "width"):
                _require_radius(0.5 * getattr(self, name))
            return
        points = np.array(self.corners, dtype=float)
        if len(points) < 3 or not np.all(np.abs(points) <= _MAX_WIDTH):
            raise ConfigurationError(
                f"a footprint needs three or more corners within {_MAX_WIDTH:g} m, got "
                f"{self.corners}"
            )
        steps = np.roll(points, -1, axis=0) - points
        ahead = np.roll(steps, -1, axis=0)
        turns = steps[:, 0] * ahead[:, 1] - steps[:, 1] * ahead[:, 0]
        turns *= np.sign(turns.sum())
        if not turns.min() > -_CLOSEST * _MAX_WIDTH or not self.rims[1] > _MIN_WIDTH:
            raise ConfigurationError(
                f"the corners of a footprint must go round a convex area, got {self.corners}"
            )

    @property
    def outline(self) -> Array:
        """Corners in the frame of the length, (n, 2) [m]; an ellipse has 64."""
        if self.corners:
            return np.array(self.corners, dtype=float)
        half = 0.5 * np.array([self.length, self.width])
        if not self.round:
            square = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
            return np.asarray(half * square)
        turn = np.arange(_ROUND_CORNERS) * (2.0 * np.pi / _ROUND_CORNERS)
        # As large as the ellipse.
        grown = math.sqrt(2.0 * np.pi / _ROUND_CORNERS / math.sin(2.0 * np.pi / _ROUND_CORNERS))
        return np.asarray(grown * half * np.stack([np.cos(turn), np.sin(turn)], axis=1))

    @property
    def middle(self) -> Array:
        """Centroid in the frame of the length, (2,) [m]."""
        x, y = self.outline.T
        parts = x * np.roll(y, -1) - y * np.roll(x, -1)
        sums = [float(np.sum(parts * (at + np.roll(at, -1)))) for at in (x, y)]
        return np.asarray(np.array(sums) / (3.0 * parts.sum()))

    @property
    def is_aligned(self) -> bool:
        """Whether its edges run along the sensor's x and y."""
        return not (self.corners or self.round or self.angle_deg % 90.0)

    @property
    def slenderness(self) -> float:
        """Largest extent over the width of the largest circle about its middle."""
        corners = self.outline - self.middle
        widest = 2.0 * float(np.linalg.norm(corners, axis=1).max())
        return widest / (2.0 * float(self.depth_inside(self.middle)))

    @property
    def rotation(self) -> Array:
        """Turn of the frame of the length to the sensor's, (2, 2)."""
        angle = math.radians(self.angle_deg)
        return np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])

    @property
    def rims(self) -> tuple[float, float]:
        return self._as_large.rims

    def profile(self, r: Array) -> tuple[Array, Array, Array]:
        return self._as_large.profile(r)

    def reach(self, directions: Array) -> Array:
        return np.asarray((directions @ self.rotation @ self.outline.T).max(axis=1))

    def depth_inside(self, points: Array) -> Array:
        """Distance of points (..., 2) within the frame of the length to the nearest edge [m].

        It is negative outside.
        """
        corners = self.outline
        steps = np.roll(corners, -1, axis=0) - corners
        inward = np.stack([-steps[:, 1], steps[:, 0]], axis=1) * np.sign(_area(corners))
        inward /= np.linalg.norm(inward, axis=1, keepdims=True)
        return np.asarray((points @ inward.T - (corners * inward).sum(axis=1)).min(axis=-1))

    @property
    def _as_large(self) -> Cylinder:
        """Cylinder of the same area."""
        return Cylinder(math.sqrt(abs(_area(self.outline)) / math.pi), rough=self.rough)


def _area(corners: Array) -> float:
    """Area of a polygon (n, 2) [m2], positive where it goes round anticlockwise."""
    x, y = corners.T
    return 0.5 * float(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)))


def distance(one: Indenter, other: Indenter, step: Array) -> float:
    """Distance between two indenters whose touches are a step (2,) apart [m], negative inside."""
    turn = np.arange(_AZIMUTHS) * (2.0 * np.pi / _AZIMUTHS) + math.atan2(step[1], step[0])
    directions = np.stack([np.cos(turn), np.sin(turn)], axis=1)
    # Convex bodies are as far apart as the parallel planes between them.
    gaps = directions @ step - one.reach(directions) - other.reach(-directions)
    return float(gaps.max())


def penetration(
    indenter: Indenter, r: Array, height: Array
) -> tuple[Array, tuple[Array, Array], Array]:
    """Penetration of points at distance r and a height over the lowest point into an indenter.

    Returns the distance g to the surface, positive inside [m]; the gradient of g, radial and
    upward; and the second derivative of g along the surface, across the gradient [1/m].
    """
    h, slope, bend = indenter.profile(r)
    inside = height > h
    # The foot s of the normal through a point: (s - r) + (h(s) - height) h'(s) = 0.
    s = r.copy()
    for _ in range(_PROJECTIONS):
        offset = s - r + (h - height) * slope
        rate = 1.0 + slope**2 + np.maximum((h - height) * bend, -0.5)
        s = np.maximum(s - offset / rate, 0.0)
        h, slope, bend = indenter.profile(s)
    distance = np.hypot(s - r, h - height)
    length = np.hypot(1.0, slope)
    g = np.where(inside, distance, -distance)
    curvature = bend / length**3
    return g, (-slope / length, 1.0 / length), -curvature / np.maximum(1.0 - curvature * g, 0.1)


def _require_radius(radius: float) -> None:
    """Raise ConfigurationError unless `radius` [m] is that of a needle, or a wider tool."""
    require_length("indenter radius", radius, _MAX_WIDTH)
    if radius < _MIN_WIDTH:
        raise ConfigurationError(
            f"indenter radius must be at least {_MIN_WIDTH * 1e3:g} mm, got {radius:g} m; lengths "
            "are in metres, so 5 mm is 0.005"
        )


def _arc(s: Array, radius: float) -> tuple[Array, Array, Array]:
    """Circular arc, level at s = 0, continued by a straight line from the steepest slope on."""
    last = radius * _MAX_WALL_SLOPE / math.hypot(1.0, _MAX_WALL_SLOPE)
    on_arc = np.minimum(s, last)
    root = np.sqrt(radius**2 - on_arc**2)
    slope = on_arc / root
    height = on_arc**2 / (radius + root) + _MAX_WALL_SLOPE * (s - on_arc)
    return height, slope, np.where((s > 0.0) & (s < last), radius**2 / root**3, 0.0)


@dataclass(frozen=True, slots=True)
class ScannedIndenter(Indenter):
    """Lower side of the convex hull of a closed surface, such as a scanned fingertip.

    The axis is upright through the lowest point, z up. Heights are averaged round the axis.

    Attributes:
        file: path of the surface (STL, OBJ, PLY, OFF ...); made absolute.
        scale: metres per unit of the file, 1e-3 for millimetres.
    """

    file: Path
    scale: float = 1.0
    rough: bool = True

    def __post_init__(self) -> None:
        """Load the surface; raises ConfigurationError where the surface is no indenter."""
        object.__setattr__(self, "file", Path(self.file).absolute())
        self._profile()

    @property
    def rims(self) -> tuple[float, float]:
        return self._profile().rims

    def profile(self, r: Array) -> tuple[Array, Array, Array]:
        return self._profile().profile(r)

    def _profile(self) -> Profile:
        return _surface_profile(Surface(self.file, self.scale), self.rough)


@lru_cache(maxsize=16)
def _surface_profile(surface: Surface, rough: bool) -> Profile:
    """Mean profile of the hull; raises ConfigurationError where the hull is far from round."""
    points, _ = surface.triangles()
    hull = ConvexHull(points)
    corners = points[hull.vertices]
    low = corners[corners[:, 2] < corners[:, 2].min() + 1e-6 * np.ptp(corners[:, 2])]
    tip = (low.min(axis=0) + low.max(axis=0)) / 2.0
    azimuth = np.arange(_AZIMUTHS) * (2.0 * np.pi / _AZIMUTHS)
    directions = np.stack([np.cos(azimuth), np.sin(azimuth)])
    # Largest radius that the body reaches in every direction.
    radius = float(((corners - tip)[:, :2] @ directions).max(axis=0).min())
    if radius <= 0.0:
        raise ConfigurationError(
            f"the indenter in {surface.file.name} must reach outwards from its lowest point in "
            "every direction; turn it so that it presses, downwards, with the side that is meant to"
        )
    r = np.linspace(0.0, radius, _RADII)
    # The lower side of a convex body is the highest of the planes of its lower facets.
    normals, offset = hull.equations[:, :3], hull.equations @ np.append(tip, 1.0)
    under = normals[:, 2] < -_UPRIGHT
    along = normals[under, :2] @ directions
    planes = -(np.multiply.outer(r, along) + offset[under, None]) / normals[under, 2, None]
    heights = np.maximum(planes.max(axis=1), 0.0)
    spread = np.ptp(heights, axis=1).max()
    if spread > _ROUND * radius:
        raise ConfigurationError(
            f"the indenter in {surface.file.name} must be round about an upright axis through its "
            f"lowest point, z up: its height differs by {spread:.2g} m round the axis, more than "
            f"{_ROUND:.0%} of its radius of {radius:.2g} m. Turn it, or give a cylinder, sphere "
            "or profile near it"
        )
    mean = heights.mean(axis=1)
    return Profile(tuple(r.tolist()), tuple((mean - mean[0]).tolist()), rough)
