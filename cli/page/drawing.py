"""Sensor on the live page: from above, and in three dimensions, bent and dented as simulated."""

import base64
import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eitskin.errors import ConfigurationError
from eitskin.geometry.deformation.fixtures import Bend, Clamp, Hinge
from eitskin.geometry.deformation.kinematics import Deformation
from eitskin.geometry.design.contact_areas import ContactArea, Pad, contact_areas
from eitskin.geometry.design.outline import Disc, Rectangle
from eitskin.geometry.design.patches import area_vectors, on_boundary
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.geometry.design.surface import Surface
from eitskin.geometry.meshing.delaunay import layer_surface
from eitskin.simulator.bends import bend_table
from eitskin.simulator.deformation.press_table import sketched_dents
from eitskin.simulator.deformation.solution_store import missing
from eitskin.simulator.mechanics.layer_stack import Mechanics
from eitskin.simulator.scene.scene import Touch

if TYPE_CHECKING:
    from eitskin.training.pipeline.pipeline import Pipeline


Array = NDArray[np.float64]
Numbers = NDArray[np.int64]

GEL, FACE, METAL, INSIDE = range(4)  # kinds of vertices, as in web/sensor.js

_ON_TOP = 800  # points of a layer's upper face, about
_OF_SURFACE = 2500  # points of a body from a file, at most
_LOOSEST = 1.5  # longest edges over those of as many equilateral triangles
_SHARP = np.cos(np.radians(40.0))  # normals of faces beyond an edge that is seen as one
_UPWARD = 0.3  # least z of the normal where the touch map is seen
_POINT_TOLERANCE = 1e-9  # relative distance of points that count as one


FORCE_UNKNOWN = 6.0  # drawn for a touch whose force is not estimated [N]
_MAX_DRAWN_ANGLE = 60.0  # bends are drawn up to this, either way [deg]
_ANGLE_STEP = 0.2  # difference of two bends that are drawn [deg]; each is computed once
_STEPS = 32000  # of a coordinate from the middle to twice the sensor's length
_SAME_ANGLE, _SAME_PRESS = 0.3, (0.0015, 0.0015, 0.5)  # too little to be seen [deg], [m, m, N]

DrawnPress = tuple[float, float, float]
"""x [m], y [m] and force [N]; NaN for an unknown force."""
_MARGIN = 0.0075  # m, shown around the positions on a sensor of unknown geometry
_RIM = 96  # points of an outline without corners
_LINES = 10.0  # of the grid, about, along the longer side
_ROUND = np.array([1.0, 1.5, 2.0, 3.0, 5.0, 7.5, 10.0])


class Triangles(NamedTuple):
    """Triangles: points (n, 3) [m] and faces (k, 3), counter-clockwise seen from outside."""

    points: Array
    faces: Numbers


@dataclass(frozen=True, slots=True, eq=False)
class DrawnBody:
    """Body and electrodes as triangles whose vertices are split where an edge is sharp.

    Attributes:
        points: points of the flat sensor (n, 3) [m].
        vertices: number of each vertex's point (v,).
        kinds: kinds of the vertices (v,), `GEL`, `FACE`, `METAL` or `INSIDE`.
        faces: vertices of the triangles (k, 3); those of kind `INSIDE` come last.
        electrodes: first vertex and number of vertices of each electrode, (electrodes, 2).
    """

    points: Array
    vertices: Numbers
    kinds: NDArray[np.uint8]
    faces: Numbers
    electrodes: Numbers

    @classmethod
    def from_design(cls, design: SensorDesign) -> "DrawnBody":
        """Body of a sensor with any outline."""
        outline = design.outline
        if isinstance(outline, Surface):
            body = _cluster_vertices(Triangles(*outline.triangles()), _OF_SURFACE)
        else:
            x, y = plan_outline(design).T
            area = 0.5 * float((x * np.roll(y, -1) - np.roll(x, -1) * y).sum())
            longest = _LOOSEST * np.sqrt(2.0 / np.sqrt(3.0) * area / _ON_TOP)
            body = Triangles(*layer_surface(outline, design.thickness, longest))
        contacts = contact_areas(design.electrodes, outline, design.thickness)
        parts = [body, *(_sheet(contact, body) for contact in contacts)]
        kinds = [INSIDE if isinstance(c, Pad) and c.on == "inside" else METAL for c in contacts]
        return _join_bodies(parts, [FACE, *kinds])

    @property
    def opaque(self) -> int:
        """Number of faces that are not inside the body."""
        return int((self.kinds[self.faces[:, 0]] != INSIDE).sum())


def _cluster_vertices(whole: Triangles, most: int) -> Triangles:
    """Triangles between at most `most` points: points of one cell of a grid become their mean."""
    extent, cell = float(np.ptp(whole.points, axis=0).max()), _POINT_TOLERANCE
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


def _sheet(contact: ContactArea, body: Triangles) -> Triangles:
    """Part of the body's faces under a contact; of one inside, of the upper faces at its height."""
    corners, flat = body.points[body.faces], np.empty((0, 3))
    if isinstance(contact, Pad):
        flat = contact.corners
        if contact.on == "inside":
            corners = corners[area_vectors(corners)[:, 2] > 0.0]
            corners[..., 2] = contact.centre[2]
            contact = dataclasses.replace(contact, on="top")
    normals = area_vectors(corners)
    normals /= np.maximum(np.linalg.norm(normals, axis=1), np.finfo(float).tiny)[:, None]
    snap = _POINT_TOLERANCE * float(np.ptp(body.points))
    numbers = np.arange(len(corners))
    found = [on_boundary(corners, normals, numbers, r, snap) for r in contact.patch().regions]
    polygons = [piece.polygons for piece in found if len(piece.polygons)] or [flat[None]]
    fans = [each[:, [0, k, k + 1]] for each in polygons for k in range(1, each.shape[1] - 1)]
    points, number = np.unique(
        np.concatenate(fans).reshape(-1, 3).round(9), axis=0, return_inverse=True
    )
    faces = number.reshape(-1, 3)
    return Triangles(points, faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)])


def _join_bodies(parts: list[Triangles], kinds: list[int]) -> DrawnBody:
    """Body, then electrodes, as one set of triangles."""
    vertices, faces, kind, spans = [], [], [], []
    point = vertex = 0
    for part, what in zip(parts, kinds, strict=True):
        own, of_faces, up = _shading_vertices(part)
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


def _shading_vertices(part: Triangles) -> tuple[Numbers, Numbers, NDArray[np.bool_]]:
    """Vertices of smooth shading: point of each, faces (k, 3), and whether each looks upwards.

    Faces around a point share a vertex unless their normals differ by an edge.
    """
    areas = area_vectors(part.points[part.faces])
    normals = areas / np.maximum(np.linalg.norm(areas, axis=1), np.finfo(float).tiny)[:, None]
    neighbours: dict[int, list[tuple[Array, int]]] = {}
    points: list[int] = []
    up: list[bool] = []
    faces = np.empty_like(part.faces)
    for (face, column), point in np.ndenumerate(part.faces):
        normal = normals[face]
        around = neighbours.setdefault(int(point), [])
        smooth = (vertex for first, vertex in around if first @ normal > _SHARP)
        vertex = next(smooth, len(points))
        if vertex == len(points):
            around.append((normal, vertex))
            points.append(int(point))
            up.append(bool(normal[2] > _UPWARD))
        faces[face, column] = vertex
    return np.array(points), faces, np.array(up)


@dataclass(frozen=True, slots=True, eq=False)
class GelShape:
    """Triangles of the flat gel and its electrodes, with the range of bends.

    Attributes:
        design: the sensor.
        body: triangles.
        origin: least x and y of the outline, and the height of the bottom, (3,) [m].
        least, most: bends that can be drawn [deg].
    """

    design: SensorDesign
    body: DrawnBody
    origin: Array
    least: float
    most: float

    @classmethod
    @lru_cache(maxsize=8)  # the same sensor is shown again after a page was closed
    def from_design(cls, design: SensorDesign) -> "GelShape":
        """Shape of a sensor with any outline."""
        outline = design.outline
        origin = outline.bounds[0] if isinstance(outline, Surface) else np.zeros(3)
        reach = [_farthest(design, sign) for sign in (-1, 1)]
        return cls(design, DrawnBody.from_design(design), origin, *reach)

    def bend_points(
        self, angle_deg: float, presses: Sequence[DrawnPress], points: Array | None = None
    ) -> Array:
        """Deformed points (n, 3) [m] under a bend and touches at (x [m], y [m], force [N]).

        The points are those of the body, unless others on the flat sensor are given.

        Bends are drawn in steps of `_ANGLE_STEP`. Dents are to scale, those of the 15 mm cylinder
        on the reference sensor; unknown forces are drawn as `FORCE_UNKNOWN`, an unknown angle as
        flat. A body from a file has no dents.
        """
        angle = _ANGLE_STEP * round(angle_deg / _ANGLE_STEP) if math.isfinite(angle_deg) else 0.0
        angle = min(max(angle, self.least), self.most)
        points = self.body.points if points is None else points
        if presses and not isinstance(self.design.outline, Surface):
            touches = tuple(Touch(x, y, _drawn_force(force)) for x, y, force in presses)
            points = sketched_dents(touches, self.design).positions(points)
        return _page_bend(self.design, angle).positions(points) if angle else points


@dataclass(slots=True, eq=False)
class GelDrawing:
    """Latest drawing of the shape, kept while estimates change by no more than noise.

    Attributes:
        shape: the flat shape.
        unit: resolution of a coordinate [m].
    """

    shape: GelShape
    unit: float
    _drawn: Array | None = None
    _points: str = ""

    @classmethod
    def from_design(cls, design: SensorDesign) -> "GelDrawing":
        """Drawing of a sensor with any outline."""
        return cls(
            GelShape.from_design(design),
            2.0 * max(design.outline.length, design.outline.width) / _STEPS,
        )

    def as_dict(self) -> dict[str, Any]:
        """Plain data of the triangles, which do not change; numbers are 16-bit integers."""
        body = self.shape.body
        return {
            "unit": self.unit,
            "points": self._steps(body.points),
            "vertices": encode_numbers(body.vertices, "<u2"),
            "kinds": encode_numbers(body.kinds, "u1"),
            "faces": encode_numbers(body.faces, "<u2"),
            "opaque": body.opaque,
            "electrodes": body.electrodes.tolist(),
        }

    def points(self, angle_deg: float, presses: Sequence[DrawnPress]) -> str:
        """Deformed points from the origin in multiples of `unit`: int16, little-endian, base64."""
        key = np.array([angle_deg, *(value for press in presses for value in press)])
        tolerance = np.array([_SAME_ANGLE, *_SAME_PRESS * len(presses)])
        drawn = self._drawn if self._drawn is not None else np.empty(0)
        same: dict[str, Any] = {"rtol": 0.0, "atol": tolerance, "equal_nan": True}
        if drawn.shape != key.shape or not np.allclose(key, drawn, **same):
            self._points = self._steps(self.shape.bend_points(angle_deg, presses))
            self._drawn = key
        return self._points

    def _steps(self, points: Array) -> str:
        return encode_numbers(np.rint((points - self.shape.origin) / self.unit), "<i2")


def encode_numbers(numbers: NDArray[Any], kind: str) -> str:
    """Numbers of one kind of integers in base64."""
    return base64.b64encode(numbers.astype(kind).tobytes()).decode()


@lru_cache(maxsize=256)
def _page_bend(design: SensorDesign, angle: float) -> Deformation:
    """Bend by the default clamp where that has been solved, by the kinematic hinge elsewhere."""
    plane = isinstance(design.outline, Rectangle)
    solved = plane and not missing(bend_table.bend_problems(design, Clamp(), Mechanics()))
    fixture = Clamp() if solved else Hinge()
    return bend_table.bend(design, fixture, Mechanics(), Bend(angle))


def _farthest(design: SensorDesign, sign: int) -> float:
    """Largest bend in one direction that the fixture can reach [deg]."""
    for angle in np.arange(_MAX_DRAWN_ANGLE, 0.0, -20.0):
        try:
            _page_bend(design, float(sign * angle))
        except ConfigurationError:
            continue
        return float(sign * angle)
    return 0.0


def _drawn_force(force: float) -> float:
    """Force rounded to 0.1 N, so that each dent is computed once."""
    drawn = force if math.isfinite(force) else FORCE_UNKNOWN
    return round(max(drawn, 0.1), 1)


@dataclass(frozen=True, slots=True)
class Region:
    """Rectangle around a sensor, or around the positions on one of unknown geometry.

    Attributes:
        low, high: smallest and largest x and y [m].
    """

    low: tuple[float, float]
    high: tuple[float, float]

    @classmethod
    def from_design(cls, design: SensorDesign) -> "Region":
        """Bounding rectangle of a design's outline."""
        outline = design.outline
        if isinstance(outline, Surface):
            low, high = outline.bounds[:, :2].tolist()
            return cls(tuple(low), tuple(high))
        return cls((0.0, 0.0), (outline.length, outline.width))

    @classmethod
    def from_positions(cls, extent: ArrayLike, margin: float) -> "Region":
        """Rectangle around positions, smallest and largest x and y (2, 2) [m], and a margin [m]."""
        low, high = np.asarray(extent, dtype=float)
        return cls(tuple((low - margin).tolist()), tuple((high + margin).tolist()))

    @property
    def length(self) -> float:
        """Length along x [m]."""
        return self.high[0] - self.low[0]

    @property
    def width(self) -> float:
        """Width along y [m]."""
        return self.high[1] - self.low[1]

    @property
    def corners(self) -> NDArray[np.float64]:
        """Corners, counter-clockwise from the lowest (4, 2) [m]."""
        (x0, y0), (x1, y1) = self.low, self.high
        return np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])

    def contains(self, position: Array) -> bool:
        """Whether a position (2,) [m] lies inside or on the edge."""
        return bool((position >= self.low).all() and (position <= self.high).all())


def sensor_or_region(pipeline: "Pipeline") -> SensorDesign | Region:
    """Sensor of a pipeline, or the region of the positions that it was trained with.

    Raises ConfigurationError where a pipeline shows neither.
    """
    layout = pipeline.layout
    if layout.known_design is not None:
        return layout.known_design
    if layout.extent is None:
        raise ConfigurationError(
            "expected a pipeline that knows its sensor, for the page, got touch positions of "
            "version 0.1; leave out --page, or train them again"
        )
    return Region.from_positions(layout.extent, _MARGIN)


def plan_outline(design: SensorDesign) -> Array:
    """Vertices of the body seen from above (k, 2) [m]; the convex hull for one from a file."""
    outline = design.outline
    if isinstance(outline, Surface):
        from scipy.spatial import ConvexHull

        points = outline.triangles()[0][:, :2]
        hull: Array = points[ConvexHull(points).vertices]
        return hull
    if isinstance(outline, Disc):
        return outline.rim_points(np.arange(_RIM) * (outline.perimeter / _RIM))
    return outline.vertices


def grid_spacing(length: float, width: float) -> float:
    """Distance between two lines of the grid on a sensor, a round number [m]."""
    target_spacing = max(length, width) / _LINES
    power = 10.0 ** math.floor(math.log10(target_spacing))
    return float(power * _ROUND[np.abs(np.log(_ROUND * power / target_spacing)).argmin()])
