"""Face of a solid: tractions, springs and penalty contact between it and a rigid body."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import skfem
from numpy.typing import NDArray
from scipy.sparse import coo_array, csc_array

from eitskin.simulator.mechanics.load_stepping import ForceTerm
from eitskin.simulator.mechanics.materials import cofactor
from eitskin.simulator.mechanics.mixed_solid import Solid
from eitskin.simulator.scene.indenters import Indenter, penetration

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


class Face:
    """Boundary facets of a solid, with points of a quadrature.

    A rigid body may move along a fixed direction towards the face, by a depth d [m], and tilt. Its
    motions are further unknowns: the first is d, and each moves the points by -lever times the
    unknown. Displacements are counted relative to the body.

    Attributes:
        dim: displacement components.
        points: points of the undeformed face, (facets, q, dim) [m].
        values: shape functions of the displacement there, (facets, q, functions).
        weights: undeformed areas, (facets, q) [m2].
        motions: numbers of the unknown motions; none for a face alone.
        levers: levers of the motions at the points, (facets, q, motions); 1 for d.
    """

    def __init__(
        self,
        solid: Solid,
        facets: Indices,
        rule: int | tuple[Array, Array],
        motions: Sequence[int] = (),
        direction: Array | None = None,
    ) -> None:
        """Evaluate the shape functions.

        Args:
            solid: the body.
            facets: boundary facets of its mesh.
            rule: order of the quadrature, or its points and weights.
            motions: numbers of the unknown motions, after those of the solid. The levers of all are
                1 until others are set.
            direction: unit vector against the motion of the rigid body, (dim,); upwards when
                omitted.
        """
        how = {"intorder": rule} if isinstance(rule, int) else {"quadrature": rule}
        self._basis = skfem.FacetBasis(solid.mesh, solid.basis.elem, facets=facets, **how)
        self.dim, self.motions = solid.dim, tuple(motions)
        self.points: Array = np.moveaxis(np.asarray(self._basis.global_coordinates()), 0, -1)
        shape = self.points.shape[:2]
        functions = [np.broadcast_to(np.asarray(f), shape) for (f,) in self._basis.basis]
        self.values: Array = np.stack(functions, axis=-1)
        ring = 2.0 * np.pi * self.points[..., 0] if solid.kinematics == "axisymmetric" else 1.0
        self.weights: Array = np.asarray(self._basis.dx) * ring
        self.levers: Array = np.ones((*shape, len(self.motions)))
        self.direction: Array = np.eye(self.dim)[-1] if direction is None else direction
        dofs = self._basis.element_dofs.T.astype(np.int64)
        numbers = (self.dim * dofs[:, :, None] + np.arange(self.dim)).reshape(len(dofs), -1)
        last = np.tile(np.array(self.motions, dtype=np.int64), (len(dofs), 1))
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
        if self.motions:
            along = (traction @ self.direction)[:, None]
            nodal = np.hstack([nodal, (along @ self.levers)[:, 0]])
        forces = np.bincount(self._numbers.ravel(), weights=nodal.ravel(), minlength=size)
        return np.asarray(forces, dtype=np.float64)

    def stiffness(self, springs: Array, size: int) -> csc_array:
        """Stiffness (size, size) of springs (facets, q, dim, dim), or of equal ones (dim, dim).

        Springs [Pa/m] join the face to the rigid body, or to where it is without one.
        """
        shares = self.values * self.weights[..., None]
        # Springs that are alike take a ninth of the work.
        parts = "fqa,fqb,ij->faibj" if springs.ndim == 2 else "fqa,fqb,fqij->faibj"
        K = np.einsum(parts, shares, self.values, springs, optimize=True)
        K = K.reshape(len(K), self.dim * self.values.shape[-1], -1)
        if self.motions:
            along = np.broadcast_to(springs @ self.direction, (*shares.shape[:2], self.dim))
            joined = np.einsum("fqa,fqi,fqm->faim", shares, along, self.levers, optimize=True)
            joined = joined.reshape(*K.shape[:2], -1)
            loaded = self.levers * (self.weights * (along @ self.direction))[..., None]
            own = self.levers.swapaxes(1, 2) @ loaded
            K = np.block([[K, joined], [joined.swapaxes(1, 2), own]])
        rows = np.broadcast_to(self._numbers[:, :, None], K.shape).ravel()
        columns = np.broadcast_to(self._numbers[:, None, :], K.shape).ravel()
        return coo_array((K.ravel(), (rows, columns)), shape=(size, size)).tocsc()


_TOLERANCE = 1e-9  # [m]


@dataclass(frozen=True, slots=True, eq=False)
class PenaltyContact(ForceTerm):
    """Penalty contact: pressure proportional to penetration, and no tension.

    A point of the face that penetrates the indenter by g is pushed back along the indenter's
    normal by q = k max(0, g) per undeformed area. A rough indenter also holds points across the
    normal, by a spring k to the position of first contact. Unknowns are those of the solid, then
    the depths d of indenters below the undeformed face, one per contact.

    Attributes:
        face: face that may be touched, with the unknown d.
        indenter: shape of the rigid body.
        stiffness: k [Pa/m].
        centre: horizontal position of the axis, (dim - 1,) [m].
        lowest: height of the indenter's lowest point at the depth 0 [m].
        anchors: positions at which points are held, from the lowest point, (facets, q, dim) [m].
        holds: projections across the normal at the anchors, zero where a point is free to slide,
            (facets, q, dim, dim).
    """

    face: Face
    indenter: Indenter
    stiffness: float
    centre: Array
    lowest: float
    anchors: Array
    holds: Array

    @classmethod
    def from_facets(
        cls,
        solid: Solid,
        facets: Indices,
        indenter: Indenter,
        stiffness: float,
        centre: Array,
        number: int = 0,
        lowest: float | None = None,
    ) -> "PenaltyContact":
        """Contact `number` on a face of boundary facets of the solid's mesh, at rest.

        The indenter's lowest point starts at the height `lowest` [m], the face's greatest height
        when omitted. A rough flat end holds the points that it touches there from the start.
        """
        # The rule of order 3 on triangles has a negative weight, which would pull at the face.
        order = 4 if isinstance(solid.mesh, skfem.MeshTet1) else 3
        face = Face(solid, facets, order, [solid.unknowns + number])
        above = float(face.points[..., -1].max()) if lowest is None else lowest
        anchors = face.points - np.append(centre, above)
        anchors[np.abs(anchors[..., -1]) < _TOLERANCE, -1] = 0.0
        r = np.linalg.norm(anchors[..., :-1], axis=-1)
        flat = (indenter.profile(r)[0] <= anchors[..., -1]).astype(np.float64) * indenter.rough
        horizontal = np.diag([*[1.0] * (solid.dim - 1), 0.0])
        holds = flat[..., None, None] * horizontal
        return cls(face, indenter, stiffness, centre, above, anchors, holds)

    @property
    def depth(self) -> int:
        """Number of the unknown d."""
        return self.face.motions[0]

    def nominal_pressure(self, x: Array) -> Array:
        """Nominal pressure q, force along the normal per undeformed area, (facets, q) [Pa]."""
        return self.stiffness * np.maximum(self._penetration(x)[0], 0.0)

    def force(self, x: Array) -> float:
        """Total vertical force [N]."""
        return float(self.forces(x)[self.depth])

    def depth_touching(self, radius: float, points: int) -> float:
        """Depth at which the undeformed face is in contact up to a radius [m], at `points` points.

        Parts of the face that slope away from the indenter may not be in contact there.
        """
        r = np.linalg.norm(self.face.points[..., :-1] - self.centre, axis=-1)
        gaps = self.lowest + self.indenter.profile(r)[0] - self.face.points[..., -1]
        count = min(max(points, int(0.5 * np.count_nonzero(r < radius))), gaps.size)
        return float(np.sort(gaps, axis=None)[count - 1])

    def energy(self, x: Array) -> float:
        """Penalty energy of the contact [J]."""
        slip = np.einsum("fqij,fqj->fqi", self.holds, self._relative(x) - self.anchors)
        squares = np.maximum(self._penetration(x)[0], 0.0) ** 2 + np.sum(slip**2, axis=-1)
        return float(0.5 * self.stiffness * np.sum(self.face.weights * squares))

    def advance(self, x: Array) -> "PenaltyContact":
        """Contact after a load step: a rough indenter now holds the points in contact."""
        if not self.indenter.rough:
            return self
        _, normal, _ = self._penetration(x)
        relative = self._relative(x)
        touching = self.nominal_pressure(x) > 0.0
        holding = np.any(self.holds != 0.0, axis=(-2, -1))
        across = np.eye(self.face.dim) - normal[..., :, None] * normal[..., None, :]
        new = (touching & ~holding)[..., None]
        return replace(
            self,
            anchors=np.where(new, relative, self.anchors),
            holds=np.where(new[..., None], across, self.holds) * touching[..., None, None],
        )

    def pressure(self, x: Array) -> tuple[Array, Array]:
        """Distance from the axis [m] and pressure on the deformed face [Pa], sorted.

        For axisymmetric solids only.
        """
        r = self._relative(x)[..., 0]
        along = np.einsum("fqa,fai->fqi", self.face.slopes[..., 0], self.face.displacements(x))
        along += np.array([1.0, 0.0])
        area_ratio = r / self.face.points[..., 0] * np.linalg.norm(along, axis=-1)
        order = np.argsort(r, axis=None)
        return r.ravel()[order], (self.nominal_pressure(x) / area_ratio).ravel()[order]

    def area_and_peak(self, x: Array) -> tuple[float, float]:
        """Deformed area in contact [m2] and largest pressure on the deformed face [Pa], in 3D."""
        F = np.eye(3) + np.einsum("fai,fqaJ->fqiJ", self.face.displacements(x), self.face.slopes)
        stretch = np.einsum("...ij,...j->...i", cofactor(F), self.face.normals)
        area_ratio = np.linalg.norm(stretch, axis=-1)
        q = self.nominal_pressure(x)
        area = np.sum((q > 0.0) * self.face.weights * area_ratio)
        return float(area), float((q / area_ratio).max())

    def forces(self, x: Array) -> Array:
        """Forces on the unknowns (n,) [N]."""
        g, normal, _ = self._penetration(x)
        return self._assemble(x, g, normal)

    def linearise(self, x: Array) -> tuple[Array, csc_array]:
        """Forces on the unknowns and symmetric stiffness; semi-smooth where contact ends."""
        g, normal, curvature = self._penetration(x)
        pushing = (g > 0.0)[..., None, None] * normal[..., :, None] * normal[..., None, :]
        springs = pushing + self.holds + np.maximum(g, 0.0)[..., None, None] * curvature
        K = self.face.stiffness(self.stiffness * springs, len(x))
        return self._assemble(x, g, normal), K

    def _assemble(self, x: Array, g: Array, normal: Array) -> Array:
        slip = np.einsum("fqij,fqj->fqi", self.holds, self._relative(x) - self.anchors)
        traction = np.maximum(g, 0.0)[..., None] * normal + slip
        return self.face.forces(self.stiffness * traction, len(x))

    def _relative(self, x: Array) -> Array:
        """Deformed positions relative to the indenter's lowest point, (facets, q, dim) [m]."""
        moved: Array = self.face.points + self.face.values @ self.face.displacements(x)
        moved[..., :-1] -= self.centre
        moved[..., -1] += x[self.depth] - self.lowest
        return moved

    def _penetration(self, x: Array) -> tuple[Array, Array, Array]:
        """Penetration g (facets, q), gradient (..., dim) and second derivative (..., dim, dim)."""
        relative = self._relative(x)
        r = np.maximum(np.linalg.norm(relative[..., :-1], axis=-1), 1e-12)
        g, (radial, upward), bend = penetration(self.indenter, r, relative[..., -1])
        direction = relative[..., :-1] / r[..., None]
        normal = np.concatenate([radial[..., None] * direction, upward[..., None]], axis=-1)
        tangent = np.concatenate([upward[..., None] * direction, -radial[..., None]], axis=-1)
        second = bend[..., None, None] * tangent[..., :, None] * tangent[..., None, :]
        sideways = np.eye(self.face.dim - 1) - direction[..., :, None] * direction[..., None, :]
        second[..., :-1, :-1] += (radial / r)[..., None, None] * sideways
        return g, normal, second
