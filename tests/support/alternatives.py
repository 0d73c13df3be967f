"""Plain twins of the optimised paths: slow, short, and written straight from the equations."""

from collections.abc import Callable

import numpy as np
import skfem
from numpy.typing import NDArray

from eitskin.simulator.mechanics.mixed_solid import Solid

Array = NDArray[np.float64]


def pulled_back(F: Array) -> Array:
    """Pull-back J F^-1 F^-T of a unit conductivity, (..., 3, 3)."""
    S = np.linalg.inv(np.swapaxes(F, -1, -2) @ F)
    return np.linalg.det(F)[..., None, None] * 0.5 * (S + np.swapaxes(S, -1, -2))


def traction_forces(solid: Solid, facets: Array, traction: Callable[[Array], Array]) -> Array:
    """Nodal forces (unknowns,) of dead tractions on boundary facets of the undeformed mesh.

    `traction` gives [Pa], (dim, ...), at points (dim, ...) [m].
    """
    rim = skfem.FacetBasis(solid.mesh, solid.basis.elem, facets=facets, intorder=5)
    X = np.asarray(rim.global_coordinates())
    weights = rim.dx * (2.0 * np.pi * X[0] if solid.kinematics == "axisymmetric" else 1.0)
    loads = np.zeros((len(solid.nodes), solid.dim))
    for a, (function,) in enumerate(rim.basis):
        parts = np.sum(traction(X) * np.asarray(function) * weights, axis=-1)
        np.add.at(loads, rim.element_dofs[a], parts.T)
    return np.concatenate([loads.ravel(), np.zeros(solid.unknowns - loads.size)])
