"""Graded triangulation of plane outlines by Delaunay refinement."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import Delaunay, cKDTree

from eitskin.errors import ConfigurationError
from eitskin.geometry.design.inclusion import Inclusion
from eitskin.geometry.design.outline import Disc, PlaneOutline

Array = NDArray[np.float64]
Numbers = NDArray[np.int64]
Flags = NDArray[np.bool_]

# Circumradius over shortest edge is 1 / (2 sin) of the smallest angle, here 28 degrees.
_MAX_CIRCUMRADIUS_RATIO = 0.5 / np.sin(np.radians(28.0))
_CHORDS = 24  # fewest chords of a circle
_MAX_ROUNDS = 300
_MAX_POINTS = 500_000
_PER_SIZE = 1.0 / np.sqrt(3.0)  # points in twice the square of an edge, of equilateral triangles
_ORIGIN: Array = np.zeros(2)
_NOWHERE: Array = np.empty(0)
_RELATIVE_TOLERANCE = 1e-9  # relative distance of points and lengths that count as equal


def triangulate(
    outline: PlaneOutline,
    fixed_points: Array,
    size: Callable[[Array], Array],
    inclusions: Sequence[Inclusion] = (),
) -> tuple[Array, Numbers]:
    """Graded Delaunay triangulation of an outline with no edge longer than `size`.

    Circumcentres of too large or too thin triangles are inserted into a Delaunay triangulation;
    chords of the rim that such a point encroaches upon are halved instead (Ruppert 1995). Next to
    corners below 60 degrees chords are split at distances that are powers of two, and triangles
    across such a corner keep their angles (Miller, Pav & Walkington 2003). All other angles are at
    least 28 degrees. The same input gives the same triangles.

    Args:
        outline: outline of the layer. On a disc all points of the rim are on the circle.
        fixed_points: arc lengths of required points of the rim, besides the corners, (k,) [m].
        size: largest edge lengths (n,) [m] at the middles of triangles, (n, 2) [m].
        inclusions: whose rims no triangle crosses.

    Returns:
        points: (n, 2), by rising x [m].
        triangles: (m, 3) point numbers, counter-clockwise.

    Raises ConfigurationError for more than half a million points, and where electrode ends and
    corners allow no triangulation.
    """
    rims, inner = [_Rim.from_outline(outline, fixed_points)], np.empty((0, 2))
    rims += [_Rim.from_outline(each.mesh_outline, each.marks, each.origin) for each in inclusions]
    for _ in range(_MAX_ROUNDS):
        rims = _clear_of_all(rims, inner)
        points = np.concatenate([*(rim.positions for rim in rims), inner])
        triangles = _inside(outline, points)
        corners = points[triangles]
        centres, radii = _circumcircles(corners)
        edges = _edges(corners)
        largest = size(corners.mean(axis=1))
        _require_few(_PER_SIZE * float((_doubled_areas(corners) / largest**2).sum()))
        poor = radii > _MAX_CIRCUMRADIUS_RATIO * edges.min(axis=1)
        poor &= ~rims[0].joins_acute_corner(triangles, edges)
        poor |= edges.max(axis=1) > largest * (1.0 + _RELATIVE_TOLERANCE)
        if not poor.any():
            return numbered_along_x(points, triangles)
        chosen = np.flatnonzero(poor)[_independent_circles(centres[poor], radii[poor])]
        accepted = centres[chosen]
        for number, rim in enumerate(rims):
            rims[number], accepted = rim.split_at_centres(accepted, beyond=number > 0)
        inner = np.concatenate([inner, accepted])
    raise ConfigurationError(
        f"no triangulation with angles of 28 degrees was found in {_MAX_ROUNDS} rounds; move "
        "electrode ends away from each other and from the outline's corners"
    )


def layer_surface(
    outline: PlaneOutline, thickness: float, longest: float, fixed_points: Array = _NOWHERE
) -> tuple[Array, Numbers]:
    """Points (n, 3) [m] and faces (k, 3) of a layer, counter-clockwise seen from outside.

    No edge in the plane is longer than `longest` [m]; of the rim as for `triangulate`.
    """
    plane, lower = triangulate(
        outline, fixed_points, lambda middles: np.full(len(middles), longest)
    )
    count = len(plane)
    bottom, top = (np.column_stack([plane, np.full(count, z)]) for z in (0.0, thickness))
    # The rim's edges are those that no other triangle runs through the other way.
    sides = lower[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    lone = ~np.isin(sides @ [count, 1], sides[:, ::-1] @ [count, 1])
    a, b = sides[lone].T
    walls = [np.column_stack([a, b, b + count]), np.column_stack([a, b + count, a + count])]
    return np.concatenate([bottom, top]), np.concatenate([lower[:, ::-1], lower + count, *walls])


def _clear_of_all(rims: list["_Rim"], inner: Array) -> list["_Rim"]:
    """Rims of which no chord has a point of the others, or an inner one, in its circle."""
    while True:
        positions = [rim.positions for rim in rims]
        cleared = [
            rim.split_encroached(np.concatenate([*positions[:k], *positions[k + 1 :], inner]))
            for k, rim in enumerate(rims)
        ]
        if all(len(a.arc) == len(b.arc) for a, b in zip(rims, cleared, strict=True)):
            return cleared
        rims = cleared


@dataclass(frozen=True, slots=True, eq=False)
class _Rim:
    """Points of the rim by rising arc length, and acute corners.

    Attributes:
        outline: outline of the layer.
        arc: lengths within one turn, (n,) [m].
        acute: whether each corner is below 60 degrees, seen from inside or outside, (c,).
        origin: origin of the outline, (2,) [m].
    """

    outline: PlaneOutline
    arc: Array
    acute: Flags
    origin: Array

    @classmethod
    def from_outline(cls, outline: PlaneOutline, points: Array, origin: Array = _ORIGIN) -> "_Rim":
        whole = outline.perimeter
        marks = np.mod(points, whole)
        if isinstance(outline, Disc):
            arc = _cut_evenly(np.sort(marks) if len(marks) else np.zeros(1), whole)
            acute = np.zeros(0, dtype=bool)
        else:
            gap = np.abs(marks[:, None] - outline.corners)
            off = (np.minimum(gap, whole - gap) > _RELATIVE_TOLERANCE * whole).all(axis=1)
            arc = np.sort(np.concatenate([outline.corners, marks[off]]))
            side = np.roll(outline.vertices, -1, axis=0) - outline.vertices
            side /= np.linalg.norm(side, axis=1)[:, None]
            acute = -(side * np.roll(side, 1, axis=0)).sum(axis=1) > 0.5 + _RELATIVE_TOLERANCE
        apart = np.diff(arc, append=arc[0] + whole) > _RELATIVE_TOLERANCE * whole
        return cls(outline, arc[apart], acute, origin)

    @property
    def positions(self) -> Array:
        """Positions of the points, (n, 2) [m]."""
        return self.outline.rim_points(self.arc) + self.origin

    def split_encroached(self, inner: Array) -> "_Rim":
        """Halve chords until none has a point within its diametral circle.

        All chords are then edges of the Delaunay triangulation.
        """
        rim = self
        while True:
            middle, radius = rim._circles()
            nearest, _ = cKDTree(np.concatenate([rim.positions, inner])).query(middle)
            close = nearest < radius * (1.0 - 1e-6)
            if not close.any():
                return rim
            rim = rim._split(close)
            _require_few(len(rim.arc))

    def split_at_centres(self, centres: Array, beyond: bool = False) -> tuple["_Rim", Array]:
        """Split the chords that `centres` (k, 2) encroach upon; return the other centres too.

        Those beyond the rim split the nearest chord, unless points `beyond` it are wanted.
        """
        middle, radius = self._circles()
        struck = cKDTree(centres).query_ball_point(middle, radius)
        split = np.array([len(numbers) > 0 for numbers in struck])
        free = np.ones(len(centres), dtype=bool)
        free[[number for numbers in struck for number in numbers]] = False
        lost = free & (not beyond) & ~self.outline.contains(centres - self.origin)
        split[cKDTree(middle).query(centres[lost])[1]] = True
        return self._split(split), centres[free & ~lost]

    def joins_acute_corner(self, triangles: Numbers, edges: Array) -> Flags:
        """Whether the shortest edge of each triangle joins the two sides of an acute corner."""
        if not self.acute.any():
            return np.zeros(len(triangles), dtype=bool)
        first = edges.argmin(axis=1)[:, None]
        ends = np.take_along_axis(triangles, np.hstack([first, first - 1]), axis=1)
        on_rim = ends.max(axis=1) < len(self.arc)
        arc = self.arc[np.where(on_rim[:, None], ends, 0)]
        a, b = np.searchsorted(self.outline.corners, arc, side="right").T - 1
        next_a, next_b = (a + 1) % len(self.acute), (b + 1) % len(self.acute)
        across: Flags = (self.acute[b] & (next_a == b)) | (self.acute[a] & (next_b == a))
        across &= on_rim & ~np.isin(arc, self.outline.corners).any(axis=1)
        return across

    def _circles(self) -> tuple[Array, Array]:
        """Centres (n, 2) and radii (n,) of the diametral circles of the chords [m]."""
        start = self.positions
        end = np.roll(start, -1, axis=0)
        return 0.5 * (start + end), 0.5 * np.linalg.norm(end - start, axis=1)

    def _split(self, which: Flags) -> "_Rim":
        whole = self.outline.perimeter
        start = self.arc[which]
        end = np.append(self.arc[1:], self.arc[0] + whole)[which]
        half = 0.5 * (end - start)
        # Equal distances on both sides of an acute corner, so that the sides stop splitting
        # each other.
        shell = np.exp2(np.round(np.log2(half)))
        sharp = np.asarray(self.outline.corners)[self.acute]
        at_start, at_end = np.isin(start, sharp), np.isin(np.mod(end, whole), sharp)
        middle = np.where(at_start, start + shell, np.where(at_end, end - shell, start + half))
        arc = np.sort(np.concatenate([self.arc, np.mod(middle, whole)]))
        return replace(self, arc=arc)


def _cut_evenly(marks: Array, whole: float) -> Array:
    """Arc lengths on a circle that include the `marks` (k,), in steps of at most a chord."""
    gaps = np.diff(marks, append=marks[0] + whole)
    counts = np.ceil(gaps * _CHORDS / whole - _RELATIVE_TOLERANCE).astype(int)
    parts = [m + g * np.arange(n) / n for m, g, n in zip(marks, gaps, counts, strict=True) if n]
    return np.sort(np.mod(np.concatenate(parts), whole))


def _inside(outline: PlaneOutline, points: Array) -> Numbers:
    """Delaunay triangles (m, 3) of points (n, 2) within the outline, counter-clockwise."""
    triangles = Delaunay(points / np.ptp(points)).simplices.astype(np.int64)
    corners = points[triangles]
    doubled = _doubled_areas(corners)
    triangles[doubled < 0.0] = triangles[doubled < 0.0][:, ::-1]
    # Points on a straight side give triangles without area.
    real = np.abs(doubled) > _RELATIVE_TOLERANCE * _edges(corners).max(axis=1) ** 2
    inside: Numbers = triangles[real & outline.contains(corners.mean(axis=1))]
    return inside


def _circumcircles(corners: Array) -> tuple[Array, Array]:
    """Circumcentres (m, 2) and circumradii (m,) [m] of triangles (m, 3, 2)."""
    u, v = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    uu, vv = (u**2).sum(axis=1), (v**2).sum(axis=1)
    away = np.column_stack([v[:, 1] * uu - u[:, 1] * vv, u[:, 0] * vv - v[:, 0] * uu])
    away /= 2.0 * _doubled_areas(corners)[:, None]
    return corners[:, 0] + away, np.hypot(*away.T)


def _doubled_areas(corners: Array) -> Array:
    """Twice the areas (m,) [m2] of triangles (m, 3, 2), positive counter-clockwise."""
    u, v = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    doubled: Array = u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]
    return doubled


def _edges(corners: Array) -> Array:
    """Lengths (m, 3) [m] of the edges that end at each corner of triangles (m, 3, 2)."""
    lengths: Array = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)
    return lengths


def _independent_circles(centres: Array, radii: Array) -> Numbers:
    """Circumcentres that can be inserted at once, larger circles before smaller ones.

    No chosen centre lies in the circle of a smaller one that is chosen.
    """
    within = cKDTree(centres).query_ball_point(centres, radii * (1.0 - _RELATIVE_TOLERANCE))
    chosen = np.zeros(len(radii), dtype=bool)
    for number in np.argsort(-radii, kind="stable"):
        chosen[number] = not chosen[within[number]].any()
    return np.flatnonzero(chosen)


def numbered_along_x(points: Array, cells: Numbers) -> tuple[Array, Numbers]:
    """Mesh renumbered with its points (n, d) by rising x, then y, for narrow matrices."""
    order = np.lexsort(points.T[::-1])
    number = np.empty_like(order)
    number[order] = np.arange(len(order))
    return points[order], number[cells]


def _require_few(count: float) -> None:
    if count > _MAX_POINTS:
        raise ConfigurationError(
            f"a triangulation of more than {_MAX_POINTS} points was asked for; choose a larger "
            "finest or coarsest size, or more growth"
        )
