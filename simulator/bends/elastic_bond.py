"""Elastic bond between faces of a solid and a moving plate."""

import numpy as np
import skfem
from numpy.typing import NDArray
from scipy.sparse import block_array, csc_array, eye_array, kron
from skfem.models.poisson import mass

from eitskin.simulator.mechanics.load_stepping import ForceTerm
from eitskin.simulator.mechanics.mixed_solid import Solid

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


class ElasticBond(ForceTerm):
    """Linear springs between boundary facets of a solid and a plate: traction = gap / compliance.

    The plate moves by nodal displacements U; `pull` gives the dead forces of that movement, and
    `forces` the springs' forces on the solid at U = 0.

    Attributes:
        stiffness: of the springs, (unknowns, unknowns) [N/m].
    """

    def __init__(self, solid: Solid, facets: Indices, compliance: float) -> None:
        """Assemble the springs.

        Args:
            solid: the body.
            facets: its bonded boundary facets.
            compliance: gap per traction [m/Pa], above zero.
        """
        faces = skfem.FacetBasis(solid.mesh, solid.basis.elem, facets=facets, intorder=4)
        scalar = csc_array(skfem.asm(mass, faces)) / compliance
        rest = csc_array((solid.multipliers, solid.multipliers))
        springs = kron(scalar, eye_array(solid.dim))
        self.stiffness = csc_array(block_array([[springs, None], [None, rest]]))

    def pull(self, moved: Array) -> Array:
        """Dead forces (unknowns,) of a plate that moves by U (unknowns,)."""
        return np.asarray(self.stiffness @ moved)

    def energy(self, gap: Array) -> float:
        """Energy of the springs at the nodal gaps U - u (unknowns,) [J]."""
        return 0.5 * float(gap @ (self.stiffness @ gap))

    def forces(self, x: Array) -> Array:
        """Spring forces (n,) on the unknowns x (n,), at U = 0."""
        return np.asarray(self.stiffness @ x)

    def linearise(self, x: Array) -> tuple[Array, csc_array]:
        """Spring forces (n,) at the unknowns x (n,), and the stiffness (n, n)."""
        return self.forces(x), self.stiffness
