"""The discrete complete electrode model: matrices that are linear in the conductivity tensor.

The weak form (Somersalo, Cheney and Isaacson 1992), for potential u and electrode potentials U:

    int sigma grad u . grad v  +  sum_l 1/z_l int_{E_l} (u - U_l) (v - V_l)  =  sum_l I_l V_l

Written out with finite elements, A = stiffness + contact, and for the electrodes
A u = B U,  I = D U - B^T u.

Cells are affine images of one reference cell, so a cell's matrix is one fixed matrix times the
tensor pulled back to that reference cell: a new scene costs one dense product. Unknowns inside a
cell meet no other cell and are eliminated there (static condensation, Guyan 1965).
"""

from dataclasses import dataclass

import numpy as np
import skfem
from numpy.typing import NDArray

from eitskin.geometry import Mesh

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

_TENSOR_ROWS = np.array([0, 1, 2, 0, 0, 1])
_TENSOR_COLUMNS = np.array([0, 1, 2, 1, 2, 2])


@dataclass(frozen=True, slots=True)
class ExtrudedElement:
    """Shape functions on the unit cube: products of a plane one and an upright one.

    The layer is thin, so the order upwards is chosen apart from the order in the plane.
    """

    order: tuple[int, int]

    @property
    def plane(self) -> skfem.Element:
        """The element on the unit square."""
        order = self.order[0]
        known = {1: skfem.ElementQuad1, 2: skfem.ElementQuad2}
        return known[order]() if order in known else skfem.ElementQuadP(order)

    @property
    def upright(self) -> skfem.Element:
        """The element on the unit interval."""
        return {1: skfem.ElementLineP1, 2: skfem.ElementLineP2}[self.order[1]]()

    @property
    def inner(self) -> int:
        """How many functions, the last ones, vanish on all upright faces of the cube."""
        return (self.order[0] - 1) ** 2 * (self.order[1] + 1)

    def values(self, X: Array) -> Array:
        """phi_i, (functions, ...), at X (3, ...)."""
        flat, upright = self._parts(X)
        return np.stack([f[0] * u[0] for f in flat for u in upright])

    def gradients(self, X: Array) -> Array:
        """d phi_i / dX, (functions, 3, ...), at X (3, ...)."""
        flat, upright = self._parts(X)
        return np.stack(
            [
                np.stack([f[1][0] * u[0], f[1][1] * u[0], f[0] * u[1][0]])
                for f in flat
                for u in upright
            ]
        )

    def _parts(self, X: Array) -> tuple[list[tuple[Array, Array]], list[tuple[Array, Array]]]:
        plane, upright = self.plane, self.upright
        return (
            [plane.lbasis(X[:2], i) for i in range((self.order[0] + 1) ** 2)],
            [upright.lbasis(X[2:], i) for i in range(self.order[1] + 1)],
        )


@dataclass(frozen=True, slots=True, eq=False)
class Stiffness:
    """The stiffness of one scene, its inner unknowns eliminated.

    Attributes:
        values: one per entry of `Assembly.rows` before the contact entries.
        inner: what gives a cell's inner unknowns from its others, (cells, inner, outer).
    """

    values: Array
    inner: Array


@dataclass(frozen=True, slots=True, eq=False)
class Contact:
    """The electrode terms of one scene.

    Attributes:
        values: of 1/z phi_i phi_j, one per entry of `Assembly.rows` after the stiffness entries.
        coupling: B, int_{E_l} phi_i / z_l, (unknowns, electrodes) [S].
        admittance: diagonal of D, int_{E_l} 1 / z_l, (electrodes,) [S].
    """

    values: Array
    coupling: Array
    admittance: Array


class Assembly:
    """Maps conductivity tensors and contact impedances to matrix values on one mesh.

    Attributes:
        unknowns: number of potential unknowns, those inside cells left out.
        places: middle of the point, edge or cell that each belongs to, (unknowns, 3) [m].
        rows, columns: of each value in the lower triangle of A; values of equal place add up.
        points: quadrature points of the cells, (cells, q, 3) [m].
        facet_points, facet_normals: of the electrodes, (facets, q, 3) [m], [-].
        facet_electrode: the electrode that each facet belongs to, (facets,).
    """

    def __init__(self, mesh: Mesh, order: tuple[int, int]) -> None:
        """Prepare elements of polynomial `order` (in the plane, upwards)."""
        assert mesh.heights is not None
        layers = len(mesh.heights) - 1
        plane = skfem.MeshQuad(
            np.ascontiguousarray(mesh.points[:: layers + 1, :2].T),
            np.ascontiguousarray(mesh.cells[::layers, :4].T // (layers + 1)),
            sort_t=False,
        )
        column = skfem.MeshLine(mesh.heights)
        self.element = ExtrudedElement(order)
        flat = skfem.CellBasis(plane, self.element.plane, intorder=1)
        upright = skfem.CellBasis(column, self.element.upright, intorder=1)
        # Unknowns inside plane cells come last, in the whole and in each cell.
        outer = flat.N - flat.dofs.interior_dofs.size
        self.unknowns: int = outer * upright.N
        places = [np.repeat(_places(flat), upright.N, axis=1), np.tile(_places(upright), flat.N)]
        self.places: Array = np.concatenate(places).T[: self.unknowns]
        unknowns = (
            flat.element_dofs.T[:, None, :, None] * upright.N
            + upright.element_dofs.T[None, :, None, :]
        ).reshape(len(mesh.cells), -1)
        self.cell_unknowns: Indices = unknowns[:, : unknowns.shape[1] - self.element.inner]
        self._pairs = np.tril_indices(self.cell_unknowns.shape[1])
        self._prepare_cells(mesh)
        self._prepare_electrodes(mesh)
        self.rows: Indices = np.concatenate([self._cell_rows, self._facet_rows])
        self.columns: Indices = np.concatenate([self._cell_columns, self._facet_columns])

    def _prepare_cells(self, mesh: Mesh) -> None:
        X, weights = _box_rule(*self.element.order)
        gradients = self.element.gradients(X)
        a, b = _TENSOR_ROWS, _TENSOR_COLUMNS
        # int S_ab d_a phi_i d_b phi_j, the six entries of a symmetric S at each point.
        products = np.einsum("iaq,jbq->ijabq", gradients, gradients, optimize=True)
        symmetric = products + products.swapaxes(2, 3)
        weighted = symmetric[:, :, a, b] * np.where(a == b, 0.5, 1.0)[:, None] * weights
        i, j = self._pairs
        outer = self.cell_unknowns.shape[1]
        blocks = (weighted[i, j], weighted[outer:, :outer], weighted[outer:, outer:])
        # (q, 6, entries): of each cell the lower triangle of the outer block, then the others.
        self._reference = np.ascontiguousarray(
            np.concatenate([block.reshape(-1, *block.shape[-2:]) for block in blocks]).T
        )
        corners = mesh.points[mesh.cells]
        edges = corners[:, [1, 3, 4]] - corners[:, :1]
        self.origins: Array = corners[:, 0]
        inverses = np.linalg.inv(edges.swapaxes(1, 2))
        self.inverses = np.asarray(inverses, dtype=np.float64)
        self.volumes: Array = np.abs(np.linalg.det(edges))
        self.points: Array = self.origins[:, None] + X.T @ edges
        self._to_reference = _tensor_map(self.inverses) * self.volumes[:, None, None]
        self._cell_rows, self._cell_columns = self._lower(self.cell_unknowns)

    def _prepare_electrodes(self, mesh: Mesh) -> None:
        contacts = mesh.contacts
        owners, corners = contacts.cell, contacts.corners
        self.electrodes = len(contacts.facets)
        self.facet_electrode: Indices = contacts.electrode
        across, along = corners[:, 1] - corners[:, 0], corners[:, 3] - corners[:, 0]
        nodes, weights = skfem.quadrature.get_quadrature(
            skfem.refdom.RefQuad, 2 * max(self.element.order)
        )
        self.facet_points: Array = (
            corners[:, :1]
            + nodes[0][:, None] * across[:, None]
            + nodes[1][:, None] * along[:, None]
        )
        normals = np.cross(across, along)
        areas = np.asarray(np.linalg.norm(normals, axis=1), dtype=np.float64)
        self.facet_normals: Array = np.broadcast_to(
            (normals / areas[:, None])[:, None], self.facet_points.shape
        )
        X = np.einsum(
            "fab,fqb->afq", self.inverses[owners], self.facet_points - self.origins[owners][:, None]
        )
        shape = self.element.values(X)[: self.cell_unknowns.shape[1]]
        i, j = self._pairs
        self._facet_unknowns: Indices = self.cell_unknowns[owners]
        self._facet_areas = areas[:, None] * weights
        self._facet_shape = np.einsum("ifq,fq->fiq", shape, self._facet_areas)
        self._facet_products = np.einsum("pfq,pfq,fq->fpq", shape[i], shape[j], self._facet_areas)
        self._facet_rows, self._facet_columns = self._lower(self._facet_unknowns)

    def _lower(self, unknowns: Indices) -> tuple[Indices, Indices]:
        """Row >= column of every pair of a cell's unknowns, flattened."""
        i, j = self._pairs
        first, second = unknowns[:, i].ravel(), unknowns[:, j].ravel()
        return np.maximum(first, second), np.minimum(first, second)

    def stiffness(self, conductivity: Array) -> Stiffness:
        """Stiffness for tensors (cells, 3, 3) or, per point, (cells, q, 3, 3) [S/m]."""
        tensors = conductivity if conductivity.ndim == 4 else conductivity[:, None]
        entries = tensors[..., _TENSOR_ROWS, _TENSOR_COLUMNS] @ self._to_reference
        matrix = self._reference if tensors.shape[1] > 1 else self._reference.sum(axis=0)
        flat = entries.reshape(len(entries), -1) @ matrix.reshape(-1, matrix.shape[-1])
        (i, j), inner, outer = self._pairs, self.element.inner, self.cell_unknowns.shape[1]
        own, joining, within = np.split(flat, [len(i), len(i) + inner * outer], axis=1)
        if not inner:
            return Stiffness(own.ravel(), np.zeros((len(flat), 0, outer)))
        joining = joining.reshape(-1, inner, outer)
        solved = -np.linalg.solve(within.reshape(-1, inner, inner), joining)
        own = own + (joining.swapaxes(1, 2) @ solved)[:, i, j]
        return Stiffness(own.ravel(), solved)

    def in_cells(self, potentials: Array, stiffness: Stiffness) -> Array:
        """Potentials (unknowns, k) cell by cell, inner ones filled in, (cells, functions, k)."""
        outer = potentials[self.cell_unknowns]
        return np.concatenate([outer, stiffness.inner @ outer], axis=1)

    def contact(self, impedance: Array, area_ratio: Array | float = 1.0) -> Contact:
        """Electrode terms for z per electrode [ohm m2] and the deformed over the flat area.

        z_ref = z / area_ratio: the current through a contact grows with its area.
        """
        conductance = np.broadcast_to(
            area_ratio / impedance[self.facet_electrode][:, None], self._facet_areas.shape
        )
        L = self.electrodes
        loads = np.einsum("fiq,fq->fi", self._facet_shape, conductance)
        cells = self._facet_unknowns * L + self.facet_electrode[:, None]
        coupling = _sums(cells, loads, self.unknowns * L)
        totals = (self._facet_areas * conductance).sum(axis=1)
        return Contact(
            values=np.einsum("fpq,fq->fp", self._facet_products, conductance).ravel(),
            coupling=coupling.reshape(self.unknowns, L),
            admittance=_sums(self.facet_electrode, totals, L),
        )

    def cell_gram(self, potentials: Array) -> Array:
        """int_cell grad u_k . grad u_l, (cells, k, k), of potentials (cells, functions, k)."""
        X, weights = _box_rule(*self.element.order)
        shape = np.einsum("iaq,cab->cqib", self.element.gradients(X), self.inverses, optimize=True)
        gradients = np.einsum("cqib,cik->cqbk", shape, potentials, optimize=True)
        gram: Array = np.einsum(
            "q,c,cqbk,cqbl->ckl", weights, self.volumes, gradients, gradients, optimize=True
        )
        return gram

    def gradients(self, potentials: Array, cells: Indices, points: Array) -> Array:
        """grad u_k, (n, 3, k), at `points` (n, 3) [m] that lie in `cells` (n,).

        Potentials are given cell by cell, (cells, functions, k).
        """
        X = np.einsum("nab,nb->an", self.inverses[cells], points - self.origins[cells])
        shape = np.einsum("ian,nab->nib", self.element.gradients(X), self.inverses[cells])
        gradients: Array = np.einsum("nib,nik->nbk", shape, potentials[cells], optimize=True)
        return gradients


def _sums(places: Indices, values: Array, size: int) -> Array:
    """Add up the values that belong to each place, (size,)."""
    return np.asarray(np.bincount(places.ravel(), values.ravel(), size), dtype=np.float64)


def _tensor_map(A: Array) -> Array:
    """Six entries of symmetric S to those of A S A^T, (cells, from, to), for A (cells, 3, 3)."""
    a, b = _TENSOR_ROWS, _TENSOR_COLUMNS
    first = A[:, a][:, :, a] * A[:, b][:, :, b]
    second = A[:, a][:, :, b] * A[:, b][:, :, a]
    to_from = first + np.where(a == b, 0.0, second)
    return to_from.swapaxes(1, 2)


def _box_rule(plane_order: int, upright_order: int) -> tuple[Array, Array]:
    """Gauss points (3, q) and weights (q,) on the unit cube, exact for products of elements."""
    rule = skfem.quadrature.get_quadrature
    plane, plane_weights = rule(skfem.refdom.RefQuad, 2 * plane_order)
    line, line_weights = rule(skfem.refdom.RefLine, 2 * upright_order)
    points = [np.repeat(plane, line.shape[1], axis=1), np.tile(line, plane.shape[1])]
    return np.concatenate(points), np.outer(plane_weights, line_weights).ravel()


def _places(basis: skfem.CellBasis) -> Array:
    """The middle of the point, edge or cell that each unknown belongs to, (dim, unknowns) [m]."""
    grid, dofs = basis.mesh, basis.dofs
    places = np.empty((grid.dim(), basis.N))
    entities = [(dofs.nodal_dofs, grid.p), (dofs.interior_dofs, grid.p[:, grid.t].mean(axis=1))]
    if grid.dim() == 2:
        entities.append((dofs.facet_dofs, grid.p[:, grid.facets].mean(axis=1)))
    for numbers, middles in entities:
        for row in numbers:
            places[:, row] = middles
    return places
