"""Reanalysis: scenes solved with the factors of another scene, by Galerkin projection.

Touches and bends change the conductivity by a part of itself, so that the factors of the flat
sensor's matrix A_0 nearly invert the matrix A of any scene. The potentials w of a scene are sought
in the space of the base potentials w_0 and of corrections A_0^-1 r for the residuals r of all
electrodes (combined approximations, Kirsch 2008). In that space the Galerkin solution w is
optimal, and T = B^T w, from which the impedances follow, has the square of its error. Each
correction takes one solution with given factors and one product with element matrices, where an
elimination would take as many operations as the assembled blocks have, cubed.
"""

from collections.abc import Callable, Iterator
from copy import copy
from functools import partial
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from eitskin.errors import ConfigurationError
from eitskin.simulator.deformation.deformed_layer import DeformedLayer, MeshPoints, layer_fields
from eitskin.simulator.electrical.assembly import ElectrodeTerms
from eitskin.simulator.electrical.cem_system import ElementProducts, impedance_matrix, zero_sums
from eitskin.simulator.electrical.forward_model import ForwardModel

Array = NDArray[np.float64]
Numbers = NDArray[np.inexact]
Indices = NDArray[np.int64]

Tolerance: TypeAlias = float
"""Error of a scene's change from the flat sensor, over the norm of that change."""
TOLERANCE: Tolerance = 3e-5
"""Default tolerance of many scenes."""
EXACT: Tolerance = 0.0
"""Tolerance of scenes that are each solved by itself, without reanalysis."""
_MOST = 8  # corrections, before a scene is solved by itself
_FALLS = 0.25  # ratio of two changes of the impedances in turn, of corrections that converge
_BASE = 1e-6  # change of the impedances of a base by its last correction, over the impedances
_ROUNDING = 1e-13  # change of the impedances, over the impedances, that is none
_DEPENDENT = 1e-12  # eigenvalue, over the largest, below which vectors are linearly dependent


class Reanalysis:
    """Forward model with the factors of one scene, for the impedances of others.

    Attributes:
        base: electrode impedance matrix of the factorised scene [ohm], (electrodes, electrodes).
        solutions: number of solutions with the factors so far.
    """

    def __init__(self, model: ForwardModel, layer: DeformedLayer) -> None:
        """Factorise the matrix of `model` for the deformed `layer`.

        Raises ConfigurationError for models with complex contact impedances.
        """
        if not is_possible(model):
            raise ConfigurationError(
                f"expected real contact impedances, got {model.contact_impedance.dtype} ones; use "
                "ForwardModel.impedance"
            )
        assembly, pattern = model.assembly, model.pattern
        self._model = model
        self._products = ElementProducts(assembly.space.numbers, assembly.unknowns)
        stiffness = assembly.stiffness(layer.entries(assembly.points))
        system = pattern.system(stiffness.values, self._contact(layer))
        self._lift, self._ground = system.lift, float(np.real(system.values[-1]))
        factors = model.solver.factorise(system.values)
        self._potentials: Array = np.asarray(factors.solve(system.coupling), dtype=np.float64)
        self._factors = factors.rounded()
        model.factorisations += 1
        self.solutions = 1
        self.base: Array = np.real(
            impedance_matrix(system.admittance, system.coupling.T @ self._potentials)
        )

    def impedance(self, layer: DeformedLayer, tolerance: Tolerance = TOLERANCE) -> Array:
        """Electrode impedance matrix [ohm], (electrodes, electrodes), of the deformed `layer`.

        Args:
            layer: of any scene; one that differs too much from the factorised scene is factorised.
            tolerance: of the change from the factorised scene, relative.
        """
        found = self._accepted(layer, tolerance)
        if found is not None:
            return found.impedance
        exact = self._model.impedance(layer.conductivity, layer.area_ratio, layer.contact_impedance)
        return np.real(exact)

    def contact_sensitivity(self, layer: DeformedLayer, tolerance: Tolerance = TOLERANCE) -> Array:
        """Derivatives of the impedance matrix by each contact impedance [1/m2].

        Shape (electrodes, electrodes, electrodes), the contact last; by the adjoint method, as
        `ForwardModel.contact_sensitivity`.

        Args:
            layer, tolerance: as for `impedance`.
        """
        found = self._accepted(layer, tolerance)
        model, z = self._model, np.real(layer.contact_impedance)
        assembly = model.assembly
        ratio = layer.area_ratio(assembly.facet_points, assembly.facet_normals)
        if found is None:
            return np.real(
                model.contact_gram(layer.conductivity, layer.area_ratio, layer.contact_impedance)
            )
        U = np.linalg.solve(found.admittance, zero_sums(np.eye(len(z))))
        drops = model.contact_drops(found.potentials() @ U, U, self._lift)
        return np.real(assembly.contact_gram(drops, z, ratio))

    def _accepted(self, layer: DeformedLayer, tolerance: Tolerance) -> "Approximation | None":
        """First approximation within the tolerance; None for a layer that differs too much."""
        change, last = np.inf, None
        for each in self.approximations(layer):
            Z = each.impedance
            if last is not None:
                before, change = change, float(np.linalg.norm(Z - last))
                if change <= _ROUNDING * np.linalg.norm(Z):
                    return each
                # Changes that fall geometrically leave errors that do; others tell nothing.
                falls = change / before
                wanted = tolerance * np.linalg.norm(Z - self.base)
                if 0.0 < falls < _FALLS and falls * change <= wanted:
                    return each
            last = Z
        return None

    def specimen(self, layer: DeformedLayer) -> "Reanalysis | None":
        """Forward model with the same factors, but with `layer` as the base of others.

        None for a layer that differs too much from the factorised scene.
        """
        last = None
        for each in self.approximations(layer):
            Z = each.impedance
            if last is not None and np.linalg.norm(Z - last) < _BASE * np.linalg.norm(Z):
                made = copy(self)
                made.base, made._potentials, made.solutions = Z, each.potentials(), 0
                return made
            last = Z
        return None

    def approximations(self, layer: DeformedLayer) -> Iterator["Approximation"]:
        """Solutions after 0, 1, 2, ... corrections, a limited number."""
        assembly, pattern = self._model.assembly, self._model.pattern
        points = MeshPoints(assembly.points, assembly.facet_points, assembly.facet_normals)
        (fields,) = layer_fields([layer], points)
        matrices = assembly.condensed_matrices(assembly.matrices(fields.tensors))
        contact = assembly.electrode_terms(layer.contact_impedance, fields.area_ratio)
        lifted = np.asarray(self._lift.any(axis=0))
        forms = pattern.forms(matrices[pattern.lifting], self._ground, contact, lifted)
        B, D = np.real(forms[0]), np.real(forms[1])
        for owner, each in zip(assembly.facet_owners, contact.matrices, strict=True):
            matrices[owner] += each
        space = _Subspace(B)
        potentials = self._potentials
        for _ in range(_MOST + 1):
            space.extend(potentials, self._product(matrices, potentials))
            found, T = space.solve()
            Z = np.real(impedance_matrix(D, T))
            yield Approximation(Z, partial(space.solution, found), D - 0.5 * (T + T.T))
            residual = space.residual(found)
            potentials = np.asarray(self._factors.solve(residual), dtype=np.float64)
            self.solutions += 1

    def _contact(self, layer: DeformedLayer) -> ElectrodeTerms:
        """Electrode terms of a deformed layer."""
        assembly = self._model.assembly
        ratio = layer.area_ratio(assembly.facet_points, assembly.facet_normals)
        return assembly.electrode_terms(layer.contact_impedance, ratio)

    def _product(self, matrices: Numbers, vectors: Array) -> Array:
        """Sum of element matrices times vectors, (unknowns, k), grounded as the base is."""
        found = np.real(self._products.product(matrices, vectors))
        ground = self._model.pattern.ground
        found[ground] += self._ground * vectors[ground]
        return found


def is_possible(model: ForwardModel) -> bool:
    """Whether reanalysis applies: real contact impedances."""
    return bool(np.isrealobj(model.contact_impedance))


class Approximation(NamedTuple):
    """Solution of one scene.

    Attributes:
        impedance: Z, (electrodes, electrodes) [ohm].
        potentials: summed where they are wanted, before the next correction; (unknowns, electrodes)
            per electrode potential.
        admittance: D - T, the inverse of Z but for a common potential [S].
    """

    impedance: Array
    potentials: Callable[[], Array]
    admittance: Array


class _Subspace:
    """Space of vectors in which A x = B, (n, k), is solved by Galerkin projection."""

    def __init__(self, B: Array) -> None:
        self._B = B
        self._blocks: list[tuple[Array, Array]] = []
        self._gram = np.zeros((0, 0))
        self._loads = np.zeros((0, B.shape[1]))

    def extend(self, V: Array, AV: Array) -> None:
        """Add the vectors V (n, m), given their products with A."""
        self._blocks.append((V, AV))
        own, size = len(self._gram), len(self._gram) + V.shape[1]
        gram = np.zeros((size, size))
        gram[:own, :own] = self._gram
        column = np.concatenate([each.T @ AV for each, _ in self._blocks])
        gram[:, own:], gram[own:] = column, column.T
        self._gram = gram
        self._loads = np.concatenate([self._loads, V.T @ self._B])

    def solve(self) -> tuple[Array, Array]:
        """Coefficients of the vectors in the Galerkin solution x, (vectors, k), and B^T x, (k, k).

        Vectors may be linearly dependent: potentials of all electrodes add up to a constant.
        """
        G = self._gram
        scale = 1.0 / np.sqrt(np.maximum(np.diag(G), np.finfo(float).tiny))
        values, vectors = np.linalg.eigh(0.5 * (G + G.T) * np.outer(scale, scale))
        kept = values > _DEPENDENT * values[-1]
        basis = scale[:, None] * vectors[:, kept]
        found = basis @ ((basis.T @ self._loads) / values[kept, None])
        return found, self._loads.T @ found

    def solution(self, found: Array) -> Array:
        """x, (n, k), by its coefficients."""
        parts = np.split(found, len(self._blocks))
        return sum((V @ own for (V, _), own in zip(self._blocks, parts, strict=True)), np.zeros(1))

    def residual(self, found: Array) -> Array:
        """B - A x, (n, k), by the coefficients of x."""
        residual = self._B.copy()
        for (_, AV), own in zip(self._blocks, np.split(found, len(self._blocks)), strict=True):
            residual -= AV @ own
        return residual
