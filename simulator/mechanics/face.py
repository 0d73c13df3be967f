"""Face of a solid: integrals of tractions and springs between it and a rigid body."""

import numpy as np
import skfem
from numpy.typing import NDArray
from scipy.sparse import coo_array, csc_array

from eitskin.simulator.mechanics.mixed_solid import Solid

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


class Face:
    """Boundary facets of a solid, with points of a quadrature.

    A rigid body may move along a fixed direction towards the face; its depth d [m] is then one more
    unknown, and displacements are counted relative to the body's motion -d.

    Attributes:
        dim: displacement components.
        points: points of the undeformed face, (facets, q, dim) [m].
        values: shape functions of the displacement there, (facets, q, functions).
        weights: undeformed areas, (facets, q) [m2].
        depth: number of the unknown d; None for a face alone.
    """

    def __init__(
        self,
        solid: Solid,
        facets: Indices,
        rule: int | tuple[Array, Array],
        depth: int | None = None,
        direction: Array | None = None,
    ) -> None:
        """Evaluate the shape functions.

        Args:
            solid: the body.
            facets: boundary facets of its mesh.
            rule: order of the quadrature, or its points and weights.
            depth: number of the unknown d, after those of the solid.
            direction: unit vector against the motion of the rigid body, (dim,); upwards when
                omitted.
        """
        how = {"intorder": rule} if isinstance(rule, int) else {"quadrature": rule}
        self._basis = skfem.FacetBasis(solid.mesh, solid.basis.elem, facets=facets, **how)
        self.dim, self.depth = solid.dim, depth
        self.points: Array = np.moveaxis(np.asarray(self._basis.global_coordinates()), 0, -1)
        shape = self.points.shape[:2]
        functions = [np.broadcast_to(np.asarray(f), shape) for (f,) in self._basis.basis]
        self.values: Array = np.stack(functions, axis=-1)
        ring = 2.0 * np.pi * self.points[..., 0] if solid.kinematics == "axisymmetric" else 1.0
        self.weights: Array = np.asarray(self._basis.dx) * ring
        self._direction = np.eye(self.dim)[-1] if direction is None else direction
        dofs = self._basis.element_dofs.T.astype(np.int64)
        numbers = (self.dim * dofs[:, :, None] + np.arange(self.dim)).reshape(len(dofs), -1)
        last = np.full((len(dofs), int(depth is not None)), depth or 0)
        self._numbers: Indices = np.hstack([numbers, last])

    @property
    def slopes(self) -> Array:
        """Gradients of the shape functions, (facets, q, functions, dim) [1/m]."""
        slopes = [np.moveaxis(np.asarray(f.grad), 0, -1) for (f,) in self._basis.basis]
        return np.stack(slopes, axis=2)

    @property
    def normals(self) -> Array:
        """Unit normals of the undeformed face, (facets, q, dim)."""
        shape = self.dim, *self.points.shape[:2]
        return np.moveaxis(np.broadcast_to(self._basis.normals, shape), 0, -1)

    def displacements(self, x: Array) -> Array:
        """Nodal displacements of each facet, (facets, functions, dim), of the unknowns x (n,)."""
        u: Array = x[self._numbers[:, : self.dim * self.values.shape[-1]]]
        return u.reshape(len(u), -1, self.dim)

    def forces(self, traction: Array, size: int) -> Array:
        """Forces (size,) [N] on the unknowns by tractions (facets, q, dim) [Pa] at the points."""
        traction = traction * self.weights[..., None]
        nodal = (self.values.swapaxes(1, 2) @ traction).reshape(len(traction), -1)
        if self.depth is not None:
            nodal = np.hstack([nodal, (traction @ self._direction).sum(axis=1)[:, None]])
        forces = np.bincount(self._numbers.ravel(), weights=nodal.ravel(), minlength=size)
        return np.asarray(forces, dtype=np.float64)

    def stiffness(self, springs: Array, size: int) -> csc_array:
        """Stiffness (size, size) of springs (facets, q, dim, dim), or of equal ones (dim, dim).

        Springs [Pa/m] join the face to the rigid body, or to where it is without one.
        """
        values = self.values
        if self.depth is not None:
            values = np.concatenate([values, np.ones((*values.shape[:2], 1))], axis=-1)
        shares = values * self.weights[..., None]
        # Springs that are alike take a ninth of the work.
        parts = "fqa,fqb,ij->faibj" if springs.ndim == 2 else "fqa,fqb,fqij->faibj"
        K = np.einsum(parts, shares, values, springs, optimize=True)
        K = K.reshape(len(K), self.dim * values.shape[-1], -1)
        if self.depth is not None:  # the last of the vectors is d times the direction
            join = np.eye(K.shape[1])[:, : self._numbers.shape[1]]
            join[-self.dim :, -1] = self._direction
            K = join.T @ K @ join
        rows = np.broadcast_to(self._numbers[:, :, None], K.shape).ravel()
        columns = np.broadcast_to(self._numbers[:, None, :], K.shape).ravel()
        return coo_array((K.ravel(), (rows, columns)), shape=(size, size)).tocsc()
