"""Bends of a body of any shape between two turning plates."""

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import skfem
from numpy.typing import NDArray

from eitskin.errors import ConfigurationError
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.geometry.meshing.grading import Grading
from eitskin.simulator.bodies.tetrahedral_solid import (
    TetrahedralField,
    TetrahedralSolid,
    body_grading,
    meshed,
    surface_of,
)
from eitskin.simulator.mechanics.layer_stack import Mechanics
from eitskin.simulator.mechanics.load_stepping import Load, SolidError, follow

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

_SAME = 1e-9  # [m]
_GRIPPED = math.cos(math.radians(45.0))  # |n_z| of faces that the plates hold, at least
_PER_THICKNESS = 4.0  # cells through the body at the edges of the plates
_MOVED = 0.5  # of an edge length, by which corners are moved onto the edges of the plates
_THINNEST = 0.2  # of its volume that a cell keeps when its corners are moved


@dataclass(frozen=True, slots=True, eq=False)
class BentBody:
    """Equilibrium of a clamped body.

    Attributes:
        angle_deg: between the plates.
        field: displacement and mean stress of the body, a Deformation.
        energy: stored [J].
        moments: of the plates at small and at large x about the hinge axis, (2,) [N m].
        forces: of both plates on the body, (2, 3) [N].
        volume_ratio: deformed over undeformed volume.
    """

    angle_deg: float
    field: TetrahedralField
    energy: float
    moments: Array
    forces: Array
    volume_ratio: float


class ClampedBody:
    """Body between the plates of a hinge, meshed once for all angles.

    The plates hold, without slip, the faces that look up or down to within 45 degrees wherever
    |x| >= span / 2 from the middle of the body, and turn by +-theta/2 about an axis along y at
    the distance `offset` below the middle. The rest of the boundary is free.

    Attributes:
        body: the meshed body.
    """

    def __init__(
        self,
        design: SensorDesign,
        span: float,
        offset: float,
        mechanics: Mechanics | None = None,
        grading: Grading | None = None,
    ) -> None:
        """Mesh the body.

        Args:
            design: the sensor, with a surface as outline.
            span: free length between the plates [m].
            offset: of the hinge axis below the middle of the body [m].
            mechanics: materials; only the gel's law and bulk ratio are used.
            grading: finest at the edges of the plates, `layers` is not used; a quarter of the
                body's smaller extent along y and z when omitted.

        Raises:
            ConfigurationError: for a plane outline, a span that leaves nothing to clamp, or a body
                that needs too many cells.
        """
        surface, self._centre = surface_of(design), np.array(design.centre)
        if not 0.0 < span < surface.length:
            raise ConfigurationError(
                f"the span must be above 0 and below the body's length of {surface.length:g} m, "
                f"where the plates hold its ends, got {span:g} m"
            )
        self._half_span, self._offset = 0.5 * span, offset
        smaller = min(surface.width, surface.height)
        grading = grading or body_grading(design, smaller / _PER_THICKNESS)
        finest = grading.finest
        mesh = meshed(design, grading, self._plate_edges(design, finest))
        for side in (-1.0, 1.0):
            mesh = _with_corners_on(mesh, self._centre[0] + side * self._half_span, finest)
        self.body = TetrahedralSolid(mesh, mechanics or Mechanics())
        self._plates = self._held()
        both = np.concatenate(self._plates)
        self._fixed: Indices = np.sort((3 * both[:, None] + np.arange(3)).ravel())
        self._eliminate = self.body.solid.elimination(self._fixed)
        self._known: dict[float, Array] = {0.0: np.zeros(self.body.solid.unknowns)}

    def equilibria(self, angles_deg: Sequence[float]) -> Iterator[BentBody]:
        """Equilibria at angles [deg], by load stepping from the nearest solved angle.

        Raises SolidError, naming the angle reached, where no stable equilibrium is found.
        """
        for angle in angles_deg:
            if angle not in self._known:
                before = min(self._known, key=lambda known: abs(known - angle))
                self._known[angle] = self._followed(before, angle)
            yield self._result(angle, self._known[angle])

    def _followed(self, before: float, angle: float) -> Array:
        path = partial(self._between, before, angle)
        step = min(1.0, 10.0 / abs(angle - before))
        try:
            return follow([self.body.solid], self._known[before], path, step, self._eliminate)[0]
        except SolidError as error:
            reached = before + error.reached * (angle - before)
            raise SolidError(
                f"the clamped body was bent to {reached:.1f} deg of {angle:g} deg: {error}",
                error.reached,
            ) from error

    def _plate_edges(self, design: SensorDesign, finest: float) -> Array:
        """Points along the edges of the plates on the body's surface, (k, 3) [m]."""
        points, faces = surface_of(design).triangles()
        ends = self._centre[0] + self._half_span * np.array([-1.0, 1.0])
        return _sections(points[faces], ends.tolist(), 2.0 * finest)

    def _held(self) -> tuple[Indices, Indices]:
        """Nodes held by the plates at small and at large x."""
        body = self.body
        gripped = np.abs(body.normals[:, 2]) > _GRIPPED
        along = body.middles[:, 0] - self._centre[0]
        nodes = body.solid.nodes[:, 0] - self._centre[0]
        found = []
        for side in (-1.0, 1.0):
            near = body.nodes_of(gripped & (side * along > self._half_span))
            near = near[side * nodes[near] > self._half_span - _SAME]
            if len(near) < 3:
                raise ConfigurationError(
                    f"the plates with a span of {2 * self._half_span:g} m find no face of the body "
                    "to hold, looking up or down to within 45 deg; choose a shorter span"
                )
            found.append(near)
        return found[0], found[1]

    def _between(self, before: float, after: float, t: float) -> Load:
        """Prescribed displacements at the fraction t between two angles [deg]."""
        solid, angle_deg = self.body.solid, before + t * (after - before)
        u = np.zeros_like(solid.nodes)
        for side, held in zip((-1.0, 1.0), self._plates, strict=True):
            X = solid.nodes[held]
            u[held] = self._turned(X, side * 0.5 * math.radians(angle_deg)) - X
        return Load(self._fixed, u.ravel()[self._fixed], np.zeros(solid.unknowns))

    def _turned(self, points: Array, angle: float) -> Array:
        """Points rotated about the hinge axis, downwards at x > 0 for positive angles [rad]."""
        cos, sin = math.cos(angle), math.sin(angle)
        axis = self._centre - np.array([0.0, 0.0, self._offset])
        R = np.array([[cos, 0.0, sin], [0.0, 1.0, 0.0], [-sin, 0.0, cos]])
        turned: Array = (points - axis) @ R.T + axis
        return turned

    def _result(self, angle_deg: float, x: Array) -> BentBody:
        solid = self.body.solid
        u, f = solid.displacement(x), solid.displacement(solid.forces(x))
        axis = self._centre - np.array([0.0, 0.0, self._offset])
        moments, forces = [], []
        for side, held in zip((-1.0, 1.0), self._plates, strict=True):
            arm = solid.nodes[held] + u[held] - axis
            turning = np.sum(arm[:, 2] * f[held, 0] - arm[:, 0] * f[held, 2])
            moments.append(float(side * turning))
            forces.append(f[held].sum(axis=0))
        J = solid.volume_ratio(x) * solid.weights
        return BentBody(
            angle_deg=angle_deg,
            field=self.body.field(x),
            energy=solid.energy(x),
            moments=np.array(moments),
            forces=np.array(forces),
            volume_ratio=float(J.sum() / solid.weights.sum()),
        )


def _sections(corners: Array, planes: Sequence[float], spacing: float) -> Array:
    """Points (k, 3) [m], `spacing` apart, on sections of triangles (n, 3, 3) by planes of x."""
    found = []
    for x in planes:
        side = np.sign(corners[..., 0] - x)
        for triangle in corners[(side.min(axis=1) < 0.0) & (side.max(axis=1) > 0.0)]:
            ends = [
                a + (x - a[0]) / (b[0] - a[0]) * (b - a)
                for a, b in itertools.combinations(triangle, 2)
                if min(a[0], b[0]) <= x <= max(a[0], b[0]) and a[0] != b[0]
            ]
            count = 2 + math.ceil(float(np.linalg.norm(ends[0] - ends[-1])) / spacing)
            found.append(np.linspace(ends[0], ends[-1], count))
    return np.concatenate(found)


def _with_corners_on(mesh: skfem.MeshTet, x: float, finest: float) -> skfem.MeshTet:
    """Mesh with the boundary corners nearest to a plane of x [m] moved onto the plane.

    Corners are moved along x only, and only where all cells around them keep a good part of their
    volume: edges of plates then lie between cells.
    """
    points, cells = mesh.p.copy(), mesh.t
    rim = mesh.boundary_nodes()
    near = rim[np.abs(points[0, rim] - x) < _MOVED * finest]
    whole = _volumes(points, cells)
    for node in near[np.argsort(np.abs(points[0, near] - x))]:
        around = np.any(cells == node, axis=0)
        before = points[0, node]
        points[0, node] = x
        kept = _volumes(points, cells[:, around]) / whole[around]
        if kept.min() < _THINNEST:
            points[0, node] = before
    return skfem.MeshTet(points, cells)


def _volumes(points: Array, cells: Indices) -> Array:
    """Signed volumes of cells (4, n) [m3], (n,)."""
    corners = points[:, cells]
    edges = (corners[:, 1:] - corners[:, :1]).transpose(2, 1, 0)
    return np.asarray(np.linalg.det(edges) / 6.0)
