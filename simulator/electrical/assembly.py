"""Complete electrode model: assembly of matrices that are linear in the conductivity tensor.

The weak form (Somersalo, Cheney and Isaacson 1992), for potential u and electrode potentials U:

    int sigma grad u . grad v  +  sum_l 1/z_l int_{E_l} (u - U_l) (v - V_l)  =  sum_l I_l V_l

Discretised by finite elements, A = stiffness + electrode terms, and
A u = B U,  I = D U - B^T u.

Elements are affine images of one reference element, so an element matrix is one fixed matrix times
the tensor pulled back to the reference element: a new scene costs one dense product. On squares
there are as many quadrature points along each side as the degree p, which see no energy of the
function L_p(x) L_p(y) of Legendre polynomials. A small share of the energy that these points miss
is added, for the mean tensor of each cell (hourglass control, Flanagan and Belytschko 1981).

Unknowns inside an element are coupled to no other element and are eliminated in the element (static
condensation, Guyan 1965).
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import skfem
from numpy.typing import NDArray

from eitskin.compiled import compiled_kernels
from eitskin.geometry.deformation.kinematics import TENSOR_COLUMNS, TENSOR_ROWS
from eitskin.geometry.design.patches import Contacts
from eitskin.geometry.meshing.mesh import Mesh
from eitskin.simulator.electrical.function_space import FunctionSpace, Rule, require_memory

Array = NDArray[np.float64]
Numbers = NDArray[np.inexact]
Indices = NDArray[np.int64]

_AT_ONCE = 32  # elements that are condensed at once, so that arrays stay in the cache
_ZERO = 1e-12  # values of functions on a face that are rounding
# share of the energy between the points; potentials have an error least with 0.01 to 0.1
_MISSED_ENERGY_SHARE = 0.1


@dataclass(frozen=True, slots=True, eq=False)
class Stiffness:
    """Stiffness matrix of one scene after static condensation.

    Attributes:
        values: one per entry of `Assembly.rows` before those of the electrodes.
        inner: matrices from an element's outer to its inner unknowns, (elements, inner, outer).
    """

    values: Numbers
    inner: Numbers


@dataclass(frozen=True, slots=True, eq=False)
class ElectrodeTerms:
    """Electrode terms of one scene, complex where a contact impedance is complex.

    Attributes:
        matrices: int 1/z phi_i phi_j of each piece, (pieces, functions, functions) [S].
        coupling: B, int_{E_l} phi_i / z_l, (unknowns, electrodes) [S].
        admittance: diagonal of D, int_{E_l} 1 / z_l, (electrodes,) [S].
    """

    matrices: Numbers
    coupling: Numbers
    admittance: Numbers

    @property
    def values(self) -> Numbers:
        """One per entry of `Assembly.rows` after those of the stiffness."""
        i, j = np.tril_indices(self.matrices.shape[1])
        lower: Numbers = self.matrices[:, i, j].ravel()
        return lower


class Assembly:
    """Matrix values on one mesh, from conductivity tensors and contact impedances.

    A piece is the part of a cell face that an electrode covers.

    Attributes:
        space: the finite element functions.
        unknowns: number of potential unknowns after static condensation.
        rows, columns: position of each value in the lower triangle of A; equal ones add up.
        contact_entries: number of values of electrode terms, which come last.
        constant: coefficients of the constant function one, (functions,).
        contacts: contact surfaces of the electrodes.
        points: quadrature points of the cells, (cells, q, 3) [m].
        facet_points, facet_normals: points (pieces, q, 3) [m] and normals (pieces, 1, 3).
        facet_electrode: electrode of each piece, (pieces,).
        facet_functions: functions of an element that are not zero on each piece of its boundary,
            and others up to the same number, (pieces, functions).
        facet_numbers: unknowns of these functions, (pieces, functions).
        facet_shape: values of the functions, (pieces, functions, q).
        facet_weights: quadrature weights, (pieces, q) [m2].
    """

    def __init__(self, mesh: Mesh, order: tuple[int, ...]) -> None:
        """Prepare elements of polynomial `order`: one number for tetrahedra.

        Raises ConfigurationError where the matrices need too much memory.
        """
        self.space = FunctionSpace(mesh, order)
        require_memory(self.space)
        self.unknowns = self.space.unknowns
        self.points = self.space.rule.points
        outer = self.space.numbers.shape[1]
        self.constant: Array = self.space.element.indicator(-np.inf, np.inf)[:outer]
        self._pairs = np.tril_indices(outer)
        self._whole = np.zeros((outer, outer), dtype=np.int64)  # entry of each pair in a triangle
        self._whole[self._pairs] = self._whole.T[self._pairs] = np.arange(len(self._pairs[0]))
        self._prepare_elements()
        self._prepare_electrodes(mesh.contacts)
        self.contact_entries = len(self._facet_rows)
        self.rows: Indices = np.concatenate([self._element_rows, self._facet_rows])
        self.columns: Indices = np.concatenate([self._element_columns, self._facet_columns])

    def _prepare_elements(self) -> None:
        space = self.space
        gradients = self._cell_gradients(space.rule)
        full_gradients = self._cell_gradients(space.full_rule)
        weights, full_weights = (
            rule.weights.reshape(space.element.cells, -1) for rule in (space.rule, space.full_rule)
        )
        # Most upright functions are zero in most cells, and so are most products.
        self._reference: list[Array] = []
        self._entries: list[slice | Indices] = []
        for cell, slopes in enumerate(gradients):
            alive = np.flatnonzero(slopes.any(axis=(1, 2)) | full_gradients[cell].any(axis=(1, 2)))
            rows, columns, entries = self._entries_among(alive)
            products = _products(weights[cell], slopes, rows, columns)
            missed = _products(full_weights[cell], full_gradients[cell], rows, columns).sum(axis=0)
            missed -= products.sum(axis=0)
            shares = _MISSED_ENERGY_SHARE * weights[cell] / weights[cell].sum()
            products += shares[:, None, None] * missed
            self._reference.append(products)
            self._entries.append(slice(None) if len(alive) == len(slopes) else entries)
        self._cell_reference = [each.sum(axis=0, keepdims=True) for each in self._reference]
        self._to_reference: Array = tensor_map(space.inverses) * space.jacobians[:, None, None]
        self._element_rows, self._element_columns = self._lower(space.numbers)

    def _cell_gradients(self, rule: Rule) -> Array:
        """Gradients of all functions at the points of each cell, (cells, functions, 3, q)."""
        gradients = self.space.element.gradients(rule.X)
        by_cell = gradients.reshape(*gradients.shape[:2], self.space.element.cells, -1)
        return np.ascontiguousarray(np.moveaxis(by_cell, 2, 0))

    def _entries_among(self, functions: Indices) -> tuple[Indices, Indices, Indices]:
        """Rows, columns and numbers of the entries of element matrices among some functions.

        Entries are the lower triangle of the outer functions, then the rows of the inner ones.
        """
        outer = self.space.numbers.shape[1]
        inner = self.space.element.inner
        own, hidden = functions[functions < outer], functions[functions >= outer]
        i, j = np.tril_indices(len(own))
        triangle = len(self._pairs[0])
        rows = [own[i], np.repeat(hidden, len(own)), np.repeat(hidden, len(hidden))]
        columns = [own[j], np.tile(own, len(hidden)), np.tile(hidden, len(hidden))]
        numbers = [
            self._whole[rows[0], columns[0]],
            triangle + (rows[1] - outer) * outer + columns[1],
            triangle + inner * outer + (rows[2] - outer) * inner + columns[2] - outer,
        ]
        return np.concatenate(rows), np.concatenate(columns), np.concatenate(numbers)

    def _prepare_electrodes(self, contacts: Contacts) -> None:
        space = self.space
        self.contacts = contacts
        self.electrodes = len(contacts.facets)
        self.facet_electrode: Indices = contacts.electrode
        owners = contacts.cell // space.element.cells
        corners = contacts.corners
        across, along = corners[:, 1] - corners[:, 0], corners[:, -1] - corners[:, 0]
        shape = skfem.refdom.RefTri if corners.shape[1] == 3 else skfem.refdom.RefQuad
        nodes, weights = skfem.quadrature.get_quadrature(shape, 2 * space.element.face_degree)
        upwards = np.lexsort(nodes[::-1])  # columns of points, on which fields are faster
        (u, v), weights = nodes[:, upwards], weights[upwards]
        self.facet_points = (
            corners[:, :1] + u[:, None] * across[:, None] + v[:, None] * along[:, None]
        )
        normals = np.cross(across, along)
        lengths = np.asarray(np.linalg.norm(normals, axis=1), dtype=np.float64)
        self.facet_normals: Array = (normals / lengths[:, None])[:, None]
        values = space.element.values(space.reference(owners, self.facet_points))
        values = values[: space.numbers.shape[1]].swapaxes(0, 1)
        is_zero = np.abs(values).max(axis=2) < _ZERO
        count = int((~is_zero).sum(axis=1).max())
        self.facet_functions: Indices = np.argsort(is_zero, axis=1, kind="stable")[:, :count]
        self.facet_shape: Array = np.take_along_axis(values, self.facet_functions[..., None], 1)
        self.facet_numbers: Indices = space.numbers[owners[:, None], self.facet_functions]
        self.facet_weights: Array = contacts.areas[:, None] * (weights / weights.sum())
        self._facet_rows, self._facet_columns = self._lower(self.facet_numbers)

    @cached_property
    def every_point(self) -> Array:
        """Points of the cells, then those of the electrodes, (n, 3) [m]."""
        return np.concatenate([self.points.reshape(-1, 3), self.facet_points.reshape(-1, 3)])

    def _lower(self, unknowns: Indices) -> tuple[Indices, Indices]:
        """Rows and columns, row >= column, for every pair of an element's unknowns, flattened."""
        i, j = np.tril_indices(unknowns.shape[1])
        first, second = unknowns[:, i].ravel(), unknowns[:, j].ravel()
        return np.maximum(first, second), np.minimum(first, second)

    def matrices(self, conductivity: Numbers) -> Numbers:
        """Entries of element matrices, (elements, entries) [S].

        Args:
            conductivity: conductivity of the elements' cells, (cells, q or 1, 1 or 6) [S/m]. One
                value per cell or per quadrature point; a scalar, or the entries xx, yy, zz, xy, xz,
                yz of a tensor.
        """
        reference: Sequence[Numbers] = (
            self._reference if conductivity.shape[1] > 1 else self._cell_reference
        )
        to_reference: Numbers = self._to_reference
        count = len(to_reference)
        if conductivity.dtype == np.float32:
            reference, to_reference = self._single
        if conductivity.shape[2] == 1:
            unit = to_reference[:, :3].sum(axis=1)  # the unit tensor, pulled back
            if not unit[:, 3:].any():  # diagonal, as on boxes
                unit, reference = unit[:, :3], [each[:, :3] for each in reference]
            tensors = conductivity.reshape(count, -1, 1) * unit[:, None]
        else:
            tensors = conductivity.reshape(count, -1, 6) @ to_reference
        parts: list[Numbers] = [
            part.reshape(count, -1) @ each.reshape(-1, each.shape[-1])
            for part, each in zip(np.split(tensors, len(reference), axis=1), reference, strict=True)
        ]
        if len(parts) == 1:
            return parts[0]
        inner, outer = self.space.element.inner, self.space.numbers.shape[1]
        shape = count, len(self._pairs[0]) + inner * (outer + inner)
        matrices: NDArray[Any] = np.zeros(shape, dtype=parts[0].dtype)
        for entries, part in zip(self._entries, parts, strict=True):
            matrices[:, entries] += part
        return matrices

    @cached_property
    def _single(self) -> tuple[list[NDArray[np.float32]], NDArray[np.float32]]:
        """Reference matrices, and maps to the reference element, in single precision."""
        single = [each.astype(np.float32) for each in self._reference]
        return single, self._to_reference.astype(np.float32)

    def condense_into(self, matrices: Numbers, out: Numbers) -> None:
        """Static condensation of element matrices (elements, entries).

        Sets `out` to the symmetric matrices of the outer functions, (elements, outer, outer).
        """
        outer = self.space.numbers.shape[1]
        kernels = compiled_kernels("eitskin.simulator.electrical.kernels")
        if kernels is not None and matrices.dtype == np.float32:
            inner = np.empty((_AT_ONCE, self.space.element.inner, outer), np.float32)
            for start in range(0, len(matrices), _AT_ONCE):
                some = slice(start, start + _AT_ONCE)
                rows = inner[: len(matrices[some])]
                kernels.eliminate(matrices[some], rows)
                np.matmul(np.ascontiguousarray(rows.swapaxes(1, 2)), rows, out=out[some])
                kernels.subtract_triangles(matrices[some], out[some])
            return
        whole = out.reshape(len(out), -1)
        for part, own, change, _ in self._condensations(matrices):
            np.take(own, self._whole.ravel(), axis=1, out=whole[part], mode="clip")
            np.add(whole[part], change, out=whole[part])

    def condense(self, matrices: Numbers) -> Stiffness:
        """Condensed stiffness of element matrices (elements, entries)."""
        (i, j), outer = self._pairs, self.space.numbers.shape[1]
        lower = np.empty((len(matrices), len(i)), dtype=matrices.dtype)
        solved = np.empty((len(matrices), self.space.element.inner, outer), dtype=matrices.dtype)
        for part, own, change, inner in self._condensations(matrices):
            np.take(change, i * outer + j, axis=1, out=lower[part], mode="clip")
            np.add(lower[part], own, out=lower[part])
            solved[part] = inner
        return Stiffness(lower.ravel(), solved)

    def whole_matrices(self, values: Numbers, elements: Indices) -> Numbers:
        """Matrices of some elements, (elements, outer, outer), from values of `Stiffness`."""
        triangles = values.reshape(-1, len(self._pairs[0]))[elements]
        return triangles[:, self._whole]

    def _condensations(
        self, matrices: Numbers
    ) -> Iterator[tuple[slice, Numbers, Numbers, Numbers]]:
        """Some elements at a time: lower triangles, changes by condensation, and inner unknowns.

        Lower triangles (elements, entries) and changes (elements, outer * outer) are of the outer
        functions; the last are matrices from outer to inner unknowns, (elements, inner, outer).
        """
        inner, outer = self.space.element.inner, self.space.numbers.shape[1]
        ends = np.cumsum([len(self._pairs[0]), inner * outer])
        for start in range(0, len(matrices), _AT_ONCE):
            part = slice(start, start + _AT_ONCE)
            own, joining, within = np.split(matrices[part], ends, axis=1)
            joining = joining.reshape(len(own), inner, outer)
            # Blocks are well-conditioned, and many inverses are found faster than solutions.
            solved: Numbers = -np.linalg.inv(within.reshape(len(own), inner, inner)) @ joining
            change = solved.swapaxes(1, 2) @ joining
            yield part, own, change.reshape(len(own), -1), solved

    def electrode_terms(
        self, impedance: Numbers, area_ratio: Array | float = 1.0
    ) -> ElectrodeTerms:
        """Electrode terms for contact impedances z and ratios of deformed to flat area.

        On the flat body z becomes z / area_ratio: the current through a contact grows with the
        contact's area.

        Args:
            impedance: z of each electrode, (electrodes,) [ohm m2].
            area_ratio: area ratio at `facet_points`, (pieces, q).
        """
        conductance = self.facet_weights * area_ratio / impedance[self.facet_electrode][:, None]
        L = self.electrodes
        weighted = self.facet_shape * conductance[:, None]
        loads = weighted.sum(axis=2)
        positions = self.facet_numbers * L + self.facet_electrode[:, None]
        return ElectrodeTerms(
            matrices=weighted @ self.facet_shape.swapaxes(1, 2),
            coupling=scatter_sum(positions, loads, self.unknowns * L).reshape(self.unknowns, L),
            admittance=scatter_sum(self.facet_electrode, conductance.sum(axis=1), L),
        )

    def contact_gram(
        self, drops: Numbers, impedance: Numbers, area_ratio: Array | float = 1.0
    ) -> Numbers:
        """Integrals int_{E_l} j_k j_m over each contact, (k, k, electrodes) [1/m2].

        Args:
            drops: potential drops across the contacts per unit current, (pieces, q, k), which are
                the current densities j times the contact impedances.
            impedance, area_ratio: values as in `electrode_terms`.
        """
        electrode = self.facet_electrode
        j = drops / impedance[electrode][:, None, None]
        weights = self.facet_weights * area_ratio
        pieces = np.einsum("fq,fqk,fql->fkl", weights, j, j, optimize=True)
        gram = np.zeros((self.electrodes, *pieces.shape[1:]), dtype=pieces.dtype)
        np.add.at(gram, electrode, pieces)
        return np.moveaxis(gram, 0, 2)

    def cell_gram(self, potentials: Numbers) -> Numbers:
        """Integrals int_cell grad u_k . grad u_l, (cells, k, k), for u (elements, functions, k).

        As in the element matrices, which makes adjoint Jacobians exact for the discrete model.
        """
        full = self._gram(self.space.full_rule, potentials)
        return full - self.unseen_gram(potentials)

    def unseen_gram(self, potentials: Numbers, tensors: Array | None = None) -> Numbers:
        """Part of int_cell grad u_k . S grad u_l, (cells, k, k), that element matrices leave out.

        For mean tensors S of the cells, (cells, 3, 3); the identity when omitted.
        """
        full, quadrature_gram = (
            self._gram(rule, potentials, tensors)
            for rule in (self.space.full_rule, self.space.rule)
        )
        return (1.0 - _MISSED_ENERGY_SHARE) * (full - quadrature_gram)

    def _gram(self, rule: Rule, potentials: Numbers, tensors: Array | None = None) -> Numbers:
        gradients = self.cell_gradients(potentials, rule)
        fluxes = gradients if tensors is None else tensors[:, None] @ gradients
        weights = self._weights(rule)
        gram: Numbers = np.einsum("cq,cqbk,cqbl->ckl", weights, gradients, fluxes, optimize=True)
        return gram

    @property
    def cell_weights(self) -> Array:
        """Quadrature weights of the cells, (cells, q) [m3]."""
        return self._weights(self.space.rule)

    def _weights(self, rule: Rule) -> Array:
        weights: Array = self.space.jacobians[:, None] * rule.weights
        return weights.reshape(rule.points.shape[:2])

    def cell_gradients(self, potentials: Numbers, rule: Rule | None = None) -> Numbers:
        """Gradients at the quadrature points, (cells, q, 3, k), for u (elements, functions, k)."""
        rule = rule or self.space.rule
        reference = self.space.element.gradients(rule.X)
        gradients = np.einsum("iaq,eik->eqak", reference, potentials, optimize=True)
        inverses = self.space.inverses
        gradients = np.einsum("eqak,eab->eqbk", gradients, inverses, optimize=True)
        shaped: Numbers = gradients.reshape(-1, *rule.points.shape[1:], potentials.shape[-1])
        return shaped


def _products(weights: Array, gradients: Array, rows: Indices, columns: Indices) -> Array:
    """Weighted S_ab d_a phi_i d_b phi_j for six unit tensors S, (q, 6, entries).

    Args:
        weights: quadrature weights, (q,).
        gradients: gradients at the points, (functions, 3, q).
        rows, columns: functions i and j of each entry.
    """
    products = np.empty((len(weights), len(TENSOR_ROWS), len(rows)))
    at_points = zip(weights, gradients.transpose(2, 1, 0), products, strict=True)
    for weight, slopes, found in at_points:  # small arrays stay in the processor's cache
        row_slopes, column_slopes = (weight * slopes)[:, rows], slopes[:, columns]
        for s, (a, b) in enumerate(zip(TENSOR_ROWS, TENSOR_COLUMNS, strict=True)):
            np.multiply(row_slopes[a], column_slopes[b], out=found[s])
            if a != b:
                found[s] += row_slopes[b] * column_slopes[a]
    return products


def scatter_sum(positions: Indices, values: Numbers, size: int) -> Numbers:
    """Vector (size,) of the values added up by their positions."""
    where, flat = positions.ravel(), values.ravel()
    if np.iscomplexobj(flat):
        return scatter_sum(where, flat.real, size) + 1j * scatter_sum(where, flat.imag, size)
    return np.asarray(np.bincount(where, flat, size), dtype=np.float64)


def tensor_map(A: Array) -> Array:
    """Matrices from six entries of symmetric S to six of A S A^T, (cells, from, to)."""
    a, b = TENSOR_ROWS, TENSOR_COLUMNS
    first = A[:, a][:, :, a] * A[:, b][:, :, b]
    second = A[:, a][:, :, b] * A[:, b][:, :, a]
    to_from = first + np.where(a == b, 0.0, second)
    return to_from.swapaxes(1, 2)
