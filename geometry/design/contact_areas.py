"""Contact areas of electrodes: strips on the side of a layer, pads on top, inside, on surfaces."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eitskin.errors import ConfigurationError
from eitskin.geometry.design.electrode import Electrode
from eitskin.geometry.design.outline import Disc, Outline, PlaneOutline, half_planes, overhang
from eitskin.geometry.design.patches import Patch, Region, area_vectors, on_boundary
from eitskin.geometry.design.surface import Surface

Array = NDArray[np.float64]

_MAX_ARC = 0.5  # of one region [rad]
_MAX_DEPTH = 0.1  # largest depth of a region behind its side, relative to the perimeter
_POINT_TOLERANCE = 1e-9  # distance of points that count as one, relative to the size of the body
_LEVEL = 0.9  # of a normal's z, above which a surface counts as level
_MIN_COVERED_SHARE = 0.9  # share of a pad that must lie on the surface
_X, _UP = np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0])
_TOUCHING = 1e-9  # overlap of electrodes that only touch [m]


@dataclass(frozen=True, slots=True)
class Strip:
    """Contact on the side of a layer: an interval of arc length times one of height.

    Attributes:
        outline: outline of the layer.
        thickness: thickness of the layer [m].
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
        x, y = self.outline.rim_points(0.5 * (self.start + self.end))
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
        rows = _subdivide_interval(self.low, self.high, spacing)
        around = np.concatenate([_subdivide_interval(a, b, spacing) for a, b in self._pieces()])
        lines = [(np.full_like(rows, s), rows) for s in (self.start, self.end)]
        # At the rim of the layer the potential has no singularity: it continues mirrored.
        same = _POINT_TOLERANCE * self.thickness
        free = [z for z in (self.low, self.high) if same < z < self.thickness - same]
        lines += [(around, np.full_like(around, z)) for z in free]
        s, z = (np.concatenate(parts) for parts in zip(*lines, strict=True))
        return np.column_stack([self.outline.rim_points(s), z])

    def _pieces(self) -> list[tuple[float, float]]:
        """Intervals of arc length of constant or nearly constant normal."""
        if isinstance(self.outline, Disc):
            count = math.ceil((self.end - self.start) / (_MAX_ARC * self.outline.radius))
            breaks = np.linspace(self.start, self.end, count + 1)
        else:
            turns = np.array([[-1.0], [0.0], [1.0]]) * self.outline.perimeter
            corners = (turns + self.outline.corners).ravel()
            same = _POINT_TOLERANCE * self.outline.perimeter
            within = (corners > self.start + same) & (corners < self.end - same)
            breaks = np.concatenate([[self.start], corners[within], [self.end]])
        return list(zip(breaks[:-1].tolist(), breaks[1:].tolist(), strict=True))

    def _region(self, start: float, end: float) -> Region:
        a, b = np.column_stack([self.outline.rim_points([start, end]), np.zeros(2)])
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
    if electrode.width > outline.perimeter * (1.0 - _POINT_TOLERANCE):
        raise ConfigurationError(
            f"its width of {electrode.width:g} m must be less than the outline's perimeter of "
            f"{outline.perimeter:g} m"
        )
    start, end = centre - 0.5 * electrode.width, centre + 0.5 * electrode.width
    if electrode.height is None:
        return Strip(outline, thickness, start, end, 0.0, thickness)
    z = 0.5 * thickness if electrode.z is None else electrode.z
    low, high = z - 0.5 * electrode.height, z + 0.5 * electrode.height
    if low < -_POINT_TOLERANCE * thickness or high > thickness * (1.0 + _POINT_TOLERANCE):
        raise ConfigurationError(
            f"it reaches from z = {low:g} to {high:g} m, beyond the layer's 0 to {thickness:g} m; "
            "lower its height or move its z"
        )
    return Strip(outline, thickness, start, end, max(low, 0.0), min(high, thickness))


def _subdivide_interval(start: float, end: float, spacing: float) -> Array:
    """Evenly spaced numbers from `start` to `end`, at most `spacing` apart."""
    return np.linspace(start, end, max(2, math.ceil((end - start) / spacing - 1e-9) + 1))


def _depth(outline: PlaneOutline, a: Array, b: Array) -> float:
    """Depth of a region behind the side from `a` to `b` (2,) that meets no other region [m].

    The depth is half the distance to the nearest side with overlapping extent and equal direction.
    """
    corners = outline.rim_points(outline.corners)
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
    same = _POINT_TOLERANCE * outline.perimeter
    other = alike & ((share[1] - share[0]) * forward > same) & (offsets.max(axis=0) > same)
    nearest = offsets.min(axis=0)[other].min(initial=np.inf)
    return float(min(0.5 * nearest, _MAX_DEPTH * outline.perimeter))


@dataclass(frozen=True, slots=True, eq=False)
class Pad:
    """Flat contact: a convex polygon, or its projection onto a surface.

    Attributes:
        on: face that carries it, as in `Electrode`.
        corners: counter-clockwise seen from outside, (k, 3) [m].
        normal: outward unit vector, (3,).
        depth: largest distance of the contacted boundary from the plane of the pad [m].
        area: area of the contact [m2].
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
    excess = overhang(outline, plane)
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
    position = np.array([electrode.x, electrode.y, electrode.z or 0.0])
    centre, normal = surface.nearest(position)
    footprint = electrode.footprint()
    off = float(np.linalg.norm(centre - position))
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
        vectors = _area_vectors_inside(points[faces], _prism(corners, normal, depth))
        normal = vectors.sum(axis=0) / np.linalg.norm(vectors.sum(axis=0))
    covered, area = float(np.linalg.norm(vectors, axis=1).sum()), _area(footprint)
    if covered < _MIN_COVERED_SHARE * area:
        raise ConfigurationError(
            f"only {covered / area:.0%} of its pad lies on the surface: it passes a sharp edge or "
            "is too large for the body; move it or make it smaller"
        )
    return Pad("surface", corners, normal, depth, covered)


def _prism(corners: Array, normal: Array, depth: float) -> Region:
    """Prism over and under a plane convex polygon (k, 3) [m], up to `depth` [m] from it."""
    along = np.roll(corners, -1, axis=0) - corners
    outward = np.cross(along, normal)
    outward = np.concatenate([outward, [normal, -normal]])
    outward /= np.linalg.norm(outward, axis=1)[:, None]
    points = np.concatenate([corners, [corners[0] + depth * normal, corners[0] - depth * normal]])
    return Region(np.column_stack([outward, (outward * points).sum(axis=1)]), normal)


def _area_vectors_inside(triangles: Array, region: Region) -> Array:
    """Area times normal, (k, 3) [m2], of the parts of triangles (n, 3, 3) in a region."""
    normals = area_vectors(triangles)
    normals /= np.maximum(np.linalg.norm(normals, axis=1), np.finfo(float).tiny)[:, None]
    snap = _POINT_TOLERANCE * float(np.ptp(triangles))
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


ContactArea = Strip | Pad


def contact_areas(
    electrodes: Sequence[Electrode], outline: Outline, thickness: float
) -> list[ContactArea]:
    """Contact areas of electrodes on a body.

    Raises ConfigurationError, naming the electrode, for the first one that is off the body.
    """
    contacts = []
    for number, electrode in enumerate(electrodes):
        try:
            contacts.append(_contact_area(electrode, outline, thickness))
        except ConfigurationError as error:
            raise ConfigurationError(f"electrode {number}: {error}") from error
    return contacts


def require_disjoint(contacts: Sequence[ContactArea]) -> None:
    """Raise ConfigurationError, naming both, for the first two contacts that overlap.

    Strips are compared in the unrolled side, pads in their common plane; a surface is taken as
    flat between two pads.
    """
    centres = np.array([contact.centre for contact in contacts])
    reach = np.array([contact.reach for contact in contacts])
    apart = np.linalg.norm(centres[:, None] - centres, axis=-1)
    near = np.argwhere(np.triu(apart < reach[:, None] + reach, k=1))
    for i, j in near.tolist():
        overlap = _overlap(contacts[i], contacts[j])
        if overlap > _TOUCHING:
            where = "along the outline" if isinstance(contacts[i], Strip) else "in their plane"
            raise ConfigurationError(
                f"electrodes {i} and {j} overlap by {overlap * 1e3:.4g} mm {where}; move them "
                "apart or make them narrower"
            )


def _contact_area(electrode: Electrode, outline: Outline, thickness: float) -> ContactArea:
    if isinstance(outline, Surface) != (electrode.on == "surface"):
        raise ConfigurationError(
            'on = "surface" goes with the surface of a file as outline and with nothing else; got '
            f'on = "{electrode.on}" with a {type(outline).__name__}'
        )
    if isinstance(outline, Surface):
        return on_surface(electrode, outline)
    if electrode.on == "side":
        return on_side(electrode, outline, thickness)
    return on_plane(electrode, outline, thickness)


def _overlap(first: ContactArea, second: ContactArea) -> float:
    """Overlap of two contacts [m]; not above 0 where they are apart."""
    if isinstance(first, Strip) and isinstance(second, Strip):
        return _strips_overlap(first, second)
    if isinstance(first, Pad) and isinstance(second, Pad) and first.on == second.on:
        return _pads_overlap(first, second)
    return 0.0


def _strips_overlap(first: Strip, second: Strip) -> float:
    perimeter = first.outline.perimeter
    between = abs(first.start + first.end - second.start - second.end) / 2.0 % perimeter
    widths = (first.end - first.start + second.end - second.start) / 2.0
    around = widths - min(between, perimeter - between)
    upwards = min(first.high, second.high) - max(first.low, second.low)
    return min(around, upwards)


def _pads_overlap(first: Pad, second: Pad) -> float:
    """Smallest shift in the first pad's plane that parts two pads (separating axes) [m]."""
    apart = second.centre - first.centre
    if first.normal @ second.normal < 0.5 or abs(apart @ first.normal) > (
        _TOUCHING if first.on == "inside" else first.depth + second.depth
    ):
        return 0.0
    axes = tangents(first.normal)
    a, b = ((pad.corners - first.centre) @ axes.T for pad in (first, second))
    outward = np.concatenate([half_planes(a), half_planes(b)])[:, :2]
    high = np.minimum((a @ outward.T).max(axis=0), (b @ outward.T).max(axis=0))
    low = np.maximum((a @ outward.T).min(axis=0), (b @ outward.T).min(axis=0))
    return float((high - low).min())
