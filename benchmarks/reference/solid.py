"""Nearly incompressible neo-Hookean solid in NGSolve, with rigid patches under given loads.

Mixed form: the stationary points of

    int mu/2 (J^(-2/3) tr F^T F - 3) + q (J - 1) - q^2 / (2 kappa) dV,

with displacements of order p and discontinuous mean stresses q of order p - 2, which are eliminated
cell by cell. Lengths are in mm, moduli in kPa, hence forces in mN.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eitskin.extras import require
from eitskin.simulator.mechanics.load_stepping import SolidError

Array = NDArray[np.float64]

_TOLERANCE = 1e-5  # of the largest change of a displacement over the largest displacement
_MOST_ITERATIONS = 20
# A tangent is kept while increments are smaller than this part of the displacement and shrink.
_KEPT_BELOW, _CONTRACTION = 0.12, 0.2
_SCALE = 1e2  # of the unknowns of the mean stress [kPa]


@dataclass(frozen=True, slots=True)
class Held:
    """Patch of the boundary whose shape is prescribed, free to translate along one direction.

    Attributes:
        boundary: name of the boundary.
        shape: displacement of the patch, a coefficient function of 3 components [mm].
        force: on the patch along `direction` [mN]; None where the patch does not translate.
        direction: unit vector of the translation.
    """

    boundary: str
    shape: Any
    force: float | None = None
    direction: tuple[float, float, float] = (0.0, 0.0, -1.0)


class MixedSolid:
    """Finite-strain equilibrium of a mesh of several neo-Hookean materials.

    Attributes:
        mesh: an `ngsolve.Mesh` [mm].
        unknowns: displacements and mean stresses.
        state: displacement and scaled mean stress at the last equilibrium.
        steps: translation of the held patches along their directions [mm].
    """

    def __init__(
        self,
        mesh: Any,
        moduli: Mapping[str, float],
        order: int,
        fixed: Mapping[str, str],
        bulk_ratio: float = 1e4,
    ) -> None:
        """Set up spaces and energy.

        Args:
            mesh: an `ngsolve.Mesh` [mm].
            moduli: shear modulus of each material [kPa].
            order: p of the displacements.
            fixed: axes "x", "y", "z" or several that are prescribed on each boundary.
            bulk_ratio: kappa / mu of all materials.
        """
        ng = self._ng = require("ngsolve", "reference")
        ng.SetNumThreads(1)
        ng.ngsglobals.msg_level = 0
        self.mesh = mesh
        names = {
            f"dirichlet{axis}": "|".join(b for b, axes in fixed.items() if axis in axes)
            for axis in "xyz"
        }
        self._space = ng.VectorH1(mesh, order=order, **names) * ng.L2(mesh, order=order - 2)
        u, q = self._space.TrialFunction()
        mu = mesh.MaterialCF(dict(moduli))
        F = ng.Id(3) + ng.Grad(u)
        J = ng.Det(F)
        stress = _SCALE * q
        energy = 0.5 * mu * (J ** (-2.0 / 3.0) * ng.InnerProduct(F, F) - 3.0)
        energy += stress * (J - 1.0) - stress**2 / (2.0 * bulk_ratio * mu)
        self._form = ng.BilinearForm(self._space, symmetric=True, condense=True)
        self._form += ng.Variation(energy.Compile() * ng.dx)
        self.state = ng.GridFunction(self._space)
        self.steps: Array = np.zeros(0)

    @property
    def unknowns(self) -> int:
        """Number of displacements and mean stresses."""
        return int(self._space.ndof)

    @property
    def displacement(self) -> Any:
        """Displacement, an `ngsolve.GridFunction` of 3 components [mm]."""
        return self.state.components[0]

    @property
    def mean_stress(self) -> Any:
        """Mean stress as a coefficient function [kPa]."""
        return _SCALE * self.state.components[1]

    def start(
        self, displacement: Any, mean_stress: Any | None = None, moved: Sequence[str] = ()
    ) -> None:
        """Take a displacement [mm] and a mean stress [kPa] as the initial guess.

        Fixed boundaries are at rest, but for those that are `moved`.
        """
        self.state.vec[:] = 0.0
        self.state.components[0].Set(displacement)
        if mean_stress is not None:
            self.state.components[1].Set(mean_stress / _SCALE)
        values, free = self.state.vec.FV().NumPy(), np.array(list(self._space.FreeDofs()))
        values[~free] = 0.0
        target = self._ng.GridFunction(self._space)
        for boundary in moved:
            target.components[0].Set(displacement, definedon=self.mesh.Boundaries(boundary))
            numbers = self._prescribed(boundary)
            values[numbers] = target.vec.FV().NumPy()[numbers]

    def settle(self, held: Sequence[Held], report: bool = False) -> int:
        """Equilibrium under prescribed shapes and forces by Newton's method.

        Starts from `state` with the prescribed shapes, shifted by `steps`, put in. Returns the
        number of iterations; raises SolidError, with `state` as it was, where there are too many.
        """
        ng, state = self._ng, self.state
        before, steps = state.vec.CreateVector(), self.steps.copy()
        before.data = state.vec
        if len(steps) != len(held):
            self.steps = np.zeros(len(held))
        try:
            lifts = [self._lift(patch) for patch in held]
            free = ng.BitArray(self._space.FreeDofs(True))
            for patch in held:
                for number in self._prescribed(patch.boundary):
                    free[int(number)] = False
            residual, inverse, last = state.vec.CreateVector(), None, math.inf
            for iteration in range(_MOST_ITERATIONS):
                if inverse is None:
                    self._linearise()
                    inverse = self._form.mat.Inverse(free, inverse="sparsecholesky")
                self._form.Apply(state.vec, residual)
                increment, moved = self._increment(inverse, residual, lifts, held, self._jump(held))
                state.vec.data += increment
                self.steps += moved
                change, size = (
                    float(np.abs(vector.FV().NumPy()[: self._displacements]).max())
                    for vector in (increment, state.vec)
                )
                if report:
                    print(f"    {iteration}: change {change:.2e} of {size:.2e} mm", flush=True)
                if not math.isfinite(change) or change > 1e3:
                    break
                if change < _TOLERANCE * max(size, 1e-3):
                    return iteration + 1
                if change > min(_KEPT_BELOW * size, _CONTRACTION * last):
                    inverse = None
                last = change
            raise SolidError("Newton's method found no equilibrium of the reference", 0.0)
        except SolidError:
            state.vec.data, self.steps = before, steps
            raise

    def _linearise(self) -> None:
        """Assemble the tangent at `state`; raises SolidError where a cell cannot be condensed."""
        # NGSolve raises an error of its own; the guess is then too far from an equilibrium.
        singular = require("netgen.libngpy._meshing", "reference").NgException
        try:
            self._form.AssembleLinearization(self.state.vec)
        except singular as error:
            raise SolidError(f"the tangent of the reference is singular: {error}", 0.0) from error

    @property
    def _displacements(self) -> int:
        return int(self._space.components[0].ndof)

    def _prescribed(self, boundary: str) -> NDArray[np.int64]:
        """Numbers of the displacements of a boundary."""
        where = self.mesh.Boundaries(boundary)
        return np.flatnonzero(np.array(list(self._space.components[0].GetDofs(where))))

    def _lift(self, patch: Held) -> Any:
        """Unit translation of a patch along its direction, zero elsewhere."""
        lift = self._ng.GridFunction(self._space)
        where = self.mesh.Boundaries(patch.boundary)
        lift.components[0].Set(self._ng.CoefficientFunction(patch.direction), definedon=where)
        return lift.vec

    def _jump(self, held: Sequence[Held]) -> Any:
        """Difference between the prescribed displacements and those of the state."""
        jump = self.state.vec.CreateVector()
        jump[:] = 0.0
        difference, now = jump.FV().NumPy(), self.state.vec.FV().NumPy()
        target = self._ng.GridFunction(self._space)
        for patch, step in zip(held, self.steps, strict=True):
            where = self.mesh.Boundaries(patch.boundary)
            numbers = self._prescribed(patch.boundary)
            shift = self._ng.CoefficientFunction(tuple(step * np.array(patch.direction)))
            target.components[0].Set(patch.shape + shift, definedon=where)
            difference[numbers] = target.vec.FV().NumPy()[numbers] - now[numbers]
        return jump

    def _increment(
        self, inverse: Any, residual: Any, lifts: list[Any], held: Sequence[Held], jump: Any
    ) -> tuple[Any, Array]:
        """Newton increment of the state and of the translations."""
        form = self._form
        condensed = residual.CreateVector()
        condensed.data = residual
        condensed.data += form.harmonic_extension_trans * residual

        def extended(prescribed: Any, load: Any | None) -> Any:
            """Increment on the cells' surfaces with given values on the boundary."""
            right = residual.CreateVector()
            right.data = -1.0 * (form.mat * prescribed)
            if load is not None:
                right.data -= load
            found = residual.CreateVector()
            found.data = inverse * right
            found.data += prescribed
            return found

        total = extended(jump, condensed)
        loaded = [k for k, patch in enumerate(held) if patch.force is not None]
        steps = np.zeros(len(held))
        if loaded:
            reaction = residual.CreateVector()
            reaction.data = form.mat * total
            reaction.data += condensed
            moved = [extended(lifts[k], None) for k in loaded]
            stiffness = np.zeros((len(loaded), len(loaded)))
            for j, each in enumerate(moved):
                force = residual.CreateVector()
                force.data = form.mat * each
                stiffness[:, j] = [self._ng.InnerProduct(lifts[i], force) for i in loaded]
            missing = [
                (held[i].force or 0.0) - self._ng.InnerProduct(lifts[i], reaction) for i in loaded
            ]
            steps[loaded] = np.linalg.solve(stiffness, missing)
            for k, each in zip(loaded, moved, strict=True):
                total.data += float(steps[k]) * each
        inner = residual.CreateVector()
        inner.data = form.harmonic_extension * total
        inner.data -= form.inner_solve * residual
        total.data += inner
        return total, steps
