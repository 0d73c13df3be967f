"""Bends of a body of any shape between two turning plates."""

import itertools
import math
from collections.abc import Sequence

import numpy as np
import skfem
from numpy.typing import NDArray

from eitskin.errors import ConfigurationError
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.geometry.design.surface import Surface
from eitskin.geometry.meshing.grading import Grading
from eitskin.simulator.bodies.tetrahedral_solid import (
    TetrahedralField,
    TetrahedralSolid,
    body_grading,
    mesh_body,
    require_surface,
)
from eitskin.simulator.mechanics.layer_stack import Mechanics
from eitskin.simulator.mechanics.turning_plates import TurningPlates

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

_TOLERANCE = 1e-9  # [m]
_MIN_GRIPPED_NORMAL = math.cos(math.radians(45.0))  # |n_z| of faces that the plates hold, at least
_PER_THICKNESS = 4.0  # cells through the body at the edges of the plates
# of an edge length, by which corners are moved onto the edges of the plates
_MAX_CORNER_SHIFT = 0.5
_MAX_STEP = 10.0  # of the angle, at first [deg]
_MIN_CELL_VOLUME = 0.2  # of its volume that a cell keeps when its corners are moved


class ClampedBody:
    """Body between the plates of a hinge, meshed once for all angles.

    The plates hold, without slip, the faces that look up or down to within 45 degrees wherever
    |x| >= span / 2 from the middle of the body, and turn by +-theta/2 about an axis along y at
    the distance `offset` below the middle. The rest of the boundary is free.

    Attributes:
        body: the meshed body.
        plates: plates that hold it; with all equilibria, their energies and moments.
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
            offset: offset of the hinge axis below the middle of the body [m].
            mechanics: materials; only the gel's law and bulk ratio are used.
            grading: finest at the edges of the plates, `layers` is not used; a quarter of the
                body's smaller extent along y and z when omitted.

        Raises:
            ConfigurationError: for a plane outline, a span that leaves nothing to clamp, or a body
                that needs too many cells.
        """
        surface, self._centre = require_surface(design), np.array(design.centre)
        if not 0.0 < span < surface.length:
            raise ConfigurationError(
                f"the span must be above 0 and below the body's length of {surface.length:g} m, "
                f"where the plates hold its ends, got {span:g} m"
            )
        self._half_span = 0.5 * span
        smaller = min(surface.width, surface.height)
        grading = grading or body_grading(design, smaller / _PER_THICKNESS)
        finest = grading.finest
        mesh = mesh_body(design, grading, self._plate_edges(surface, finest))
        for side in (-1.0, 1.0):
            mesh = _snap_corners_to_plane(mesh, self._centre[0] + side * self._half_span, finest)
        self.body = TetrahedralSolid(mesh, mechanics or Mechanics())
        held = {side: self._clamped_nodes(side) for side in (-1.0, 1.0)}
        nodes = np.concatenate([*held.values()])
        fixed = np.sort(self.body.solid.displacement_unknowns(nodes))
        axis, longest = self._centre - np.array([0.0, 0.0, offset]), _MAX_STEP
        self.plates = TurningPlates(self.body.solid, held, axis, fixed, None, longest)

    def solve_angle(self, angle_deg: float) -> TetrahedralField:
        """Deformation by an angle between the plates [deg].

        Raises SolidError, naming the angle reached, where no stable equilibrium is found.
        """
        return self.body.field(self.plates.equilibrium(angle_deg))

    def _plate_edges(self, surface: Surface, finest: float) -> Array:
        """Points along the edges of the plates on the body's surface, (k, 3) [m]."""
        points, faces = surface.triangles()
        ends = self._centre[0] + self._half_span * np.array([-1.0, 1.0])
        return _sections(points[faces], ends.tolist(), 2.0 * finest)

    def _clamped_nodes(self, side: float) -> Indices:
        """Nodes held by the plate at small or at large x, of the side -1 or 1."""
        body = self.body
        gripped = np.abs(body.normals[:, 2]) > _MIN_GRIPPED_NORMAL
        along = side * (body.middles[:, 0] - self._centre[0])
        near = body.solid.facet_nodes(body.facets[gripped & (along > self._half_span)])
        x = side * (body.solid.nodes[near, 0] - self._centre[0])
        nodes: Indices = near[x > self._half_span - _TOLERANCE]
        if len(nodes) < 3:
            raise ConfigurationError(
                f"the plates with a span of {2 * self._half_span:g} m find no face of the body "
                "to hold, looking up or down to within 45 deg; choose a shorter span"
            )
        return nodes


def _sections(corners: Array, planes: Sequence[float], spacing: float) -> Array:
    """Points (k, 3) [m], `spacing` apart, on sections of triangles (n, 3, 3) by planes of x."""
    sections = []
    for x in planes:
        side = np.sign(corners[..., 0] - x)
        for triangle in corners[(side.min(axis=1) < 0.0) & (side.max(axis=1) > 0.0)]:
            ends = [
                a + (x - a[0]) / (b[0] - a[0]) * (b - a)
                for a, b in itertools.combinations(triangle, 2)
                if min(a[0], b[0]) <= x <= max(a[0], b[0]) and a[0] != b[0]
            ]
            count = 2 + math.ceil(float(np.linalg.norm(ends[0] - ends[-1])) / spacing)
            sections.append(np.linspace(ends[0], ends[-1], count))
    return np.concatenate(sections)


def _snap_corners_to_plane(mesh: skfem.MeshTet, x: float, finest: float) -> skfem.MeshTet:
    """Mesh with the boundary corners nearest to a plane of x [m] moved onto the plane.

    Corners are moved along x only, and only where all cells around them keep a good part of their
    volume: edges of plates then lie between cells.
    """
    points, cells = mesh.p.copy(), mesh.t
    rim = mesh.boundary_nodes()
    near = rim[np.abs(points[0, rim] - x) < _MAX_CORNER_SHIFT * finest]
    whole = _volumes(points, cells)
    for node in near[np.argsort(np.abs(points[0, near] - x))]:
        around = np.any(cells == node, axis=0)
        before = points[0, node]
        points[0, node] = x
        volume_ratios = _volumes(points, cells[:, around]) / whole[around]
        if volume_ratios.min() < _MIN_CELL_VOLUME:
            points[0, node] = before
    return skfem.MeshTet(points, cells)


def _volumes(points: Array, cells: Indices) -> Array:
    """Signed volumes of cells (4, n) [m3], (n,)."""
    corners = points[:, cells]
    edges = (corners[:, 1:] - corners[:, :1]).transpose(2, 1, 0)
    return np.asarray(np.linalg.det(edges) / 6.0)
