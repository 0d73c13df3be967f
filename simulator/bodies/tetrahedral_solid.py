"""Soft body on tetrahedra: mesh, faces, and order of elimination."""

import numpy as np
import skfem
from numpy.typing import NDArray

from eitskin.errors import ConfigurationError
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.geometry.design.surface import Surface
from eitskin.geometry.meshing.grading import Grading
from eitskin.geometry.meshing.tetrahedra import tetrahedral_body
from eitskin.simulator.bodies.tetrahedral_field import TetrahedralField
from eitskin.simulator.mechanics.layer_stack import Mechanics
from eitskin.simulator.mechanics.mixed_solid import Solid

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

_CELLS = 1200.0  # tetrahedra of a body far from clamps and touches, about
_GROWTH = 0.7  # of their size, per distance from clamps and touches
_PER_CUBE = 8.5  # tetrahedra in a cube of their edge length
_MOST_CELLS = 20_000  # about 2 GB of memory and 20 s for each step of Newton's method
_LEAF = 24  # tetrahedra that are eliminated at once


class TetrahedralSolid:
    """Bare soft body, meshed by quadratic tetrahedra.

    A body from a surface file is the conductive gel itself, without encapsulation.

    Attributes:
        solid: the meshed body.
        facets: numbers of the boundary facets of the mesh.
        normals: their outward unit normals, (facets, 3).
        middles: of these facets, (facets, 3) [m].
    """

    def __init__(self, mesh: skfem.MeshTet, mechanics: Mechanics) -> None:
        """Number the unknowns of a mesh and find its boundary.

        Raises ConfigurationError for more cells than memory and time allow.
        """
        count = mesh.t.shape[1]
        if count > _MOST_CELLS:
            raise ConfigurationError(
                f"the body needs {count} tetrahedra for its bend or touches, at most {_MOST_CELLS} "
                "are solved; use larger indenters, fewer touches, or a simpler surface"
            )
        self.solid = Solid(mesh, (mechanics.gel,), None, "solid", mechanics.bulk_ratio)
        self.facets: Indices = mesh.boundary_facets().astype(np.int64)
        corners = mesh.p.T[mesh.facets[:, self.facets].T]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        self.middles: Array = corners.mean(axis=1)
        within = mesh.p[:, mesh.t[:, mesh.f2t[0, self.facets]]].mean(axis=1).T
        outward = np.sign(np.sum(normals * (self.middles - within), axis=1))
        self.normals: Array = normals * (outward / np.linalg.norm(normals, axis=1))[:, None]

    def nodes_of(self, chosen: NDArray[np.bool_]) -> Indices:
        """Numbers of the nodes on boundary facets chosen by flags (facets,)."""
        if not chosen.any():
            return np.zeros(0, dtype=np.int64)
        dofs = self.solid.basis.get_dofs(facets=self.facets[chosen]).flatten()
        return np.unique(dofs).astype(np.int64)

    def field(self, x: Array) -> TetrahedralField:
        """Displacement and mean stress of the unknowns x (n,)."""
        solid = self.solid
        u = solid.displacement(x)
        return TetrahedralField(
            points=np.ascontiguousarray(solid.mesh.p.T),
            cells=np.ascontiguousarray(solid.mesh.t.T.astype(np.int64)),
            values=u[solid.basis.element_dofs.T],
            stress=np.nan_to_num(solid.corner_mean_stress(x, 0)),
        )


def surface_of(design: SensorDesign) -> Surface:
    """Surface of a body; raises ConfigurationError for plane outlines."""
    if not isinstance(design.outline, Surface):
        raise ConfigurationError(
            f"expected a surface as outline, got {type(design.outline).__name__}; give its file"
        )
    return design.outline


def body_grading(design: SensorDesign, finest: float) -> Grading:
    """Default sizes of the tetrahedra of a body, `finest` [m] at clamps and touches."""
    points, faces = surface_of(design).triangles()
    a, b, c = points[faces].swapaxes(0, 1)
    volume = float(np.sum(a * np.cross(b, c))) / 6.0
    coarsest = (_PER_CUBE * volume / _CELLS) ** (1.0 / 3.0)
    return Grading(finest=min(finest, coarsest), coarsest=coarsest, growth=_GROWTH)


def meshed(design: SensorDesign, grading: Grading, near: Array) -> skfem.MeshTet:
    """Tetrahedra of a body, finest at points `near` (k, 3) [m]."""
    points, cells = tetrahedral_body(design, grading, near)
    return skfem.MeshTet(np.ascontiguousarray(points.T), np.ascontiguousarray(cells.T))
