"""Flat electrode contacts: on top, at the bottom, inside the layer, and on surfaces."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eitskin.errors import ConfigurationError
from eitskin.geometry.design.electrode import Electrode
from eitskin.geometry.design.outline import Disc, PlaneOutline
from eitskin.geometry.design.patches import Patch, Region, area_vectors, on_boundary
from eitskin.geometry.design.surface import Surface

Array = NDArray[np.float64]

_SAME = 1e-9  # distance of points that count as one, relative to the size of the body
_LEVEL = 0.9  # of a normal's z, above which a surface counts as level
_COVERED = 0.9  # share of a pad that must lie on the surface
_X, _UP = np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True, slots=True, eq=False)
class Pad:
    """Flat contact: a convex polygon, or its projection onto a surface.

    Attributes:
        on: as in `Electrode`.
        corners: counter-clockwise seen from outside, (k, 3) [m].
        normal: outward unit vector, (3,).
        depth: largest distance of the contacted boundary from the plane of the pad [m].
        area: of the contact [m2].
    """

    on: str
    corners: Array
    normal: Array
    depth: float
    area: float

    @property
    def centre(self) -> Array:
        """Middle of the pad, (3,) [m]."""
        middle: Array = self.corners.mean(axis=0)
        return middle

    @property
    def reach(self) -> float:
        """Radius about the centre that contains the pad [m]."""
        return float(np.linalg.norm(self.corners - self.centre, axis=1).max())

    def patch(self) -> Patch:
        """Contact patch: a sheet inside the body, or a prism that cuts its boundary."""
        if self.on == "inside":
            return Patch((), self.area, self.corners)
        return Patch((_prism(self.corners, self.normal, self.depth),), self.area)

    def edges(self, spacing: float) -> Array:
        """Points along the rim of the pad, (k, 3) [m], at most `spacing` [m] apart."""
        step = np.roll(self.corners, -1, axis=0) - self.corners
        lines = []
        for start, along in zip(self.corners, step, strict=True):
            count = max(1, math.ceil(float(np.linalg.norm(along)) / spacing - 1e-9))
            lines.append(start + np.arange(count)[:, None] / count * along)
        return np.concatenate(lines)


def on_plane(electrode: Electrode, outline: PlaneOutline, thickness: float) -> Pad:
    """Pad of an electrode on top, at the bottom or inside.

    Raises ConfigurationError where the pad reaches beyond the outline or out of the layer.
    """
    footprint = electrode.footprint()
    plane = np.add(footprint, (electrode.x, electrode.y))
    excess = beyond(outline, plane)
    if excess > 0.0:
        raise ConfigurationError(
            f"its pad of {np.ptp(plane[:, 0]):g} x {np.ptp(plane[:, 1]):g} m about "
            f"({electrode.x:g}, {electrode.y:g}) m reaches {excess:g} m beyond the outline; move "
            "it inwards or make it smaller"
        )
    z = {"top": thickness, "bottom": 0.0}.get(electrode.on, electrode.z or 0.0)
    if electrode.on == "inside" and not 0.0 < z < thickness:
        raise ConfigurationError(
            f"its z must lie within the layer, above 0 and below {thickness:g} m, got {z:g} m; for "
            'the faces themselves say on = "top" or "bottom"'
        )
    corners = np.column_stack([plane, np.full(len(plane), z)])
    normal = _UP
    if electrode.on == "bottom":
        corners, normal = corners[::-1], -_UP
    return Pad(electrode.on, corners, normal, 0.5 * thickness, _area(footprint))


def on_surface(electrode: Electrode, surface: Surface) -> Pad:
    """Pad of an electrode on a surface; raises ConfigurationError where the pad lies off it."""
    given = np.array([electrode.x, electrode.y, electrode.z or 0.0])
    centre, normal = surface.nearest(given)
    footprint = electrode.footprint()
    off = float(np.linalg.norm(centre - given))
    if off > np.abs(footprint).max(axis=0).min():
        raise ConfigurationError(
            f"its centre is {off:g} m off the surface; the nearest point on it is "
            f"({centre[0]:.6g}, {centre[1]:.6g}, {centre[2]:.6g}) m"
        )
    points, faces = surface.triangles()
    # Faces differ from each other: take the mean normal of those under the pad.
    for _ in range(2):
        corners = centre + footprint @ tangents(normal)
        depth = float(np.linalg.norm(footprint, axis=1).max())
        vectors = _within(points[faces], _prism(corners, normal, depth))
        normal = vectors.sum(axis=0) / np.linalg.norm(vectors.sum(axis=0))
    covered, area = float(np.linalg.norm(vectors, axis=1).sum()), _area(footprint)
    if covered < _COVERED * area:
        raise ConfigurationError(
            f"only {covered / area:.0%} of its pad lies on the surface: it passes a sharp edge or "
            "is too large for the body; move it or make it smaller"
        )
    return Pad("surface", corners, normal, depth, covered)


def beyond(outline: PlaneOutline, corners: Array) -> float:
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
    return excess if excess > _SAME * max(outline.length, outline.width) else 0.0


def half_planes(corners: Array) -> Array:
    """Half-planes (k, 3) of a counter-clockwise convex polygon (k, 2) [m].

    The polygon is {x: planes[:, :2] @ x <= planes[:, 2]}.
    """
    step = np.roll(corners, -1, axis=0) - corners
    outward = np.column_stack([step[:, 1], -step[:, 0]]) / np.hypot(*step.T)[:, None]
    return np.column_stack([outward, (outward * corners).sum(axis=1)])


def _prism(corners: Array, normal: Array, depth: float) -> Region:
    """Prism over and under a plane convex polygon (k, 3) [m], up to `depth` [m] from it."""
    along = np.roll(corners, -1, axis=0) - corners
    outward = np.cross(along, normal)
    outward = np.concatenate([outward, [normal, -normal]])
    outward /= np.linalg.norm(outward, axis=1)[:, None]
    points = np.concatenate([corners, [corners[0] + depth * normal, corners[0] - depth * normal]])
    return Region(np.column_stack([outward, (outward * points).sum(axis=1)]), normal)


def _within(triangles: Array, region: Region) -> Array:
    """Area times normal, (k, 3) [m2], of the parts of triangles (n, 3, 3) in a region."""
    normals = area_vectors(triangles)
    normals /= np.maximum(np.linalg.norm(normals, axis=1), np.finfo(float).tiny)[:, None]
    snap = _SAME * float(np.ptp(triangles))
    pieces = on_boundary(triangles, normals, np.arange(len(triangles)), region, snap)
    return area_vectors(pieces.polygons)


def tangents(normal: Array) -> Array:
    """Unit vectors of width and height in the plane with this normal, (2, 3).

    The width is horizontal, as on the side of a layer; on a level surface it is along x, as on
    top of a layer.
    """
    width = np.cross(_UP, normal) if abs(normal[2]) < _LEVEL else _X - normal[0] * normal
    width /= np.linalg.norm(width)
    return np.stack([width, np.cross(normal, width)])


def _area(corners: Array) -> float:
    """Area of a polygon (k, 2) [m2], by the shoelace formula."""
    x, y = corners.T
    return 0.5 * float((x * np.roll(y, -1) - np.roll(x, -1) * y).sum())
