"""Contact areas of electrodes: convex regions of the boundary, cut exactly out of a mesh."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eitskin.errors import ConfigurationError

Array = NDArray[np.float64]
Numbers = NDArray[np.int64]

# Corners of the faces of each cell in VTK's order, counter-clockwise seen from outside; the
# triangles of a wedge repeat their last corner.
FACES = {
    8: np.array(
        [[0, 3, 2, 1], [4, 5, 6, 7], [0, 1, 5, 4], [1, 2, 6, 5], [2, 3, 7, 6], [3, 0, 4, 7]]
    ),
    6: np.array([[0, 2, 1, 1], [3, 4, 5, 5], [0, 1, 4, 3], [1, 2, 5, 4], [2, 0, 3, 5]]),
    4: np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]]),
}

# Points nearer than this to a plane, relative to the body's size, count as on the plane.
_SNAP = 1e-9

# Chords of an arc of 0.7 rad and a boundary within a mesher's envelope stay within this.
_AREA_TOLERANCE = 0.02


@dataclass(frozen=True, slots=True, eq=False)
class Region:
    """Convex polyhedron that cuts a part out of the boundary of a body.

    Attributes:
        planes: (m, 4); the set {x: planes[:, :3] @ x <= planes[:, 3]}, rows of unit normals [m].
        normal: (3,) unit vector; only boundary faces of outward unit normal n with n . normal > 0.5
            are cut.
    """

    planes: Array
    normal: Array


@dataclass(frozen=True, slots=True, eq=False)
class Patch:
    """Contact area of one electrode.

    Attributes:
        regions: convex sets that do not overlap; their union cuts the electrode out of the
            boundary. Empty for a sheet.
        area: area of the electrode [m2].
        sheet: (k, 3) corners in order of a plane convex polygon inside the body [m]; None for
            an electrode on the boundary.
    """

    regions: tuple[Region, ...]
    area: float
    sheet: Array | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Contacts:
    """Pieces of cell faces in contact with electrodes, cut exactly at the electrodes' rims.

    Attributes:
        electrode: the electrode of each piece, (n,).
        cell: the cell that the piece bounds, (n,).
        corners: counter-clockwise seen from outside, (n, 3, 3) triangles or (n, 4, 3)
            parallelograms [m].
        areas: areas of the pieces, (n,) [m2], scaled so that each electrode has its true area: the
            chords of a curved face are a little short.
        facets: facets per electrode the cell faces in contact, (k, 3) or (k, 4) point numbers.

    Example:
        >>> from eitskin.geometry import SensorDesign, structured_mesh
        >>> from eitskin.geometry.meshing.grading import Grading
        >>> mesh = structured_mesh(SensorDesign.reference(), Grading(2e-3, 1e-2, 1.0))
        >>> len(set(mesh.contacts.electrode.tolist()))
        8
    """

    electrode: Numbers
    cell: Numbers
    corners: Array
    areas: Array
    facets: tuple[Numbers, ...]


@dataclass(frozen=True, slots=True, eq=False)
class _Pieces:
    """Convex polygons (n, k, 3), last corners repeated; cell and face of each, -1 for no face."""

    polygons: Array
    cells: Numbers
    faces: Numbers


def electrode_contacts(points: Array, cells: Numbers, patches: Sequence[Patch]) -> Contacts:
    """Clip the boundary faces to the patches (Sutherland & Hodgman 1974).

    A sheet is cut by the cells that it passes; a sheet between two cells belongs to the lower
    one. A sheet is in contact with no boundary faces, so its `facets` are empty.

    Args:
        points: (n, 3) [m].
        cells: (m, 8) hexahedra, (m, 6) wedges or (m, 4) tetrahedra of positive volume, in VTK's
            order.
        patches: patches of the electrodes, in their order.

    Raises ConfigurationError where the pieces of an electrode do not add up to its area.
    """
    faces, owners = boundary_faces(cells)
    corners = points[faces]
    normals = area_vectors(corners)
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    snap = _SNAP * float(np.linalg.norm(np.ptp(points, axis=0)))
    pieces, stretch = [], []
    for number, patch in enumerate(patches):
        if patch.sheet is None:
            parts = [on_boundary(corners, normals, owners, r, snap) for r in patch.regions]
        else:
            parts = [_in_cells(points, cells, patch.sheet, snap)]
        found = _concatenate_pieces(parts)
        areas = np.linalg.norm(area_vectors(found.polygons), axis=1)
        _check_area(number, float(areas.sum()), patch.area)
        stretch.append(patch.area / areas.sum())
        real = areas > 1e-12 * patch.area
        pieces.append(_Pieces(found.polygons[real], found.cells[real], found.faces[real]))
    everything = _concatenate_pieces(pieces)
    electrode = np.repeat(np.arange(len(patches)), [len(p.cells) for p in pieces])
    chosen, shapes = _shapes(everything.polygons)
    areas = np.linalg.norm(area_vectors(shapes), axis=1) * np.array(stretch)[electrode[chosen]]
    facets = tuple(_facets(faces, piece.faces) for piece in pieces)
    return Contacts(electrode[chosen], everything.cells[chosen], shapes, areas, facets)


def boundary_faces(cells: Numbers) -> tuple[Numbers, Numbers]:
    """Boundary faces: faces of one cell only.

    Args:
        cells: (m, 8 | 6 | 4) in VTK's order.

    Returns:
        faces: (k, 4 | 4 | 3) point numbers, counter-clockwise seen from outside; triangles of
            wedges repeat their last point.
        owners: the cell of each face, (k,).
    """
    local = FACES[cells.shape[1]]
    faces = cells[:, local].reshape(-1, local.shape[1])
    # Any three corners name a face; the three lowest are the same ones in both its cells.
    rows = np.sort(faces, axis=1)[:, :3]
    triangle = faces[:, -1] == faces[:, -2]
    rows[triangle] = np.sort(faces[triangle, :3], axis=1)
    order = np.lexsort(rows.T)
    new = np.ones(len(rows) + 1, dtype=bool)
    new[1:-1] = (rows[order[1:]] != rows[order[:-1]]).any(axis=1)
    lone = np.sort(order[new[:-1] & new[1:]])
    return faces[lone], lone // len(local)


def on_boundary(
    corners: Array, normals: Array, owners: Numbers, region: Region, snap: float
) -> _Pieces:
    """Parts of the boundary faces within one region."""
    near = np.flatnonzero(normals @ region.normal > 0.5)
    for plane in region.planes:
        near = near[(corners[near] @ plane[:3]).min(axis=1) <= plane[3] + snap]
    polygons = corners[near]
    for plane in region.planes:
        kept, polygons = _clip_polygons(polygons, np.broadcast_to(plane, (len(polygons), 4)), snap)
        near = near[kept]
    return _Pieces(polygons, owners[near], near)


def _in_cells(points: Array, cells: Numbers, sheet: Array, snap: float) -> _Pieces:
    """Parts of a sheet within each cell."""
    normal = area_vectors(sheet[None])[0]
    normal /= np.linalg.norm(normal)
    height = (points - sheet[0]) @ normal
    height[np.abs(height) <= snap] = 0.0
    at = height[cells]
    # A cell whose top lies in the sheet is passed; the one whose bottom does is not.
    passed = np.flatnonzero((at.min(axis=1) < 0.0) & (at.max(axis=1) >= 0.0))
    corners = points[cells[passed]]
    low, high = sheet.min(axis=0) - snap, sheet.max(axis=0) + snap
    overlap = (corners.max(axis=1) >= low).all(axis=1) & (corners.min(axis=1) <= high).all(axis=1)
    passed, corners = passed[overlap], corners[overlap]
    polygons = np.broadcast_to(sheet, (len(passed), *sheet.shape))
    for face in FACES[cells.shape[1]]:
        outward = area_vectors(corners[:, face])
        outward /= np.linalg.norm(outward, axis=1)[:, None]
        offset = np.einsum("ni,ni->n", outward, corners[:, face].mean(axis=1))
        numbers, polygons = _clip_polygons(polygons, np.column_stack([outward, offset]), snap)
        passed, corners = passed[numbers], corners[numbers]
    return _Pieces(polygons, passed, np.full(len(passed), -1))


def _clip_polygons(polygons: Array, planes: Array, snap: float) -> tuple[Numbers, Array]:
    """Clip each polygon (n, k, 3) by its own plane (n, 4): numbers and shapes of the remaining."""
    distance = np.einsum("nki,ni->nk", polygons, planes[:, :3]) - planes[:, 3:]
    distance[np.abs(distance) <= snap] = 0.0
    if not (distance > 0.0).any():
        return np.arange(len(polygons)), polygons
    following = np.roll(distance, -1, axis=1)
    crossing = distance * following < 0.0
    share = np.where(crossing, distance / np.where(crossing, distance - following, 1.0), 0.0)
    cuts = polygons + share[..., None] * (np.roll(polygons, -1, axis=1) - polygons)
    n, k = distance.shape
    # In order around the polygon: each corner inside the plane, then the cut after the corner.
    slots = np.stack([polygons, cuts], axis=2).reshape(n, 2 * k, 3)
    used = np.stack([distance <= 0.0, crossing], axis=2).reshape(n, 2 * k)
    remaining = np.flatnonzero(used.any(axis=1))
    count = used[remaining].sum(axis=1)[:, None]
    place = np.minimum(np.arange(min(k + 1, 2 * k)), count - 1)
    order = np.take_along_axis(np.argsort(~used[remaining], axis=1, kind="stable"), place, axis=1)
    return remaining, np.take_along_axis(slots[remaining], order[..., None], axis=1)


def area_vectors(polygons: Array) -> Array:
    """Area times unit normal, (n, 3) [m2], of plane polygons (n, k, 3) [m]."""
    spokes = polygons[:, 1:] - polygons[:, :1]
    vectors: Array = 0.5 * np.cross(spokes[:, :-1], spokes[:, 1:]).sum(axis=1)
    return vectors


def _concatenate_pieces(parts: Sequence[_Pieces]) -> _Pieces:
    """Concatenated pieces; last corners are repeated up to the greatest number of corners."""
    width = max(part.polygons.shape[1] for part in parts)
    repeat = [np.minimum(np.arange(width), part.polygons.shape[1] - 1) for part in parts]
    return _Pieces(
        np.concatenate([p.polygons[:, r] for p, r in zip(parts, repeat, strict=True)]),
        np.concatenate([part.cells for part in parts]),
        np.concatenate([part.faces for part in parts]),
    )


def _check_area(number: int, covered: float, area: float) -> None:
    if not abs(covered - area) <= _AREA_TOLERANCE * area:
        raise ConfigurationError(
            f"electrode {number} covers {covered * 1e6:.6g} of its {area * 1e6:.6g} mm2: it lies "
            "off the body or the mesh is too coarse; move the electrode or mesh finer at its edges"
        )


def _shapes(polygons: Array) -> tuple[Numbers, Array]:
    """Polygons as parallelograms (n, 4, 3) if all are, else as triangles (t, 3, 3).

    Returns the polygon of each shape, and the shapes.
    """
    sides = np.roll(polygons, -1, axis=1) - polygons
    length = np.linalg.norm(sides, axis=2)
    size = length.max(axis=1, keepdims=True)
    true_corner = length > 1e-9 * size
    if (true_corner.sum(axis=1) == 4).all():
        order = np.argsort(~true_corner, axis=1, kind="stable")[:, :4]
        quads = np.take_along_axis(polygons, order[..., None], axis=1)
        gap = quads[:, 0] - quads[:, 1] + quads[:, 2] - quads[:, 3]
        if (np.linalg.norm(gap, axis=1) <= 1e-9 * size[:, 0]).all():
            return np.arange(len(quads)), quads
    n, k = length.shape
    fan = np.stack([np.zeros(k - 2, dtype=int), np.arange(1, k - 1), np.arange(2, k)], axis=1)
    triangles = polygons[:, fan].reshape(-1, 3, 3)
    real = np.linalg.norm(area_vectors(triangles), axis=1) > np.repeat(
        1e-12 * size[:, 0] ** 2, k - 2
    )
    return np.repeat(np.arange(n), k - 2)[real], triangles[real]


def _facets(faces: Numbers, numbers: Numbers) -> Numbers:
    """Unique faces in contact; without the repeated corners if all are triangles."""
    facets = faces[np.unique(numbers[numbers >= 0])]
    return facets[:, :3] if (facets[:, -1] == facets[:, -2]).all() else facets
