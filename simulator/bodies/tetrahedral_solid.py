"""Soft body on tetrahedra: mesh, faces, order of elimination, and displacement field."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import skfem
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from eitskin.errors import ConfigurationError
from eitskin.geometry.deformation.kinematics import Deformation, Gradients, Points
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.geometry.design.surface import Surface
from eitskin.geometry.meshing.grading import Grading
from eitskin.geometry.meshing.tetrahedra import tetrahedral_body
from eitskin.simulator.mechanics.face import Face
from eitskin.simulator.mechanics.layer_stack import Mechanics
from eitskin.simulator.mechanics.mixed_solid import Solid

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

_CELLS = 1200.0  # tetrahedra of a body far from clamps and touches, about
_GROWTH = 0.7  # of their size, per distance from clamps and touches
_PER_CUBE = 8.5  # tetrahedra in a cube of their edge length
_MAX_CELLS = 20_000  # about 2 GB of memory and 20 s for each step of Newton's method
_ELEMENT = skfem.ElementTetP2()
_FEW, _MANY = 12, 200  # cells tried around a point, by the distance of their middles
_INSIDE = -1e-9  # distance from a cell within which a point counts as inside, over the body's size
_AT_ONCE = 40_000  # points per chunk


class TetrahedralSolid:
    """Bare soft body, meshed by quadratic tetrahedra.

    A body from a surface file is the conductive gel itself, without encapsulation.

    Attributes:
        solid: the meshed body.
        facets: numbers of the boundary facets of the mesh.
        normals: their outward unit normals, (facets, 3).
        middles: middles of these facets, (facets, 3) [m].
    """

    def __init__(self, mesh: skfem.MeshTet, mechanics: Mechanics) -> None:
        """Number the unknowns of a mesh and find its boundary.

        Raises ConfigurationError for more cells than memory and time allow.
        """
        count = mesh.t.shape[1]
        if count > _MAX_CELLS:
            raise ConfigurationError(
                f"the body needs {count} tetrahedra for its bend or touches, at most {_MAX_CELLS} "
                "are solved; use larger indenters, fewer touches, or a simpler surface"
            )
        self.solid = Solid(mesh, (mechanics.gel,), None, "solid", mechanics.bulk_ratio)
        self.facets: Indices = mesh.boundary_facets().astype(np.int64)
        self.middles: Array = mesh.p[:, mesh.facets[:, self.facets]].mean(axis=1).T
        self.normals: Array = Face(self.solid, self.facets, 1).normals[:, 0]

    def field(self, x: Array) -> "TetrahedralField":
        """Displacement and mean stress of the unknowns x (n,)."""
        solid = self.solid
        u = solid.displacement(x)
        return TetrahedralField(
            points=np.ascontiguousarray(solid.mesh.p.T),
            cells=np.ascontiguousarray(solid.mesh.t.T.astype(np.int64)),
            values=u[solid.basis.element_dofs.T],
            stress=np.nan_to_num(solid.corner_mean_stress(x, 0)),
        )


def require_surface(design: SensorDesign) -> Surface:
    """Surface of a body; raises ConfigurationError for plane outlines."""
    if not isinstance(design.outline, Surface):
        raise ConfigurationError(
            f"expected a surface as outline, got {type(design.outline).__name__}; give its file"
        )
    return design.outline


def body_grading(design: SensorDesign, finest: float) -> Grading:
    """Default sizes of the tetrahedra of a body, `finest` [m] at clamps and touches."""
    points, faces = require_surface(design).triangles()
    a, b, c = points[faces].swapaxes(0, 1)
    volume = float(np.sum(a * np.cross(b, c))) / 6.0
    coarsest = (_PER_CUBE * volume / _CELLS) ** (1.0 / 3.0)
    return Grading(finest=min(finest, coarsest), coarsest=coarsest, growth=_GROWTH)


def mesh_body(design: SensorDesign, grading: Grading, fine_points: Array) -> skfem.MeshTet:
    """Tetrahedra of a body, finest at points `fine_points` (k, 3) [m]."""
    points, cells = tetrahedral_body(design, grading, fine_points)
    return skfem.MeshTet(np.ascontiguousarray(points.T), np.ascontiguousarray(cells.T))


@dataclass(frozen=True, eq=False)
class TetrahedralField(Deformation):
    """Displacement field on tetrahedra with straight edges, quadratic in each.

    Points outside the mesh belong to the nearest cell, whose polynomial is continued to them.

    Attributes:
        points: corners of the cells, (n, 3) [m].
        cells: numbers of the corners, (m, 4).
        values: displacements at the nodes of skfem's quadratic element, (m, 10, 3) [m].
        stress: mean stress at the corners of the mesh, (n,) [Pa].
    """

    points: Array
    cells: Indices
    values: Array
    stress: Array

    def map_points(self, points: Points) -> tuple[Points, Gradients]:
        """Positions and deformation gradient in one pass."""
        flat = np.asarray(points, dtype=float).reshape(-1, 3)
        moved, F = np.empty_like(flat), np.empty((len(flat), 3, 3))
        for part, cells, place in self._locate_points(flat):
            values = self.values[cells]
            slopes = self._inverse[cells]  # of the coordinates 1 to 3
            functions = (_ELEMENT.lbasis(place[:, 1:].T, i) for i in range(values.shape[1]))
            shapes, rates = map(np.array, zip(*functions, strict=True))
            moved[part] = flat[part] + np.einsum("an,nai->ni", shapes, values)
            strained = np.einsum("abn,nai->nbi", rates, values)
            F[part] = np.eye(3) + np.einsum("nbi,nbJ->niJ", strained, slopes)
        shape = np.shape(points)
        return moved.reshape(shape), F.reshape(*shape, 3)

    def mean_stress(self, points: Points) -> Array:
        """Mean stress [Pa] at undeformed points (..., 3) [m], (...), positive in tension."""
        flat = np.asarray(points, dtype=float).reshape(-1, 3)
        mean_stress = np.empty(len(flat))
        for part, cells, place in self._locate_points(flat):
            mean_stress[part] = np.einsum("na,na->n", place, self.stress[self.cells[cells]])
        return mean_stress.reshape(np.shape(points)[:-1])

    def _locate_points(self, points: Array) -> Iterator[tuple[slice, Indices, Array]]:
        """Chunks of points, their cells (k,), and barycentric coordinates (k, 4) there."""
        for start in range(0, len(points), _AT_ONCE):
            part = slice(start, start + _AT_ONCE)
            here = points[part]
            cells, depth = self._nearest(here, _FEW)
            lost = np.flatnonzero(depth < _INSIDE * self._size)
            if len(lost):
                cells[lost], _ = self._nearest(here[lost], _MANY)
            yield part, cells, self._coordinates(here, cells)

    def _nearest(self, points: Array, candidates: int) -> tuple[Indices, Array]:
        """Nearest cell among those with the nearest middles, and depth inside that cell [m]."""
        count = min(candidates, len(self.cells))
        best = np.zeros(len(points), dtype=np.int64)
        depth = np.full(len(points), -np.inf)
        each = max(1, _AT_ONCE * _FEW // count)
        for start in range(0, len(points), each):
            part = slice(start, start + each)
            _, near = self._middles.query(points[part], k=count)
            near = near.reshape(-1, count)
            inside = self._coordinates(points[part, None], near) * self._heights[near]
            depths = inside.min(axis=-1)
            chosen = depths.argmax(axis=1)
            rows = np.arange(len(chosen))
            best[part], depth[part] = near[rows, chosen], depths[rows, chosen]
        return best, depth

    def _coordinates(self, points: Array, cells: Indices) -> Array:
        """Barycentric coordinates (..., 4) of points (..., 3) in cells (...)."""
        away = points - self.points[self.cells[cells, 0]]
        coordinates = np.einsum("...bJ,...J->...b", self._inverse[cells], away)
        return np.concatenate([1.0 - coordinates.sum(axis=-1, keepdims=True), coordinates], axis=-1)

    @cached_property
    def _size(self) -> float:
        return float(np.ptp(self.points, axis=0).max())

    @cached_property
    def _middles(self) -> cKDTree:
        return cKDTree(self.points[self.cells].mean(axis=1))

    @cached_property
    def _inverse(self) -> Array:
        """Gradients of the barycentric coordinates 1 to 3 of each cell, (m, 3, 3) [1/m]."""
        corners = self.points[self.cells]
        edges = (corners[:, 1:] - corners[:, :1]).swapaxes(1, 2)
        return np.asarray(np.linalg.inv(edges), dtype=np.float64)

    @cached_property
    def _heights(self) -> Array:
        """Distance of each corner from the opposite face, (m, 4) [m]."""
        first = -self._inverse.sum(axis=1, keepdims=True)
        slopes = np.concatenate([first, self._inverse], axis=1)
        return np.asarray(1.0 / np.linalg.norm(slopes, axis=2), dtype=np.float64)
