"""Reanalysis: scenes solved with the factors of another scene, by Galerkin projection.

Touches and bends change the conductivity by a part of itself, so that the factors of the flat
sensor's matrix A_0 nearly invert the matrix A of any scene. The potentials w of a scene are sought
in the space of the base potentials w_0 and of corrections A_0^-1 r for the residuals r of all
electrodes (combined approximations, Kirsch 2008). In that space the Galerkin solution w is
optimal, and T = B^T w, from which the impedances follow, has the square of its error. Each
correction takes one solution with given factors and one product with element matrices, where an
elimination would take as many operations as the assembled blocks have, cubed.
"""

from collections.abc import Iterator
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from eitskin.errors import ConfigurationError
from eitskin.simulator.electrical.cem_system import CemSystem
from eitskin.simulator.electrical.forward_model import ForwardModel
from eitskin.simulator.layer.deformed_layer import DeformedLayer
from eitskin.simulator.linalg.block_cholesky import BlockFactors
from eitskin.simulator.linalg.element_products import ElementProducts
from eitskin.simulator.linalg.multifrontal_cholesky import MultifrontalFactors
from eitskin.simulator.linalg.sparse_solvers import Factorisation

Array = NDArray[np.float64]

Tolerance: TypeAlias = float
"""Error of a scene's change from the flat sensor, over the norm of that change."""
TOLERANCE: Tolerance = 3e-5
"""Default tolerance of many scenes."""
EXACT: Tolerance = 0.0
"""Tolerance of scenes that are each solved by itself, without reanalysis."""
_MOST = 8  # corrections, before a scene is solved by itself
_FALLS = 0.25  # ratio of two changes of the impedances in turn, of corrections that converge
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
        assembly = model.assembly
        self._model = model
        numbers = np.concatenate([assembly.space.numbers, assembly.facet_numbers])
        self._products = ElementProducts(numbers, assembly.unknowns)
        self._lifted: NDArray[np.bool_] | None = None
        system = self._system(layer)
        self._lifted = system.lifted
        factors = model.solver.factorise(system.values)
        self._potentials: Array = np.asarray(factors.solve(system.coupling), dtype=np.float64)
        self._factors: Factorisation = (
            factors.rounded()
            if isinstance(factors, BlockFactors | MultifrontalFactors)
            else factors
        )
        model.factorisations += 1
        self.solutions = 1
        self.base: Array = np.real(system.impedance(system.coupling.T @ self._potentials))

    def impedance(self, layer: DeformedLayer, tolerance: Tolerance = TOLERANCE) -> Array:
        """Electrode impedance matrix [ohm], (electrodes, electrodes), of the deformed `layer`.

        Args:
            layer: of any scene; one that differs too much from the factorised scene is factorised.
            tolerance: of the change from the factorised scene, relative.
        """
        system = self._system(layer)
        change, last = np.inf, None
        for Z in self._approximations(system):
            if last is not None:
                before, change = change, float(np.linalg.norm(Z - last))
                if change <= _ROUNDING * np.linalg.norm(Z):
                    return Z
                # Changes that fall geometrically leave errors that do; others tell nothing.
                falls = change / before
                wanted = tolerance * np.linalg.norm(Z - self.base)
                if 0.0 < falls < _FALLS and falls * change <= wanted:
                    return Z
            last = Z
        self._model.factorisations += 1
        T = self._model.solver.congruence(system.values, system.coupling)
        return np.real(system.impedance(T))

    def approximations(self, layer: DeformedLayer) -> Iterator[Array]:
        """Electrode impedance matrices [ohm] after 0, 1, 2, ... corrections, a limited number."""
        return self._approximations(self._system(layer))

    def _approximations(self, system: CemSystem) -> Iterator[Array]:
        whole = self._products.whole(np.asarray(system.values[:-1], dtype=np.float64))
        V, B = self._potentials, np.asarray(system.coupling, dtype=np.float64)
        AV = self._product(system, whole, V)
        combined = _galerkin(V, AV, B)
        yield np.real(system.impedance(B.T @ V @ combined))
        for _ in range(_MOST):
            more = np.asarray(self._factors.solve(B - AV @ combined), dtype=np.float64)
            self.solutions += 1
            V = np.concatenate([V, more], axis=1)
            AV = np.concatenate([AV, self._product(system, whole, more)], axis=1)
            combined = _galerkin(V, AV, B)
            yield np.real(system.impedance(B.T @ V @ combined))

    def _system(self, layer: DeformedLayer) -> CemSystem:
        """Linear system of a deformed layer, electrodes in the forms of the factorised scene."""
        model, assembly = self._model, self._model.assembly
        matrices = assembly.matrices(layer.entries(assembly.points))
        ratio = layer.area_ratio(assembly.facet_points, assembly.facet_normals)
        contact = assembly.electrode_terms(model.contact_impedance, ratio)
        values = assembly.condensed_values(matrices)
        return model.pattern.system(values, contact, self._lifted)

    def _product(self, system: CemSystem, whole: Array, vectors: Array) -> Array:
        """Matrix of the system times vectors, (unknowns, k)."""
        found = self._products.product(whole, vectors)
        ground = self._model.pattern.rows[-1]
        found[ground] += np.real(system.values[-1]) * vectors[ground]
        return found


def is_possible(model: ForwardModel) -> bool:
    """Whether reanalysis applies: real contact impedances."""
    return bool(np.isrealobj(model.contact_impedance))


def _galerkin(V: Array, AV: Array, B: Array) -> Array:
    """Coefficients c, (m, k), of the Galerkin solutions V c of A x = B in the space of V (n, m).

    Vectors may be linearly dependent: potentials of all electrodes add up to a constant.
    """
    G = V.T @ AV
    scale = 1.0 / np.sqrt(np.maximum(np.diag(G), np.finfo(float).tiny))
    values, vectors = np.linalg.eigh(0.5 * (G + G.T) * np.outer(scale, scale))
    kept = values > _DEPENDENT * values[-1]
    basis = scale[:, None] * vectors[:, kept]
    found: Array = basis @ ((basis.T @ (V.T @ B)) / values[kept, None])
    return found
