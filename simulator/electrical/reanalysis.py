"""Reanalysis: scenes near a solved scene, by partial elimination and a first-order correction.

A touch deforms all of an incompressible layer, but the pulled-back conductivity changes much only
close to the touch. Strips of unknowns there are eliminated anew between the cached Schur
complements of the other strips (reanalysis of modified structures, Kirsch 2008). Everywhere else
the change delta is small, and the impedance follows to first order from the potentials u of the
solved scene:

    Z_kl = Z'_kl - int grad u_k . delta grad u_l - int_electrodes (u_k - U_k) (u_l - U_l) d(1/z)

Z' is the impedance with the re-eliminated strips. The neglected second-order term grows with the
square of the largest change treated to first order.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eitskin.errors import ConfigurationError
from eitskin.simulator.electrical.assembly import Stiffness
from eitskin.simulator.electrical.cem_system import CemSystem, zero_sums
from eitskin.simulator.electrical.forward_model import ForwardModel
from eitskin.simulator.layer.deformed_layer import DeformedLayer
from eitskin.simulator.linalg.block_cholesky import BlockCholesky
from eitskin.simulator.linalg.two_sided_elimination import TwoSidedElimination

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Tolerance:
    """Relative changes of the conductivity below which reanalysis approximates.

    Attributes:
        linear: bound of changes treated to first order, in strips with all changes below the
            bound; 0 for no strips.
        coarse: bound of changes evaluated at the coarse points of each cell only; 0 for no cells.
    """

    linear: float = 0.007
    coarse: float = 0.03

    def __post_init__(self) -> None:
        if not 0.0 <= self.linear <= self.coarse < 1.0:
            raise ConfigurationError(
                "expected tolerances 0 <= linear <= coarse < 1, got "
                f"linear = {self.linear}, coarse = {self.coarse}; lower linear, or raise coarse"
            )


EXACT = Tolerance(0.0, 0.0)


class Reanalysis:
    """Forward model solved for one scene, for the impedances of scenes near by.

    Attributes:
        base: electrode impedance matrix of the solved scene [ohm], (electrodes, electrodes).
        strips: number of strips eliminated so far.
        resolved: number of elements with the conductivity evaluated at all quadrature points so
            far.
    """

    def __init__(
        self, model: ForwardModel, layer: DeformedLayer, tolerance: Tolerance | None = None
    ) -> None:
        """Solve `model` for the deformed `layer`.

        Raises ConfigurationError for models without block Cholesky or with complex contact
        impedances.
        """
        solver = model.solver
        if not is_possible(model) or not isinstance(solver, BlockCholesky):
            raise ConfigurationError(
                f"expected block Cholesky and real contact impedances, got {solver.name} and "
                f"{model.contact_impedance.dtype} impedances; use ForwardModel.impedance"
            )
        self._model, self._tolerance = model, tolerance or Tolerance()
        assembly = model.assembly
        self._matrices = assembly.matrices(layer.entries(assembly.points))
        stiffness = assembly.condensed(self._matrices)
        self._values = stiffness.values.reshape(len(self._matrices), -1)
        self._coarse = layer.entries(assembly.space.coarse.points)
        self._largest = self._coarse[..., :3].max(axis=(1, 2))
        self._ratio = layer.area_ratio(assembly.facet_points, assembly.facet_normals)
        self._coarse_ratio = layer.area_ratio(assembly.facet_coarse_points, assembly.facet_normals)
        contact = assembly.electrode_terms(model.contact_impedance, self._ratio)
        system = model.pattern.system(stiffness.values, contact)
        self._lifted = system.lifted
        self._elimination = TwoSidedElimination(solver, system.values, system.coupling)
        model.factorisations += 1
        self.strips, self.resolved = 2 * len(solver.block_rows), 0
        strip = np.empty(assembly.unknowns, dtype=np.int64)
        for number, each in enumerate(solver.block_rows):
            strip[each.unknowns] = number
        of_element = strip[assembly.space.numbers]
        self._first, self._last = of_element.min(axis=1), of_element.max(axis=1)
        self._linearise(system, stiffness)

    def _linearise(self, system: CemSystem, stiffness: Stiffness) -> None:
        """Keep Z, and the derivatives of Z by the conductivity and by the electrode areas."""
        model, assembly = self._model, self._model.assembly
        per_potential = self._elimination.factors.solve(system.coupling)
        T = system.coupling.T @ per_potential
        U = np.linalg.solve(system.admittance - 0.5 * (T + T.T), zero_sums(np.eye(len(T))))
        w = per_potential @ U
        self.base: Array = np.real(system.impedance(T))
        u = assembly.space.in_elements(w + system.lift @ U, stiffness.inner)
        self._pairs = np.triu_indices(len(T))
        by_point = assembly.energies(np.real(u))[..., self._pairs[0], self._pairs[1]]
        self._by_point = np.ascontiguousarray(by_point.reshape(-1, by_point.shape[-1]))
        drop = model.contact_drops(w, U, system.lift)
        drops = drop[..., self._pairs[0]] * drop[..., self._pairs[1]]
        per_area = assembly.facet_weights / model.contact_impedance[assembly.facet_electrode, None]
        self._by_facet = assembly.facet_interpolation.T @ (per_area[..., None] * drops)

    def impedance(self, layer: DeformedLayer) -> Array:
        """Electrode impedance matrix [ohm], (electrodes, electrodes), of the deformed `layer`.

        The layer is evaluated at the coarse points of each cell, and at all quadrature points
        where the conductivity has changed much.
        """
        assembly, cells = self._model.assembly, self._model.assembly.space.element.cells
        change = layer.entries(assembly.space.coarse.points) - self._coarse
        wider = layer.area_ratio(assembly.facet_coarse_points, assembly.facet_normals)
        wider = wider - self._coarse_ratio
        size = (np.abs(change).max(axis=(1, 2)) / self._largest).reshape(-1, cells).max(axis=1)
        owners = assembly.facet_owners
        np.maximum.at(size, owners, np.abs(wider).max(axis=1))

        anew = size >= self._tolerance.linear
        linear = np.ones(len(size), dtype=bool)
        Z = self.base
        if anew.any():
            first, last = int(self._first[anew].min()), int(self._last[anew].max())
            linear = (self._first < first) | (self._last > last)
            resolved = (size >= self._tolerance.coarse) & ~linear
            stiffness = self._stiffness(layer, change, resolved, ~linear & ~resolved)
            ratio = self._new_ratio(layer, wider, resolved[owners], ~linear[owners])
            Z = self._solved(stiffness, ratio, first, last)
        change[np.repeat(~linear, cells)] = 0.0
        wider[~linear[owners]] = 0.0
        first_order = change.ravel() @ self._by_point
        first_order += np.tensordot(wider, self._by_facet, axes=2)
        correction = np.zeros_like(Z)
        correction[self._pairs] = first_order
        correction.T[self._pairs] = first_order
        return Z - correction

    def _stiffness(
        self, layer: DeformedLayer, change: Array, resolved: Flags, even: Flags
    ) -> Array:
        """Condensed stiffness values, recomputed in `resolved` and `even` elements."""
        assembly = self._model.assembly
        cells = np.arange(len(change)).reshape(len(resolved), -1)
        values, new = self._values.copy(), []
        parts = [np.flatnonzero(even), np.flatnonzero(resolved)]
        if len(parts[0]):
            part = assembly.matrices(change[cells[parts[0]].ravel()], parts[0], coarse=True)
            new.append(self._matrices[parts[0]] + part)
        if len(parts[1]):
            points = assembly.points[cells[parts[1]].ravel()]
            new.append(assembly.matrices(layer.entries(points), parts[1]))
            self.resolved += len(parts[1])
        changed = np.concatenate(parts)
        found = assembly.condensed(np.concatenate(new)).values
        values[changed] = found.reshape(len(changed), -1)
        return values.ravel()

    def _new_ratio(self, layer: DeformedLayer, wider: Array, resolved: Flags, anew: Flags) -> Array:
        """Area ratios (pieces, q), recomputed on pieces `anew`, at all points where `resolved`."""
        assembly, ratio = self._model.assembly, self._ratio
        if not anew.any():
            return ratio
        ratio = ratio + (wider * anew[:, None]) @ assembly.facet_interpolation.T
        if resolved.any():
            where = assembly.facet_points[resolved], assembly.facet_normals[resolved]
            ratio[resolved] = layer.area_ratio(*where)
        return ratio

    def _solved(self, stiffness: Array, ratio: Array, first: int, last: int) -> Array:
        """Impedance Z [ohm] with strips `first` to `last` eliminated anew."""
        model = self._model
        contact = model.assembly.electrode_terms(model.contact_impedance, ratio)
        system = model.pattern.system(stiffness, contact, self._lifted)
        self.strips += last - first + 1
        T = self._elimination.congruence(system.values, system.coupling, first, last)
        Z: Array = np.real(system.impedance(T))
        return Z


def is_possible(model: ForwardModel) -> bool:
    """Whether reanalysis applies: block Cholesky and real contact impedances."""
    return isinstance(model.solver, BlockCholesky) and np.isrealobj(model.contact_impedance)
