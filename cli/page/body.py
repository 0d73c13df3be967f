"""Triangles of a sensor's flat body and of its electrodes, for the drawing of the live page."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from eitskin.geometry.design.flat_contacts import Pad
from eitskin.geometry.design.outline import PlaneOutline
from eitskin.geometry.design.patches import area_vectors, on_boundary
from eitskin.geometry.design.placement import ContactArea, placed
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.geometry.design.side_contacts import Strip
from eitskin.geometry.design.surface import Surface
from eitskin.geometry.meshing.delaunay import triangulated

Array = NDArray[np.float64]
Numbers = NDArray[np.int64]

GEL, FACE, METAL, INSIDE = range(4)  # kinds of vertices, as in web/sensor.js

_ON_TOP = 800  # points of a layer's upper face, about
_OF_SURFACE = 2500  # points of a body from a file, at most
_LOOSEST = 1.5  # longest edges over those of as many equilateral triangles
_SHARP = np.cos(np.radians(40.0))  # normals of faces beyond an edge that is seen as one
_UPWARD = 0.3  # least z of the normal where the touch map is seen
_PIECES = 40  # most steps along an electrode
_SAME = 1e-9  # relative distance of points that count as one


class Triangles(NamedTuple):
    """Triangles: points (n, 3) [m] and faces (k, 3), counter-clockwise seen from outside."""

    points: Array
    faces: Numbers


@dataclass(frozen=True, slots=True, eq=False)
class DrawnBody:
    """Body and electrodes as triangles whose vertices are split where an edge is sharp.

    Attributes:
        points: of the flat sensor (n, 3) [m].
        vertices: number of each vertex's point (v,).
        kinds: of the vertices (v,), `GEL`, `FACE`, `METAL` or `INSIDE`.
        faces: vertices of the triangles (k, 3); those of kind `INSIDE` come last.
        electrodes: first vertex and number of vertices of each electrode, (electrodes, 2).
    """

    points: Array
    vertices: Numbers
    kinds: NDArray[np.uint8]
    faces: Numbers
    electrodes: Numbers

    @classmethod
    def of(cls, design: SensorDesign) -> "DrawnBody":
        """Body of a sensor with any outline."""
        outline = design.outline
        if isinstance(outline, Surface):
            body = _clustered(Triangles(*outline.triangles()), _OF_SURFACE)
        else:
            body = _layer(outline, design.thickness)
        spacing = _mean_edge(body)
        contacts = placed(design.electrodes, outline, design.thickness)
        parts = [body, *(_sheet(contact, body, spacing) for contact in contacts)]
        kinds = [INSIDE if isinstance(c, Pad) and c.on == "inside" else METAL for c in contacts]
        return _joined(parts, [FACE, *kinds])

    @property
    def opaque(self) -> int:
        """Number of faces that are not inside the body."""
        return int((self.kinds[self.faces[:, 0]] != INSIDE).sum())


def _layer(outline: PlaneOutline, thickness: float) -> Triangles:
    """Boundary of a layer: both faces and the side."""
    whole = np.full(1, max(outline.length, outline.width))
    points, faces = triangulated(outline, np.empty(0), lambda at: np.repeat(whole, len(at)))
    area = float(area_vectors(_lifted(points, 0.0)[faces])[:, 2].sum())
    size = np.array([_LOOSEST * np.sqrt(2.0 / np.sqrt(3.0) * area / _ON_TOP)])
    points, top = triangulated(outline, np.empty(0), lambda at: np.repeat(size, len(at)))
    count = len(points)
    edges = np.concatenate([top[:, [0, 1]], top[:, [1, 2]], top[:, [2, 0]]])
    ordered = {tuple(edge) for edge in edges.tolist()}
    a, b = np.array(sorted(edge for edge in ordered if edge[::-1] not in ordered)).T
    side = np.concatenate(
        [np.column_stack([a + count, b + count, b]), np.column_stack([a + count, b, a])]
    )
    faces = np.concatenate([top, top[:, ::-1] + count, side])
    return Triangles(np.concatenate([_lifted(points, thickness), _lifted(points, 0.0)]), faces)


def _lifted(points: Array, z: float) -> Array:
    """Points (n, 3) [m] at one height of plane ones (n, 2) [m]."""
    return np.column_stack([points, np.full(len(points), z)])


def _mean_edge(body: Triangles) -> float:
    corners = body.points[body.faces]
    return float(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).mean())


def _clustered(whole: Triangles, most: int) -> Triangles:
    """Triangles between at most `most` points: points of one cell of a grid become their mean."""
    extent, cell = float(np.ptp(whole.points, axis=0).max()), _SAME
    while True:
        grid = np.floor((whole.points - whole.points.min(axis=0)) / (cell * extent))
        _, number = np.unique(grid, axis=0, return_inverse=True)
        if number.max() < most:
            break
        cell = max(1.3 * cell, 0.005)
    sums = np.stack([np.bincount(number, axis) for axis in whole.points.T], axis=1)
    faces = number[whole.faces]
    real = (faces != np.roll(faces, 1, axis=1)).all(axis=1)
    return Triangles(sums / np.bincount(number)[:, None], faces[real])


def _sheet(contact: ContactArea, body: Triangles, spacing: float) -> Triangles:
    """Triangles of an electrode's contact, fine enough to follow the body where it deforms."""
    if isinstance(contact, Strip):
        return _strip(contact, spacing)
    if contact.on == "surface":
        found = _covered(contact, body)
        if len(found.faces):
            return found
    rim = contact.edges(spacing)
    rings = _steps(contact.reach, spacing)
    share = np.arange(1, rings + 1)[:, None, None] / rings
    points = contact.centre + share * (rim - contact.centre)
    outer = 1 + np.arange(rings * len(rim)).reshape(rings, -1)
    grid = np.concatenate([np.zeros_like(outer[:1]), outer])
    return Triangles(
        np.concatenate([contact.centre[None], points.reshape(-1, 3)]), _quads(grid, closed=True)
    )


def _strip(strip: Strip, spacing: float) -> Triangles:
    """Triangles of a strip on the side."""
    arc = arc_of(strip, spacing)
    height = np.linspace(strip.low, strip.high, 1 + _steps(strip.high - strip.low, spacing))
    points = np.concatenate([_lifted(strip.outline.at(arc), z) for z in height])
    return Triangles(points, _quads(np.arange(len(points)).reshape(len(height), -1)))


def arc_of(strip: Strip, spacing: float) -> Array:
    """Arc lengths along a strip (k,) [m], with those of the outline's corners within it."""
    turns = np.array([[-1.0], [0.0], [1.0]]) * strip.outline.perimeter
    corners = (turns + strip.outline.corners).ravel()
    within = corners[(corners > strip.start) & (corners < strip.end)]
    even = np.linspace(strip.start, strip.end, 1 + _steps(strip.end - strip.start, spacing))
    return np.unique(np.concatenate([even, within]))


def _steps(length: float, spacing: float) -> int:
    return int(np.clip(np.ceil(length / spacing), 1, _PIECES))


def _quads(grid: Numbers, *, closed: bool = False) -> Numbers:
    """Faces (k, 3) between the rows of point numbers (rows, columns), perhaps closed to rings."""
    following = np.roll(grid, -1, axis=1) if closed else grid[:, 1:]
    first = grid if closed else grid[:, :-1]
    a, b, c, d = first[:-1], following[:-1], following[1:], first[1:]
    if closed:  # rows run outwards, not upwards
        a, b, c, d = d, c, b, a
    faces = np.concatenate([np.stack([a, b, c], -1), np.stack([a, c, d], -1)]).reshape(-1, 3)
    real: Numbers = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
    return real


def _covered(pad: Pad, body: Triangles) -> Triangles:
    """Part of a body's surface under a pad; without faces where the drawn body has none there."""
    corners = body.points[body.faces]
    normals = area_vectors(corners)
    normals /= np.maximum(np.linalg.norm(normals, axis=1), np.finfo(float).tiny)[:, None]
    snap = _SAME * float(np.ptp(body.points))
    (region,) = pad.patch().regions
    pieces = on_boundary(corners, normals, np.arange(len(corners)), region, snap).polygons
    points, number = np.unique(pieces.reshape(-1, 3).round(9), axis=0, return_inverse=True)
    number = number.reshape(pieces.shape[:2])
    fans = [number[:, [0, k, k + 1]] for k in range(1, pieces.shape[1] - 1)]
    faces = np.concatenate(fans) if len(number) else np.empty((0, 3), int)
    return Triangles(points, faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)])


def _joined(parts: list[Triangles], kinds: list[int]) -> DrawnBody:
    """Body, then electrodes, as one set of triangles."""
    vertices, faces, kind, spans = [], [], [], []
    point = vertex = 0
    for part, what in zip(parts, kinds, strict=True):
        own, of_faces, up = _smoothed(part)
        vertices.append(point + own)
        faces.append(vertex + of_faces)
        kind.append(np.where(up, FACE, GEL) if what == FACE else np.full(len(own), what))
        spans.append((vertex, len(own)))
        point, vertex = point + len(part.points), vertex + len(own)
    last = np.argsort(np.array(kinds) == INSIDE, kind="stable")
    return DrawnBody(
        np.concatenate([part.points for part in parts]),
        np.concatenate(vertices),
        np.concatenate(kind).astype(np.uint8),
        np.concatenate([faces[number] for number in last]),
        np.array(spans[1:]),
    )


def _smoothed(part: Triangles) -> tuple[Numbers, Numbers, NDArray[np.bool_]]:
    """Vertices of smooth shading: point of each, faces (k, 3), and whether each looks upwards.

    Faces around a point share a vertex unless their normals differ by an edge.
    """
    areas = area_vectors(part.points[part.faces])
    normals = areas / np.maximum(np.linalg.norm(areas, axis=1), np.finfo(float).tiny)[:, None]
    found: dict[int, list[tuple[Array, int]]] = {}
    points: list[int] = []
    up: list[bool] = []
    faces = np.empty_like(part.faces)
    for face, column, point in _corners(part.faces):
        normal = normals[face]
        around = found.setdefault(point, [])
        smooth = (vertex for first, vertex in around if first @ normal > _SHARP)
        vertex = next(smooth, len(points))
        if vertex == len(points):
            around.append((normal, vertex))
            points.append(point)
            up.append(bool(normal[2] > _UPWARD))
        faces[face, column] = vertex
    return np.array(points), faces, np.array(up)


def _corners(faces: Numbers) -> Iterator[tuple[int, int, int]]:
    """Face, column and point of every corner."""
    for face, row in enumerate(faces.tolist()):
        for column, point in enumerate(row):
            yield face, column, point
