"""Linear system of the complete electrode model, free of cancellation for any contact impedance.

With u = w + E U, where column l of E is zero or a lifting function that is one on electrode l and
zero on the others, the weak form of `assembly` becomes

    A w = B U,   I = D U - B^T w,   A = K + electrode terms

with a stiffness matrix K, in one of two forms per electrode:

    E_l = 0:                B_l = int phi / z_l,    D_ll = int 1 / z_l
    E_l = 1 on electrode l: B_l = -K E_l,           D_lm = E_l^T K E_m

In the first form D grows like 1/z while I = D U - B^T w does not; in the second form D does not
depend on z, but is too large once 1/z is small. The form with the smaller D_ll is taken: both
limits, shunt electrodes (z -> 0) and insulated ones (z -> infinity), keep all their digits.

One unknown is grounded through a conductance as large as the stiffness's own entry. No current
flows to ground when the electrode currents sum to zero, so potentials only shift by a constant,
and A stays regular for large z.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from eitskin.compiled import compiled_kernels
from eitskin.simulator.electrical.assembly import Assembly, ElectrodeTerms

Array = NDArray[np.float64]
Numbers = NDArray[np.inexact]
Indices = NDArray[np.int64]

_FEW = 64  # elements whose products are no faster by a library


@dataclass(frozen=True, slots=True, eq=False)
class CemSystem:
    """Linear system A w = B U, I = D U - B^T w with potentials u = w + E U.

    Attributes:
        values: values of the lower triangle of A, at `SystemPattern.rows` and `columns`.
        coupling: B, (unknowns, electrodes) [S].
        admittance: D, (electrodes, electrodes) [S].
        lift: lifting functions E, (unknowns, electrodes).
    """

    values: Numbers
    coupling: Numbers
    admittance: Numbers
    lift: Array


def impedance_matrix(D: Numbers, T: Numbers) -> Numbers:
    """Impedance matrices Z [ohm] with zero row and column sums, from D and T = B^T A^-1 B.

    All are (..., electrodes, electrodes). U = (D - T)^-1 I. Written as D^-1 + D^-1 T (D - T)^-1,
    the contact impedance of an insulated electrode is separate from the body's share, which keeps
    its digits. Subtracting the means restricts Z to currents that sum to zero.
    """
    T = 0.5 * (T + T.swapaxes(-1, -2))
    own = np.linalg.inv(D)
    Z = zero_sums(own) + zero_sums(own @ T @ np.linalg.inv(D - T))
    symmetric: Numbers = 0.5 * (Z + Z.swapaxes(-1, -2))
    return symmetric


class ElementProducts:
    """Products of vectors with sums of element matrices on one mesh.

    A constant potential has no flux: where matrices are in single precision, the constant of each
    element is subtracted from the vectors, and a row of its own takes what the others give, so that
    small differences keep their digits.
    """

    def __init__(self, numbers: Indices, unknowns: int, one: Array) -> None:
        """Prepare for elements with the unknowns `numbers`, (elements, functions).

        `one` are the coefficients of the constant function, (functions,); empty for matrices that
        are always in double precision.
        """
        self._numbers = np.ascontiguousarray(numbers, dtype=np.int32)
        self._one, self._unknowns = one, unknowns

    @cached_property
    def _gather_matrix(self) -> csr_array:
        count = self._numbers.size
        ends = np.arange(count + 1)
        shape = count, self._unknowns
        return csr_array((np.ones(count), self._numbers.ravel(), ends), shape).T.tocsr()

    def add_product(
        self, matrices: Numbers, vectors: Numbers, total: Numbers, parts: Numbers | None = None
    ) -> None:
        """Add matrices (elements, functions, functions) times vectors to `total`.

        Vectors and total are (unknowns, k); parts (2, elements, functions, k) are room for the
        vectors in each element and their products.
        """
        kernels = compiled_kernels("eitskin.simulator.electrical.kernels")
        if matrices.dtype == np.float64 and kernels is not None and len(self._numbers) <= _FEW:
            some, right = np.ascontiguousarray(matrices), np.ascontiguousarray(vectors)
            kernels.add_products(some, self._numbers, right, total)
            return
        if kernels is None or matrices.dtype != np.float32:
            each = matrices @ vectors[self._numbers]
            total += self._gather_matrix @ each.reshape(-1, vectors.shape[1])
            return
        place = self._numbers, self._one, int(np.argmax(self._one != 0.0))
        if parts is None:
            parts = np.empty((2, *self._numbers.shape, vectors.shape[1]), dtype=np.float32)
        kernels.gather(np.ascontiguousarray(vectors), *place, parts[0])
        np.matmul(matrices, parts[0], out=parts[1])
        kernels.scatter(parts[1], *place, total)


class SystemPattern:
    """Sparsity pattern, grounded unknown and lifting functions: all that scenes share.

    Attributes:
        rows, columns: position of each value in the lower triangle of A; equal ones add up.
        ground: the grounded unknown.
        lifting: elements in which some lifting function is not zero.
    """

    def __init__(self, assembly: Assembly) -> None:
        """Choose the grounded unknown and the lifting functions."""
        self._assembly, self.ground = assembly, _ground(assembly)
        self.rows: Indices = np.append(assembly.rows, self.ground)
        self.columns: Indices = np.append(assembly.columns, self.ground)
        count = len(assembly.rows) - assembly.contact_entries
        rows, columns = assembly.rows[:count], assembly.columns[:count]
        self._grounded = np.flatnonzero((rows == self.ground) & (columns == self.ground))
        self._lift, self._liftable = _lift(assembly)
        numbers = assembly.space.numbers
        self.lifting: Indices = np.flatnonzero(
            np.asarray(self._lift.any(axis=1))[numbers].any(axis=1)
        )
        self._products = ElementProducts(
            numbers[self.lifting], assembly.unknowns, assembly.constant
        )

    def system(self, stiffness: Numbers, contact: ElectrodeTerms) -> CemSystem:
        """System for stiffness values and electrode terms, each electrode in its own form.

        Args:
            stiffness: values of K, as of `Stiffness`.
            contact: electrode terms.
        """
        ground = stiffness[self._grounded].sum()
        matrices = self._assembly.whole_matrices(stiffness, self.lifting)
        coupling, admittance, lift = self.forms(matrices, ground, contact)
        values = np.concatenate([stiffness, contact.values, [ground]])
        return CemSystem(values, coupling, admittance, lift)

    def forms(
        self,
        matrices: Numbers,
        ground: complex,
        contact: ElectrodeTerms,
        lifted: NDArray[np.bool_] | None = None,
    ) -> tuple[Numbers, Numbers, Array]:
        """B, D and E, (unknowns or electrodes, electrodes), each electrode in its own form.

        Args:
            matrices: matrices of the elements `lifting`, (elements, functions, functions) [S].
            ground: conductance of the grounded unknown [S].
            contact: electrode terms.
            lifted: electrodes in the second form; those with the smaller D_ll when omitted.
        """
        E = self._lift
        if lifted is not None and not lifted.any():
            return contact.coupling, np.diag(contact.admittance), np.zeros_like(E)
        KE = np.zeros(E.shape, matrices.dtype if np.iscomplexobj(matrices) else E.dtype)
        self._products.add_product(matrices, E, KE)
        KE[self.ground] += ground * E[self.ground]
        energy = E.T @ KE
        if lifted is None:
            lifted = self._liftable & (np.abs(np.diag(energy)) < np.abs(contact.admittance))
        admittance = np.where(np.outer(lifted, lifted), energy, 0.0) + np.diag(
            np.where(lifted, 0.0, contact.admittance)
        )
        return np.where(lifted, -KE, contact.coupling), admittance, np.where(lifted, E, 0.0)


def zero_sums(Z: Numbers) -> Numbers:
    """Z with the means of its rows and columns subtracted, (..., rows, columns)."""
    Z = Z - Z.mean(axis=-2, keepdims=True)
    centred: Numbers = Z - Z.mean(axis=-1, keepdims=True)
    return centred


def _ground(assembly: Assembly) -> int:
    """Unknown to be grounded: the one with the largest load on electrode 0."""
    own = np.flatnonzero(assembly.facet_electrode == 0)
    loads = np.einsum("fiq,fq->fi", assembly.facet_shape[own], assembly.facet_weights[own])
    # Grounding a function whose coefficient in a constant potential is zero would fix nothing.
    functions = assembly.facet_functions[own]
    loads = np.where(assembly.constant[functions] != 0.0, loads, -np.inf)
    piece, function = np.unravel_index(loads.argmax(), loads.shape)
    return int(assembly.facet_numbers[own][piece, function])


def _lift(assembly: Assembly) -> tuple[Array, NDArray[np.bool_]]:
    """Lifting functions E (unknowns, electrodes), and the electrodes that have an exact one."""
    E = np.zeros((assembly.unknowns, assembly.electrodes))
    touching = np.abs(assembly.facet_shape).max(axis=2) > 1e-12
    heights = assembly.contacts.corners[..., 2]
    for electrode in range(assembly.electrodes):
        own = np.flatnonzero(assembly.facet_electrode == electrode)
        indicator = assembly.space.element.indicator(heights[own].min(), heights[own].max())
        values = np.where(touching[own], indicator[assembly.facet_functions[own]], 0.0)
        is_set = values != 0.0
        E[assembly.facet_numbers[own][is_set], electrode] = values[is_set]
    on = np.einsum("fiq,fie->fqe", assembly.facet_shape, E[assembly.facet_numbers])
    potentials = np.eye(assembly.electrodes)[assembly.facet_electrode][:, None]
    wrong = np.abs(on - potentials).max(axis=(0, 1))
    return E, wrong < 1e-9
