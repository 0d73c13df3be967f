"""The discrete complete electrode model: matrices that are linear in the conductivity tensor.

The weak form (Somersalo, Cheney and Isaacson 1992), for potential u and electrode potentials U:

    int sigma grad u . grad v  +  sum_l 1/z_l int_{E_l} (u - U_l) (v - V_l)  =  sum_l I_l V_l

Written out with finite elements, A = stiffness + contact, and for the electrodes
A u = B U,  I = D U - B^T u.

Elements are affine images of one reference element, so an element's matrix is one fixed matrix
times the tensor pulled back to that reference: a new scene costs one dense product. Unknowns
inside an element meet no other element and are eliminated there (static condensation, Guyan 1965).
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import skfem
from numpy.typing import NDArray

from eitskin.geometry.design.patches import Contacts
from eitskin.geometry.meshing.mesh import Mesh
from eitskin.simulator.electrical.function_space import FunctionSpace, Rule

Array = NDArray[np.float64]
Numbers = NDArray[np.inexact]
Indices = NDArray[np.int64]

TENSOR_ROWS = np.array([0, 1, 2, 0, 0, 1])
TENSOR_COLUMNS = np.array([0, 1, 2, 1, 2, 2])


@dataclass(frozen=True, slots=True, eq=False)
class Stiffness:
    """The stiffness of one scene, its inner unknowns eliminated.

    Attributes:
        values: one per entry of `Assembly.rows` before the contact entries.
        inner: what gives an element's inner unknowns from its others, (elements, inner, outer).
    """

    values: Array
    inner: Array


@dataclass(frozen=True, slots=True, eq=False)
class Contact:
    """The electrode terms of one scene, complex where a contact impedance is.

    Attributes:
        values: of 1/z phi_i phi_j, one per entry of `Assembly.rows` after the stiffness entries.
        coupling: B, int_{E_l} phi_i / z_l, (unknowns, electrodes) [S].
        admittance: diagonal of D, int_{E_l} 1 / z_l, (electrodes,) [S].
    """

    values: Numbers
    coupling: Numbers
    admittance: Numbers


class Assembly:
    """Maps conductivity tensors and contact impedances to matrix values on one mesh.

    Attributes:
        space: the finite element functions.
        unknowns: number of potential unknowns, those inside elements left out.
        rows, columns: of each value in the lower triangle of A; values of equal place add up.
        contact_entries: how many of them, the last ones, are the electrodes'.
        contacts: where the electrodes touch.
        points: quadrature points of the cells, (cells, q, 3) [m].
        facet_points, facet_normals: of the electrodes' pieces, (pieces, q, 3) [m], (pieces, 1, 3).
        facet_coarse_points: few points of theirs, (pieces, s, 3) [m].
        facet_interpolation: from values there to those at `facet_points`, (q, s).
        facet_electrode: the electrode that each piece belongs to, (pieces,).
        facet_owners: the element that each piece bounds, (pieces,).
        facet_numbers: unknowns of that element, (pieces, functions).
        facet_shape: values of their functions, (pieces, functions, q).
        facet_weights: area that each point stands for, (pieces, q) [m2].
    """

    def __init__(self, mesh: Mesh, order: tuple[int, ...]) -> None:
        """Prepare elements of polynomial `order` (see ExtrudedElement; one number for tets)."""
        self.space = FunctionSpace(mesh, order)
        self.unknowns = self.space.unknowns
        self.points = self.space.rule.points
        self._pairs = np.tril_indices(self.space.numbers.shape[1])
        self._prepare_elements()
        self._prepare_electrodes(mesh.contacts)
        self.contact_entries = len(self._facet_rows)
        self.rows: Indices = np.concatenate([self._element_rows, self._facet_rows])
        self.columns: Indices = np.concatenate([self._element_columns, self._facet_columns])

    def _prepare_elements(self) -> None:
        space = self.space
        self._reference = self._products(space.rule)
        self._coarse_reference = np.concatenate(
            [
                np.tensordot(values, self._reference[within], axes=(0, 0))
                for values, within in self._interpolation()
            ]
        )
        by_cell = self._reference.reshape(space.element.cells, -1, *self._reference.shape[1:])
        self._cell_reference = by_cell.sum(axis=1)
        self._to_reference = _tensor_map(space.inverses) * space.jacobians[:, None, None]
        self._element_rows, self._element_columns = self._lower(space.numbers)

    def _interpolation(self) -> Iterator[tuple[Array, slice]]:
        """From values at a cell's coarse points to those at its quadrature points, (q, s)."""
        rule, coarse, element = self.space.rule, self.space.coarse, self.space.element
        q, few = (len(each.weights) // element.cells for each in (rule, coarse))
        for cell in range(element.cells):
            within = slice(cell * q, (cell + 1) * q)
            given = element.linear(coarse.X[:, cell * few : (cell + 1) * few])
            values = np.linalg.solve(given, element.linear(rule.X[:, within])).T
            yield np.asarray(values, dtype=np.float64), within

    def _products(self, rule: Rule) -> Array:
        """int S_ab d_a phi_i d_b phi_j for the six entries of a symmetric S, (q, 6, entries).

        Entries are the lower triangle of the outer functions, then the rows of the inner ones.
        """
        gradients = self.space.element.gradients(rule.X)
        a, b = TENSOR_ROWS, TENSOR_COLUMNS
        i, j = self._pairs
        outer, count = self.space.numbers.shape[1], len(gradients)
        inner = np.arange(outer, count)
        rows = np.concatenate([i, np.repeat(inner, outer), np.repeat(inner, len(inner))])
        columns = np.concatenate([j, np.tile(np.arange(outer), len(inner))])
        columns = np.concatenate([columns, np.tile(inner, len(inner))])
        one, other = gradients[rows], gradients[columns]
        products = one[:, a] * other[:, b] + np.where(a == b, 0.0, 1.0)[:, None] * (
            one[:, b] * other[:, a]
        )
        return np.ascontiguousarray((products * rule.weights).T)

    def _prepare_electrodes(self, contacts: Contacts) -> None:
        space = self.space
        self.contacts = contacts
        self.electrodes = len(contacts.facets)
        self.facet_electrode: Indices = contacts.electrode
        owners = contacts.cell // space.element.cells
        self.facet_owners: Indices = owners
        corners = contacts.corners
        across, along = corners[:, 1] - corners[:, 0], corners[:, -1] - corners[:, 0]
        shape = skfem.refdom.RefTri if corners.shape[1] == 3 else skfem.refdom.RefQuad
        nodes, weights = skfem.quadrature.get_quadrature(shape, 2 * space.element.face_degree)
        few, _ = skfem.quadrature.get_quadrature(shape, 2)
        self.facet_points, self.facet_coarse_points = (
            corners[:, :1] + at[0][:, None] * across[:, None] + at[1][:, None] * along[:, None]
            for at in (nodes, few)
        )
        linear = _linear(nodes)[: few.shape[1]]
        self.facet_interpolation: Array = np.asarray(
            np.linalg.solve(_linear(few), linear).T, dtype=np.float64
        )
        normals = np.cross(across, along)
        lengths = np.asarray(np.linalg.norm(normals, axis=1), dtype=np.float64)
        self.facet_normals: Array = (normals / lengths[:, None])[:, None]
        values = space.element.values(space.reference(owners, self.facet_points))
        values = values[: space.numbers.shape[1]].swapaxes(0, 1)
        i, j = self._pairs
        self.facet_shape: Array = values
        self.facet_numbers: Indices = space.numbers[owners]
        self.facet_weights: Array = contacts.areas[:, None] * (weights / weights.sum())
        self._facet_products = values[:, i] * values[:, j]
        self._facet_rows, self._facet_columns = self._lower(self.facet_numbers)

    def _lower(self, unknowns: Indices) -> tuple[Indices, Indices]:
        """Row >= column of every pair of an element's unknowns, flattened."""
        i, j = self._pairs
        first, second = unknowns[:, i].ravel(), unknowns[:, j].ravel()
        return np.maximum(first, second), np.minimum(first, second)

    def stiffness(self, conductivity: Array) -> Stiffness:
        """Stiffness for conductivities (cells, q or 1, 1 or 6) [S/m], as in `matrices`."""
        return self.condensed(self.matrices(conductivity))

    def matrices(
        self, conductivity: Array, elements: Indices | None = None, coarse: bool = False
    ) -> Array:
        """Entries of the elements' matrices, (elements, entries), for those that are given or all.

        Args:
            conductivity: of their cells, (cells, q or 1, 1 or 6) [S/m]. One value per cell or per
                quadrature point; a scalar, or the entries xx, yy, zz, xy, xz, yz of a tensor.
            elements: their numbers.
            coarse: the points are those of the coarse rule, between which it is linear.
        """
        reference = self._reference if conductivity.shape[1] > 1 else self._cell_reference
        if coarse:
            reference = self._coarse_reference
        to_reference = self._to_reference if elements is None else self._to_reference[elements]
        count = len(to_reference)
        if conductivity.shape[2] == 1:
            unit = to_reference[:, :3].sum(axis=1)  # what the unit tensor becomes
            if not unit[:, 3:].any():  # on boxes it stays diagonal
                unit, reference = unit[:, :3], reference[:, :3]
            entries = conductivity.reshape(count, -1, 1) * unit[:, None]
        else:
            entries = conductivity.reshape(count, -1, 6) @ to_reference
        found: Array = entries.reshape(count, -1) @ reference.reshape(-1, reference.shape[-1])
        return found

    def condensed(self, matrices: Array) -> Stiffness:
        """Matrices (elements, entries) with the inner unknowns eliminated."""
        (i, j), inner, outer = self._pairs, self.space.element.inner, self.space.numbers.shape[1]
        own, joining, within = np.split(matrices, [len(i), len(i) + inner * outer], axis=1)
        if not inner:
            return Stiffness(own.ravel(), np.zeros((len(matrices), 0, outer)))
        joining = joining.reshape(-1, inner, outer)
        solved: Array = np.asarray(
            -np.linalg.solve(within.reshape(-1, inner, inner), joining), dtype=np.float64
        )
        own = own + (joining.swapaxes(1, 2) @ solved)[:, i, j]
        return Stiffness(own.ravel(), solved)

    def contact(self, impedance: Numbers, area_ratio: Array | float = 1.0) -> Contact:
        """Electrode terms for z per electrode [ohm m2] and the deformed over the flat area.

        z_ref = z / area_ratio: the current through a contact grows with its area.
        """
        conductance = self.facet_weights * area_ratio / impedance[self.facet_electrode][:, None]
        L = self.electrodes
        loads = np.matmul(self.facet_shape, conductance[:, :, None])[..., 0]
        places = self.facet_numbers * L + self.facet_electrode[:, None]
        return Contact(
            values=np.matmul(self._facet_products, conductance[:, :, None]).ravel(),
            coupling=sums(places, loads, self.unknowns * L).reshape(self.unknowns, L),
            admittance=sums(self.facet_electrode, conductance.sum(axis=1), L),
        )

    def cell_gram(self, potentials: Numbers) -> Numbers:
        """int_cell grad u_k . grad u_l, (cells, k, k), of potentials (elements, functions, k)."""
        gradients = self.cell_gradients(potentials)
        weights = self.cell_weights
        gram: Numbers = np.einsum("cq,cqbk,cqbl->ckl", weights, gradients, gradients, optimize=True)
        return gram

    @property
    def cell_weights(self) -> Array:
        """Volume that each quadrature point stands for, (cells, q) [m3]."""
        return self._weights(self.space.rule)

    def _weights(self, rule: Rule) -> Array:
        weights: Array = self.space.jacobians[:, None] * rule.weights
        return weights.reshape(rule.points.shape[:2])

    def cell_gradients(self, potentials: Numbers) -> Numbers:
        """grad u_k at the quadrature points, (cells, q, 3, k), of (elements, functions, k)."""
        return self._gradients(potentials, self.space.rule)

    def energies(self, potentials: Array) -> Array:
        """What potentials u_k make of a tensor at the coarse rule's points, (cells, s, 6, k, k).

        Times the entries of a symmetric tensor S, summed over points: int grad u_k . S grad u_l.
        """
        g = np.moveaxis(self._gradients(potentials, self.space.coarse), 2, 0)
        one, other = g[TENSOR_ROWS], g[TENSOR_COLUMNS]
        products = one[..., :, None] * other[..., None, :]
        products[3:] += other[3:, ..., :, None] * one[3:, ..., None, :]
        products *= self._weights(self.space.coarse)[..., None, None]
        return np.moveaxis(products, 0, 2)

    def _gradients(self, potentials: Numbers, rule: Rule) -> Numbers:
        reference = self.space.element.gradients(rule.X)
        gradients = np.einsum("iaq,eik->eqak", reference, potentials, optimize=True)
        gradients = np.einsum("eqak,eab->eqbk", gradients, self.space.inverses, optimize=True)
        shaped: Numbers = gradients.reshape(*rule.points.shape, potentials.shape[-1])
        return shaped


def sums(places: Indices, values: Numbers, size: int) -> Numbers:
    """Add up the values that belong to each place, (size,)."""
    where, what = places.ravel(), values.ravel()
    if np.iscomplexobj(what):
        return sums(where, what.real, size) + 1j * sums(where, what.imag, size)
    return np.asarray(np.bincount(where, what, size), dtype=np.float64)


def _tensor_map(A: Array) -> Array:
    """Six entries of symmetric S to those of A S A^T, (cells, from, to), for A (cells, 3, 3)."""
    a, b = TENSOR_ROWS, TENSOR_COLUMNS
    first = A[:, a][:, :, a] * A[:, b][:, :, b]
    second = A[:, a][:, :, b] * A[:, b][:, :, a]
    to_from = first + np.where(a == b, 0.0, second)
    return to_from.swapaxes(1, 2)


def _linear(X: Array) -> Array:
    """Functions that are linear along each axis at reference points X (2, s): as many, (s, s)."""
    x, y = X
    functions = [np.ones_like(x), x, y, x * y]
    return np.stack(functions[: 3 if X.shape[1] == 3 else 4])
