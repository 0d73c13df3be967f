"""Mixed solid about a dented state, in which displacements are differences to the dents."""

from collections.abc import Callable, Sequence

import numpy as np
import skfem
from numpy.typing import NDArray

from eitskin.simulator.mechanics.materials import Law, cofactor, determinant
from eitskin.simulator.mechanics.mixed_solid import Solid, StrainState

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


class DentedSolid(Solid):
    """Solid with F = 1 + G + dc/dX and mean stress p_0 + p: c and p change a given state.

    The sharp part of a deformation, G and p_0, is thus no unknown, and what remains is smooth and
    needs few cells. On those cells the given state has a residual of its own, which is that of
    coarse quadrature; subtracted as a dead force, it does not disturb the equilibrium.

    Attributes:
        points: quadrature points, (cells, q, 3) [m].
    """

    def __init__(
        self, mesh: skfem.Mesh, laws: Sequence[Law], law_of_cell: Indices, bulk_ratio: float
    ) -> None:
        """Number the unknowns of a solid at rest; arguments as for `Solid`."""
        super().__init__(mesh, laws, law_of_cell, "solid", bulk_ratio)
        self.points: Array = np.moveaxis(np.asarray(self.basis.global_coordinates()), 0, -1)
        self._gradient: Array = np.zeros((1, 1, 3, 3))
        self._given_stress: Array = np.zeros((1, 1))

    def dent(self, gradient: Array, mean_stress: Array) -> None:
        """Set the given state: G (n, 3, 3) and p_0 (n,) [Pa] at all quadrature points."""
        self._gradient = gradient.reshape(*self.weights.shape, 3, 3)
        self._given_stress = mean_stress.reshape(self.weights.shape)
        self._last = None

    def residual_of(
        self,
        gradient: Array,
        mean_stress: Array,
        law_of_cell: Indices,
        nominal: Callable[[Array], Array] | None = None,
    ) -> Array:
        """Residual (unknowns,) of a state G (n, 3, 3), p_0 (n,), in cells of other materials.

        `nominal` turns the stresses (..., 3, 3) of a state that is given in a frame of its own.
        """
        shape = self.weights.shape
        P, dilation = np.empty((*shape, 3, 3)), np.empty(shape)
        for k in range(len(self.laws)):
            cells = law_of_cell == k
            G, p = gradient.reshape(*shape, 3, 3)[cells], mean_stress.reshape(shape)[cells]
            P[cells], dilation[cells] = self.stress_and_dilation(k, G, p)
        return self._integrated(nominal(P) if nominal else P, dilation, self.unknowns)

    def stress_and_dilation(self, law: int, gradient: Array, p: Array) -> tuple[Array, Array]:
        """First Piola-Kirchhoff stress [Pa] and volume error of a state G (..., 3, 3), p (...)."""
        F = np.eye(3) + gradient
        H = cofactor(F)
        J = determinant(F, H)
        mu = self.laws[law].shear_modulus
        mean = p + self.direct_ratio * mu * (J - 1.0)
        dilation = J - 1.0 - p / ((self.bulk_ratio - self.direct_ratio) * mu)
        return self.laws[law].stress(F) + mean[..., None, None] * H, dilation

    def _strained(self, x: Array) -> StrainState:
        moved = super()._strained(x)
        F = moved.F + self._gradient
        H = cofactor(F)
        J = determinant(F, H)
        return StrainState(moved.x, F, H, J, moved.multiplier + self._given_stress)
