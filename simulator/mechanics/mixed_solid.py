"""Nearly incompressible solids at finite strain: mixed Taylor-Hood elements on a mesh.

Mixed form, total Lagrangian: the stationary points of

    int W(F) + p (J - 1) - p^2 / (2 kappa) dV,    F = 1 + du/dX, J = det F,

with quadratic displacements u and linear pressures p (Taylor and Hood 1973), the pressure
continuous within each material only. Eliminating p = kappa (J - 1) shows the energy of volume
changes, kappa/2 (J - 1)^2; a small part of kappa acts on the displacements directly. The mean
stress is positive in tension.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
import skfem
from numpy.typing import NDArray
from scipy.sparse import csc_array

from eitskin.errors import ConfigurationError
from eitskin.simulator.linalg.multifrontal import IndefiniteSolver
from eitskin.simulator.linalg.sparse_structure import (
    Block,
    ElementBlocks,
    StiffnessPattern,
    dissection,
)
from eitskin.simulator.mechanics.load_stepping import Factorise, ForceTerm
from eitskin.simulator.mechanics.materials import Law, cofactor, determinant

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Kinematics = Literal["plane strain", "axisymmetric", "solid"]

# Entries of F, flattened, that each displacement can change; (2, 2) is the hoop stretch.
_COMPONENTS = {
    "plane strain": ([0, 1], [3, 4]),
    "axisymmetric": ([0, 1, 8], [3, 4]),
    "solid": ([0, 1, 2], [3, 4, 5], [6, 7, 8]),
}
_ELEMENTS = {
    skfem.MeshQuad1: (skfem.ElementQuad2, skfem.ElementQuad1),
    skfem.MeshTri1: (skfem.ElementTriP2, skfem.ElementTriP1),
    skfem.MeshHex1: (skfem.ElementHex2, skfem.ElementHex1),
    skfem.MeshTet1: (skfem.ElementTetP2, skfem.ElementTetP1),
}
_EVEN = np.zeros((3, 3, 3))
for _i, _j, _k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
    _EVEN[_i, _j, _k], _EVEN[_i, _k, _j] = 1.0, -1.0
# The second derivative of a determinant: d cof(F)_iJ / dF_kL = e_ikm e_JLn F_mn.
_COFACTOR_SLOPE = np.einsum("ikm,JLn->mniJkL", _EVEN, _EVEN).reshape(9, 9, 9)
STIFFEST = 1e8  # kappa / mu
# Part of kappa / mu that acts on the displacements at every quadrature point. Without it, modes
# that linear pressures do not see become soft at large strain: bent blocks then wrinkle at 0.83 of
# their length instead of at Biot's 0.54 (Auricchio et al. 2005 describe the effect). With much
# more, quadratic displacements alone would lock.
_DIRECT = 3.0
_CHUNK = 4_000_000  # numbers held at once per array while the stiffness is assembled


@dataclass(frozen=True, slots=True, eq=False)
class StrainState:
    """Strain state at the quadrature points.

    Attributes:
        x: copy of the unknowns.
        F: deformation gradients, (cells, q, 3, 3).
        H: cofactors of F.
        J: determinants of F, (cells, q).
        multiplier: pressure of the mixed form [Pa], (cells, q).
    """

    x: Array
    F: Array
    H: Array
    J: Array
    multiplier: Array


class Solid(ForceTerm):
    """Meshed body of hyperelastic materials.

    Unknowns x are the displacements [m], node by node, then the pressures, scaled to have the
    size of displacements so that the stiffness is well scaled. Further unknowns may follow, such
    as the depth of an indenter, on which the solid exerts no force.

    Attributes:
        mesh: cells; two-dimensional ones hold (x, y), or (r, z) when axisymmetric [m].
        kinematics: plane strain, axisymmetric or solid.
        basis: shape functions of one displacement component, one per node.
        nodes: positions of the displacement nodes, (nodes, dim) [m].
        unknowns: number of displacements and pressures.
        cells_of_law: cells of each material.
    """

    def __init__(
        self,
        mesh: skfem.Mesh,
        laws: Sequence[Law],
        law_of_cell: Indices | None = None,
        kinematics: Kinematics = "plane strain",
        bulk_ratio: float = 1e5,
    ) -> None:
        """Number the unknowns and evaluate the shape functions.

        Args:
            mesh: quadrilaterals, triangles, hexahedra or tetrahedra of scikit-fem.
            laws: the materials.
            law_of_cell: number of the material of each cell; the first when omitted.
            kinematics: two-dimensional meshes are in plane strain or axisymmetric.
            bulk_ratio: kappa / mu of every material, 2 (1 + nu) / (3 (1 - 2 nu)).
        """
        self.mesh, self.kinematics, self.laws = mesh, kinematics, tuple(laws)
        elements = next(each for kind, each in _ELEMENTS.items() if isinstance(mesh, kind))
        if not 0.0 < bulk_ratio <= STIFFEST:
            raise ConfigurationError(
                f"bulk_ratio must lie above 0 and at most at {STIFFEST:g}, beyond which rounding "
                f"spoils the pressure, got {bulk_ratio}"
            )
        if law_of_cell is None:
            law_of_cell = np.zeros(mesh.t.shape[1], dtype=np.int64)
        self.basis = skfem.CellBasis(mesh, elements[0](), intorder=4)
        pressure = skfem.CellBasis(mesh, elements[1](), intorder=4)
        self.nodes: Array = np.ascontiguousarray(self.basis.doflocs.T)
        self._shape(pressure)
        self._number(pressure, law_of_cell)
        moduli = np.array([law.shear_modulus for law in laws])
        self.bulk_ratio, self.direct_ratio = bulk_ratio, min(_DIRECT, 0.5 * bulk_ratio)
        self._direct: Array = self.direct_ratio * moduli[law_of_cell]
        self._last: StrainState | None = None
        self._eliminated: tuple[tuple[int, bytes], Factorise] | None = None
        self._compliance: Array = 1.0 / ((bulk_ratio - self.direct_ratio) * moduli[law_of_cell])
        # A pressure of mu/h has the effect of a displacement of 1 in a cell of size h.
        size = np.mean(np.abs(np.ptp(mesh.p[:, mesh.t], axis=1)))
        self._pressure_scale = float(moduli.mean() / size)

    @property
    def dim(self) -> int:
        """Displacement components per node."""
        return 3 if self.kinematics == "solid" else 2

    @property
    def multipliers(self) -> int:
        """Number of pressures."""
        return self.unknowns - int(self.nodes.size)

    def facet_nodes(self, facets: Indices) -> Indices:
        """Numbers of the displacement nodes on boundary facets, rising."""
        if not len(facets):
            return np.zeros(0, dtype=np.int64)
        return np.unique(self.basis.get_dofs(facets=facets).flatten()).astype(np.int64)

    def displacement_unknowns(self, nodes: Indices) -> Indices:
        """Numbers of the displacements of nodes, node by node."""
        numbers: Indices = (self.dim * nodes[:, None] + np.arange(self.dim)).ravel()
        return numbers

    def displacement(self, x: Array) -> Array:
        """Displacements of the nodes [m], (nodes, dim)."""
        return x[: self.nodes.size].reshape(self.nodes.shape)

    def deformation_gradient(self, x: Array) -> Array:
        """Deformation gradient F at the quadrature points, (cells, q, 3, 3)."""
        return self._strain_state(x).F

    def volume_ratio(self, x: Array) -> Array:
        """Volume ratio J = det F at the quadrature points, (cells, q)."""
        return self._strain_state(x).J

    def admissible(self, x: Array) -> bool:
        """Whether J > 0 at all quadrature points."""
        return bool(np.all(self._strain_state(x).J > 0.0))  # also false for NaN

    def energy(self, x: Array) -> float:
        """Stored energy [J]; per unit of thickness in plane strain."""
        at = self._strain_state(x)
        W = self._compliance[:, None] * at.multiplier**2
        W += self._direct[:, None] * (at.J - 1.0) ** 2
        W *= 0.5
        for law, cells in self._groups():
            W[cells] += law.energy(at.F[cells])
        return float(np.sum(W * self.weights))

    def shape_energies(self, x: Array) -> Array:
        """Isochoric strain energy of each material [J], (laws,)."""
        F = self.deformation_gradient(x)
        stored = np.zeros(len(self.laws))
        for k, (law, cells) in enumerate(zip(self.laws, self.cells_of_law, strict=True)):
            stored[k] = np.sum(law.energy(F[cells]) * self.weights[cells])
        return stored

    def corner_mean_stress(self, x: Array, law: int) -> Array:
        """Mean stress of one material at the corners of cells [Pa], (corners,); NaN elsewhere.

        The small part of kappa that acts on the displacements directly is left out.
        """
        cells = self.cells_of_law[law]
        mean_stress = np.full(self.mesh.p.shape[1], np.nan)
        mean_stress[self.mesh.t.T[cells]] = self.cell_mean_stress(x)[cells]
        return mean_stress

    def cell_mean_stress(self, x: Array) -> Array:
        """Mean stress at the corners of each cell [Pa], (cells, corners).

        The small part of kappa that acts on the displacements directly is left out.
        """
        mean_stress: Array = self._pressure_scale * x[self._pressure_numbers]
        return mean_stress

    def stress(self, x: Array) -> Array:
        """First Piola-Kirchhoff stress at the quadrature points [Pa], (cells, q, 3, 3)."""
        return self._stress(self._strain_state(x))

    def forces(self, x: Array) -> Array:
        """Residual of the equilibrium, (n,): nodal forces [N], then scaled volume errors."""
        return self._assemble(self._strain_state(x))

    def linearise(self, x: Array) -> tuple[Array, csc_array]:
        """Residual (n,) and its symmetric derivative, the tangent stiffness (n, n), at x (n,)."""
        at = self._strain_state(x)
        mean_stress = self._mean_stress(at)
        elements = (
            (cells, self._stiffness(law, cells, at, mean_stress)) for law, cells in self._groups()
        )
        return self._assemble(at), self._pattern.assemble(elements, len(x))

    def elimination(self, fixed: Indices, size: int) -> Factorise:
        """Elimination of all but the fixed ones of `size` unknowns, of bodies by nested dissection.

        The function takes matrices (m, m) of the m free unknowns, numbered in rising order. Those
        that follow the unknowns of the solid may be coupled with any; they come last.
        """
        if self.dim < 3:
            return super().elimination(fixed, size)
        key = (size, fixed.tobytes())
        if self._eliminated is None or self._eliminated[0] != key:
            self._eliminated = key, IndefiniteSolver(self._blocks(fixed, size)).factorise
        return self._eliminated[1]

    def _blocks(self, fixed: Indices, size: int) -> list[Block]:
        """Blocks of the free unknowns in their order of elimination."""
        free = np.setdiff1d(np.arange(size), fixed)
        number = np.full(size, -1)
        number[free] = np.arange(len(free))
        numbers = number[np.hstack([self._displacement_numbers, self._pressure_numbers])]
        blocks = dissection(numbers, self.mesh.p[:, self.mesh.t].mean(axis=1).T)
        last = number[self.unknowns :]
        if (last >= 0).any():
            blocks.append(Block(last[last >= 0], (len(blocks) - 1,)))
        return blocks

    def _strain_state(self, x: Array) -> StrainState:
        """Strain state at x; the last one is kept, as Newton's method asks for each repeatedly."""
        if self._last is None or not np.array_equal(self._last.x, x):
            self._last = self._evaluate_strain(x)
        return self._last

    def _evaluate_strain(self, x: Array) -> StrainState:
        """Strain state at x, newly evaluated."""
        u = self.displacement(x)[self.basis.element_dofs.T].swapaxes(1, 2)
        slopes = self._slopes.reshape(*self._slopes.shape[:2], -1)
        moved = (u @ slopes).reshape(len(u), self.dim, -1, self.dim).swapaxes(1, 2)
        F = np.zeros((*self.weights.shape, 3, 3))
        F[..., range(3), range(3)] = 1.0
        F[..., : self.dim, : self.dim] += moved
        if self.kinematics == "axisymmetric":
            F[..., 2, 2] += (u[:, :1] @ self._hoops)[:, 0]
        H = cofactor(F)
        J = determinant(F, H)
        for array in (F, H, J):
            array.flags.writeable = False  # callers get these arrays, not copies
        p = self._pressure_scale * (x[self._pressure_numbers] @ self._pressure_values)
        return StrainState(x.copy(), F, H, J, p)

    def _mean_stress(self, state: StrainState) -> Array:
        p: Array = state.multiplier + self._direct[:, None] * (state.J - 1.0)
        return p

    def _stress(self, state: StrainState) -> Array:
        P: Array = self._mean_stress(state)[..., None, None] * state.H
        for law, cells in self._groups():
            P[cells] += law.stress(state.F[cells])
        return P

    def _shape(self, pressure: skfem.CellBasis) -> None:
        """Evaluate shape functions at the quadrature points; weights include the ring 2 pi r."""
        slopes = np.stack([np.asarray(f.grad) for (f,) in self.basis.basis])  # (a, J, c, q)
        self._slopes: Array = np.ascontiguousarray(slopes.transpose(2, 0, 3, 1))
        self.weights: Array = np.asarray(self.basis.dx).copy()
        if self.kinematics == "axisymmetric":
            r = np.asarray(self.basis.global_coordinates())[0]
            values = np.stack(
                [np.broadcast_to(np.asarray(f), r.shape) for (f,) in self.basis.basis]
            )
            self._hoops: Array = np.ascontiguousarray((values / r).swapaxes(0, 1))
            self.weights *= 2.0 * np.pi * r
        self._pressure_values: Array = np.stack([np.asarray(f)[0] for (f,) in pressure.basis])

    def _number(self, pressure: skfem.CellBasis, law_of_cell: Indices) -> None:
        dofs = self.basis.element_dofs.T.astype(np.int64)
        spread = self.dim * dofs[:, :, None] + np.arange(self.dim)
        self._displacement_numbers: Indices = spread.reshape(len(dofs), -1)
        # Pressures jump between materials: one number per node and material.
        pairs = pressure.element_dofs.T.astype(np.int64) * len(self.laws) + law_of_cell[:, None]
        unique_pairs, numbers = np.unique(pairs, return_inverse=True)
        self._pressure_numbers: Indices = self.nodes.size + numbers.reshape(pairs.shape)
        self.unknowns = self.nodes.size + len(unique_pairs)
        self.cells_of_law = [np.flatnonzero(law_of_cell == k) for k in range(len(self.laws))]

    @cached_property
    def _pattern(self) -> StiffnessPattern:
        """Pattern of the stiffness, found at its first assembly."""
        nodes = self.basis.element_dofs.T.astype(np.int64)
        return StiffnessPattern(nodes, self._pressure_numbers - self.nodes.size, self.dim)

    def _groups(self) -> Iterator[tuple[Law, Indices]]:
        """Chunks of cells of one law, small enough to be assembled at once."""
        functions, points = self._slopes.shape[1:3]
        each = max(1, _CHUNK // (points * functions * self.dim * 9))
        for law, cells in zip(self.laws, self.cells_of_law, strict=True):
            for start in range(0, len(cells), each):
                yield law, cells[start : start + each]

    def _strain_operators(self, cells: Indices) -> list[Array]:
        """Derivatives of the entries of F by nodal displacements in each direction.

        (cells, functions, q, entries), for the entries that the direction changes.
        """
        slopes = self._slopes[cells]
        operators = [slopes] * self.dim
        if self.kinematics == "axisymmetric":
            operators[0] = np.concatenate([slopes, self._hoops[cells][..., None]], axis=-1)
        return operators

    def _assemble(self, state: StrainState) -> Array:
        """Assembled nodal forces and volume errors, (n,)."""
        dilation = state.J - 1.0 - self._compliance[:, None] * state.multiplier
        return self._integrate(self._stress(state), dilation, len(state.x))

    def _integrate(self, stress: Array, dilation: Array, size: int) -> Array:
        """Nodal forces of stresses, and scaled integrals of dilations, (size,)."""
        P = stress * self.weights[..., None, None]
        within = P[..., : self.dim, : self.dim].swapaxes(2, 3).reshape(len(P), -1, self.dim)
        nodal = self._slopes.reshape(*self._slopes.shape[:2], -1) @ within
        if self.kinematics == "axisymmetric":
            nodal[..., :1] += self._hoops @ P[..., 2, 2:]
        volume = self._pressure_scale * (dilation * self.weights) @ self._pressure_values.T
        residual = np.bincount(
            np.concatenate([self._displacement_numbers.ravel(), self._pressure_numbers.ravel()]),
            weights=np.concatenate([nodal.ravel(), volume.ravel()]),
            minlength=size,
        )
        return np.asarray(residual, dtype=np.float64)

    def _stiffness(
        self, law: Law, cells: Indices, state: StrainState, mean_stress: Array
    ) -> ElementBlocks:
        """Element matrices, by blocks."""
        entries = [entry for component in _COMPONENTS[self.kinematics] for entry in component]
        w, F = self.weights[cells], state.F[cells]
        H = state.H[cells].reshape(*w.shape, 9)[..., entries]
        A = law.tangent(F, entries)
        slope = _COFACTOR_SLOPE[:, entries][:, :, entries]
        curvature = np.tensordot(F.reshape(*w.shape, 9), slope, axes=1)
        A += mean_stress[cells][..., None, None] * curvature
        A += self._direct[cells, None, None, None] * H[..., :, None] * H[..., None, :]
        A *= w[..., None, None]
        H *= w[..., None]
        operators = self._strain_operators(cells)
        ends = np.cumsum([len(component) for component in _COMPONENTS[self.kinematics]])
        spans = [slice(end - B.shape[-1], end) for end, B in zip(ends, operators, strict=True)]
        flat = [B.reshape(*B.shape[:2], -1) for B in operators]
        psi = self._pressure_scale * self._pressure_values
        K_uu, K_up = [], []
        for i, (rows, B) in enumerate(zip(spans, operators, strict=True)):
            for columns, other in zip(spans[i:], operators[i:], strict=True):
                stressed = A[..., rows, columns] @ other.transpose(0, 2, 3, 1)
                K_uu.append(flat[i] @ stressed.reshape(len(cells), -1, B.shape[1]))
            K_up.append(np.einsum("caqe,cqe->caq", B, H[..., rows]) @ psi.T)
        K_pp = -self._compliance[cells, None, None] * np.einsum("cq,aq,bq->cab", w, psi, psi)
        return K_uu, K_up, [K_pp]
