"""Many scenes solved with the factors of one, by Galerkin projection, some side by side.

Touches and bends change the conductivity by a part on its own, so that the factors of the flat
sensor's matrix A_0 nearly invert the matrix A of any scene. The potentials w of a scene are sought
in the space of the base potentials w_0 and of corrections A_0^-1 r for the residuals r of all
electrodes (combined approximations, Kirsch 2008). In that space the Galerkin solution w is
optimal, and T = B^T w, from which the impedances follow, has the square of its error. Each
correction takes one solution with given factors and one product with element matrices, where an
elimination would take as many operations as the assembled blocks have, cubed.

Several scenes are corrected at once, with their residuals side by side in one array of fixed width,
so that the factors are read once for all; the next scene takes the place of each that is solved.
The numbers of a scene are the same in any place and next to any others. Element matrices of kernels
are in single precision; for small tolerances, and in plain code, they are in double.
"""

from collections.abc import Iterable
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from eitskin.compiled import compiled_kernels
from eitskin.errors import ConfigurationError
from eitskin.simulator.electrical.assembly import Assembly
from eitskin.simulator.electrical.cem_system import ElementProducts, impedance_matrix
from eitskin.simulator.electrical.deformed_layer import DeformedLayer
from eitskin.simulator.electrical.forward_model import ForwardModel
from eitskin.simulator.linalg.alike_products import column_margin
from eitskin.threads import one_thread

Array = NDArray[np.float64]
Numbers = NDArray[np.inexact]

Tolerance: TypeAlias = float
"""Error of a scene's change from the flat sensor, over the norm of that change. Where the first
correction changes less, over the norm of what it does: touches change little next to bends."""
TOLERANCE: Tolerance = 1e-4
"""Default tolerance of many scenes."""
EXACT: Tolerance = 0.0
"""Tolerance of scenes that are each solved on its own, without the factors of another."""
_COLUMNS = 64  # right sides that are solved at once: as fast as more
_FULL = 16  # columns, of which there are a multiple
_MAX_CORRECTIONS = 8  # corrections, before a scene is solved on its own
_FALLS = 0.25  # ratio of two changes of the impedances in turn, of corrections that converge
_SINGLE = 1e-5  # tolerance from which element matrices are in single precision
_ROUNDING = {np.float32: 1e-9, np.float64: 1e-13}  # change, over the impedances, that is none
# Energy of a vector beyond those before it, over its own, up to which that is rounding alone; in
# single precision vectors of rounding would be taken for corrections.
_DEPENDENT = {np.float32: 1e-4, np.float64: 1e-12}


class LayerFields(NamedTuple):
    """One deformed layer at the points of a mesh.

    Attributes:
        tensors: entries xx, yy, zz, xy, xz, yz of J F^-1 sigma F^-T, (cells, q, 6) [S/m].
        area_ratio: deformed over flat area of the electrodes, (pieces, q).
        contact_impedance: contact impedance of the electrodes, (electrodes,) [ohm m2].
    """

    tensors: Numbers
    area_ratio: Array
    contact_impedance: Numbers

    @classmethod
    def from_layer(cls, layer: DeformedLayer, assembly: Assembly) -> "LayerFields":
        """Layer at the points at which matrices are assembled."""
        where = assembly.every_point, assembly.points.shape[:2], assembly.facet_normals
        return cls(*layer.entries_and_ratio(*where), layer.contact_impedance)


class Base(NamedTuple):
    """Solved scene in which others begin.

    Attributes:
        impedance: (electrodes, electrodes) [ohm].
        potentials: w, (unknowns in the order of elimination, electrodes), per electrode potential.
    """

    impedance: Array
    potentials: Array


class Solution(NamedTuple):
    """Solution of one scene.

    Attributes:
        impedance: Z, (electrodes, electrodes) [ohm].
        potentials: potentials in the order of elimination; empty unless asked for.
        admittance: D - T, the inverse of Z but for a common potential [S].
    """

    impedance: Array
    potentials: Array
    admittance: Array


class BatchSolver:
    """Forward model with the factors of one scene, for the impedances of others.

    Attributes:
        model: the forward model.
        base: the factorised scene.
        width: number of scenes that are corrected at once.
        solutions: number of solutions with the factors so far.
    """

    def __init__(self, model: ForwardModel, layer: DeformedLayer) -> None:
        """Factorise the matrix of `model` for the deformed `layer`.

        Raises ConfigurationError for designs with complex conductivities or contact impedances.
        """
        if model.design.is_complex:
            raise ConfigurationError(
                "expected real conductivities and contact impedances, got complex ones; use "
                "ForwardModel.impedance"
            )
        assembly, pattern = model.assembly, model.pattern
        self.model = model
        fields = LayerFields.from_layer(layer, assembly)
        contact = assembly.electrode_terms(layer.contact_impedance, fields.area_ratio)
        stiffness = assembly.condense(assembly.matrices(fields.tensors))
        system = pattern.system(stiffness.values, contact)
        self.lifted = np.asarray(system.lift.any(axis=0))
        self.lift, self.grounded = system.lift, float(np.real(system.values[-1]))
        factors = model.solver.factorise(system.values)
        w = np.real(factors.solve(system.coupling))
        model.factorisations += 1
        self._factors = factors.to_single()
        self.order = self._factors.order
        self.rank = np.argsort(self.order)
        self.ground = int(self.rank[pattern.ground])
        size = assembly.unknowns
        self.elements, self.facets = (
            ElementProducts(self.rank[numbers], size, coefficients)
            for numbers, coefficients in (
                (assembly.space.numbers, assembly.constant),
                (assembly.facet_numbers, np.zeros(0)),
            )
        )
        self.width = max(1, _COLUMNS // len(system.admittance))
        self.solutions = 1
        Z = np.real(impedance_matrix(system.admittance, system.coupling.T @ w))
        self.base = Base(Z, np.ascontiguousarray(w[self.order], dtype=np.float64))

    @one_thread()
    def solve(
        self,
        scenes: Iterable[tuple[LayerFields, Base]],
        tolerance: Tolerance = TOLERANCE,
        potentials: bool = False,
        width: int | None = None,
    ) -> list[Solution | None]:
        """Solutions of scenes; None for each that differs too much from the factorised one.

        Args:
            scenes: scenes, each with its flat sensor, where its corrections begin; taken one by one
                as places become free.
            tolerance: tolerance of the change of each from the flat sensor.
            potentials: whether they are wanted, too.
            width: scenes that are corrected at once, on which last digits depend.
        """
        waiting, width = enumerate(scenes), width or self.width
        electrodes = len(self.base.impedance)
        columns = -(-width * electrodes // _FULL) * _FULL
        margin = column_margin(columns)
        if margin is None:
            margin, width = 0, 1  # always at the same place
        firsts = [margin + k * electrodes for k in range(width)]
        places = [slice(first, first + electrodes) for first in firsts]
        x = np.zeros((len(self.order), columns + 2 * margin), dtype=np.float32)
        workspaces = _workspaces(self, tolerance, width, potentials)
        solved: dict[int, Solution | None] = {}
        active: dict[int, _Projection] = {}
        while True:
            free = [place for place in range(width) if place not in active]
            fresh = {
                place: _Projection(self, number, *scene, tolerance, workspaces[place])
                for place, (number, scene) in zip(free, waiting, strict=False)
            }
            _advance(fresh.values())
            active |= fresh
            if not active:
                return [solved[number] for number in range(len(solved))]
            for place, own in enumerate(places):
                x[:, own] = active[place].residual() if place in active else 0.0
            self._factors.solve(x)
            self.solutions += len(active)
            for place, scene in active.items():
                scene.extend(x[:, places[place]])
            _advance(active.values())
            for place, scene in list(active.items()):
                if scene.ended:
                    solved[scene.number] = scene.solution()
                    del active[place]


class _Workspace(NamedTuple):
    """Arrays in which one scene after the other is solved: memory is slow while it is fresh.

    Attributes:
        matrices: condensed element matrices, (elements, functions, functions).
        block: newest vectors, and their products with the matrix, (2, unknowns, electrodes).
        vectors: vectors of the space, (blocks, unknowns, electrodes); none unless wanted.
        products: B, and products of the vectors with the matrix, as rows, (electrodes + vectors,
            unknowns).
        parts: vectors in each element, and products, (2, elements, functions, electrodes), which
            all workspaces share as they do the block.
    """

    matrices: Numbers
    block: Array
    vectors: Array
    products: Array
    parts: Numbers


def _workspaces(
    solver: "BatchSolver", tolerance: Tolerance, count: int, potentials: bool
) -> list[_Workspace]:
    """Workspaces of scenes; element matrices are in single precision where that suffices."""
    kernels = compiled_kernels("eitskin.simulator.electrical.kernels")
    kind = np.float32 if kernels and tolerance >= _SINGLE else np.float64
    assembly, electrodes = solver.model.assembly, len(solver.base.impedance)
    elements, outer = assembly.space.numbers.shape
    parts = np.empty((2, elements, outer, electrodes), kind)
    matrices = np.empty((count, elements, outer, outer), kind)
    unknowns, blocks = len(solver.order), _MAX_CORRECTIONS + 1
    block = np.empty((2, unknowns, electrodes))
    vectors = np.empty((count, blocks if potentials else 0, unknowns, electrodes))
    products = np.empty((count, (1 + blocks) * electrodes, unknowns))
    return [_Workspace(matrices[k], block, vectors[k], products[k], parts) for k in range(count)]


class _Projection:
    """Galerkin projection of one scene.

    Attributes:
        number: number of the scene.
        ended: whether it is solved, or cannot be solved.
    """

    def __init__(
        self,
        solver: BatchSolver,
        number: int,
        fields: LayerFields,
        base: Base,
        tolerance: Tolerance,
        workspace: _Workspace,
    ) -> None:
        self.number, self._solver, self._workspace = number, solver, workspace
        self._flat, self._tolerance = base.impedance, tolerance
        self._kind = workspace.matrices.dtype.type
        assembly, pattern = solver.model.assembly, solver.model.pattern
        tensors: Numbers = fields.tensors.astype(self._kind, copy=False)
        self._matrices = workspace.matrices
        assembly.condense_into(assembly.matrices(tensors), self._matrices)
        contact = assembly.electrode_terms(fields.contact_impedance, fields.area_ratio)
        self._pieces = np.real(contact.matrices)
        near = self._matrices[pattern.lifting]
        B, D, _ = pattern.forms(near, solver.grounded, contact, solver.lifted)
        self.D = np.real(D)
        electrodes = len(self.D)
        load = workspace.products[:electrodes]
        load[:] = np.real(B)[solver.order].T
        self._scale = 1.0 / max(load.max(), -load.min())
        self._gram, self._loads = np.zeros((0, 0)), np.zeros((0, electrodes))
        self._impedances: list[Array] = []
        self._changes = [np.inf]
        self._converged = self.ended = False
        self.extend(base.potentials)

    def extend(self, more: Numbers) -> None:
        """Add vectors (unknowns, k) to the space, and find the solution in it."""
        solver, work, own, count = self._solver, self._workspace, len(self._gram), len(self.D)
        (V, AV), size = work.block, own + count
        V[:], AV[:] = more, 0.0
        solver.elements.add_product(self._matrices, V, AV, work.parts)
        solver.facets.add_product(self._pieces, V, AV)
        AV[solver.ground] += solver.grounded * V[solver.ground]
        work.products[size : size + count] = AV.T
        if len(work.vectors):
            work.vectors[own // count] = V
        row = V.T @ work.products[: size + count].T
        gram = np.empty((size, size))
        gram[:own, :own] = self._gram
        gram[own:], gram[:own, own:] = row[:, count:], row[:, count:size].T
        self._gram = gram
        self._loads = np.concatenate([self._loads, row[:, :count]])
        self._found, self.T = project_galerkin(gram, self._loads, _DEPENDENT[self._kind])

    def residual(self) -> Array:
        """B - A w, (unknowns, electrodes), over the largest number of B."""
        shares = np.concatenate([np.eye(len(self.D)), -self._found]) * self._scale
        residual: Array = (shares.T @ self._workspace.products[: len(shares)]).T
        return residual

    def advance(self, Z: Array) -> None:
        """Test the impedances [ohm] of the present space."""
        changes, last = self._changes, self._impedances
        if last:
            changes.append(float(np.linalg.norm(Z - last[-1])))
            # Changes that fall geometrically leave errors that do; others show nothing.
            falls = changes[-1] / changes[-2] if changes[-2] else 0.0
            target = self._tolerance * min(float(np.linalg.norm(Z - self._flat)), changes[1])
            none = changes[-1] <= _ROUNDING[self._kind] * np.linalg.norm(Z)
            good = 0.0 < falls < _FALLS and falls * changes[-1] <= target
            self._converged = bool(none or good)
        last.append(Z)
        self.ended = self._converged or len(last) > _MAX_CORRECTIONS or not np.isfinite(Z).all()

    def solution(self) -> Solution | None:
        """Last solution; None where the corrections have not converged."""
        if not self._converged:
            return None
        w, vectors = np.zeros((0, len(self.D))), self._workspace.vectors
        if len(vectors):
            parts = self._found.reshape(-1, *self.D.shape)
            w = (vectors[: len(parts)] @ parts).sum(axis=0)
        return Solution(self._impedances[-1], w, self.D - 0.5 * (self.T + self.T.T))


def _advance(scenes: Iterable[_Projection]) -> None:
    """Let scenes test their impedances."""
    some = list(scenes)
    if some:
        Z = impedance_matrix(np.array([each.D for each in some]), np.array([s.T for s in some]))
        for each, own in zip(some, Z, strict=True):
            each.advance(own)


def project_galerkin(gram: Array, loads: Array, dependent: float) -> tuple[Array, Array]:
    """Coefficients of the vectors in the Galerkin solution x, (vectors, k), and B^T x, (k, k).

    Args:
        gram: gram of the vectors, which may be linearly dependent: potentials of all electrodes add
            up to a constant; (vectors, vectors).
        loads: products of the vectors with B, (vectors, k).
        dependent: share of its energy up to which a vector counts as dependent.
    """
    kernels = compiled_kernels("eitskin.simulator.electrical.kernels")
    if kernels is not None:
        solution, product = np.empty(loads.shape), np.empty((loads.shape[1], loads.shape[1]))
        kernels.project(gram, loads, dependent, solution, product)
        return solution, product
    scale = 1.0 / np.sqrt(np.maximum(np.diag(gram), np.finfo(float).tiny))
    values, vectors = np.linalg.eigh(0.5 * (gram + gram.T) * np.outer(scale, scale))
    independent = values > dependent * values[-1]
    basis = scale[:, None] * vectors[:, independent]
    solution = basis @ ((basis.T @ loads) / values[independent, None])
    return solution, loads.T @ solution
