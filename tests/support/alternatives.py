"""Plain twins of the optimised paths: slow, short, and written straight from the equations."""

from collections.abc import Callable

import numpy as np
import skfem
from numpy.typing import NDArray
from skfem.helpers import dot, grad
from skfem.models.poisson import mass

from eitskin.geometry import Mesh
from eitskin.simulator.mechanics.mixed_solid import Solid

Array = NDArray[np.float64]


def plain_impedance(
    mesh: Mesh,
    contact_impedance: float,
    conductivity: Callable[[Array], Array] = lambda x: np.broadcast_to(
        np.eye(3)[:, :, None, None], (3, 3, *x.shape[1:])
    ),
    points: Array | None = None,
) -> Array:
    """Z of the complete electrode model by scikit-fem's own forms on trilinear hexahedra.

    `conductivity` gives tensors (3, 3, cells, q) at x (3, cells, q); `points` moves the mesh. The
    whole system of potentials, electrode potentials and the condition that they add up to zero
    is solved at once.
    """
    places = mesh.points if points is None else points
    reference = skfem.refdom.RefHex.p.T
    vtk = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]]
    order = [vtk.index(corner) for corner in reference.astype(int).tolist()]
    cells = np.ascontiguousarray(mesh.cells[:, order].T)
    grid = skfem.MeshHex(np.ascontiguousarray(places.T), cells, sort_t=False)
    element = skfem.ElementHex1()
    basis = skfem.CellBasis(grid, element, intorder=2)

    @skfem.BilinearForm
    def conduction(u, v, w):
        sigma = conductivity(np.asarray(w.x))
        return dot(np.einsum("ij...,j...->i...", sigma, np.asarray(grad(u))), grad(v))

    @skfem.LinearForm
    def one(v, w):  # noqa: ARG001
        return v

    n, count = basis.N, len(mesh.electrode_facets)
    K = np.zeros((n + count + 1, n + count + 1))
    K[:n, :n] = conduction.assemble(basis).toarray()
    known = {tuple(f): i for i, f in enumerate(np.sort(grid.facets.T, axis=1).tolist())}
    for e, facets in enumerate(mesh.electrode_facets):
        numbers = np.array([known[tuple(sorted(f))] for f in facets.tolist()])
        rim = skfem.FacetBasis(grid, element, facets=numbers, intorder=2)
        load = one.assemble(rim) / contact_impedance
        K[:n, :n] += mass.assemble(rim).toarray() / contact_impedance
        K[:n, n + e] = K[n + e, :n] = -load
        K[n + e, n + e] = load.sum()
    K[n : n + count, -1] = K[-1, n : n + count] = 1.0
    currents = np.zeros((n + count + 1, count))
    currents[n : n + count] = np.eye(count) - 1.0 / count
    Z: Array = np.linalg.solve(K, currents)[n : n + count]
    return Z


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
