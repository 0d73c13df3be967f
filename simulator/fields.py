"""Potentials and currents of all electrodes in one scene, from one solution."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eitskin.geometry import Mesh
from eitskin.simulator.assembly import Assembly
from eitskin.simulator.forward import ForwardModel
from eitskin.simulator.setting import Setting

Array = NDArray[np.float64]
Numbers = NDArray[np.inexact]


@dataclass(frozen=True, slots=True, eq=False)
class Fields:
    """What a unit current into each electrode does; it leaves through all electrodes alike.

    Differences of two electrodes' entries are those of a drive pair. The potentials of the
    electrodes have zero mean, and all potentials count from there.

    Attributes:
        potentials: at the points of the mesh (points, electrodes) [V/A].
        electrode_potentials: (electrodes, electrodes), of the first by a current into the second
            [V/A]; the impedance matrix.
        current_densities: mean in each cell of the flat body (cells, 3, electrodes) [A/m2 per A].
    """

    potentials: Numbers
    electrode_potentials: Numbers
    current_densities: Numbers


def fields_in(model: ForwardModel, setting: Setting) -> Fields:
    """Solve the model in a setting, once for all electrodes."""
    conductivity = None if setting.deformation is None else setting.conductivity
    area_ratio = None if setting.deformation is None else setting.area_ratio
    stiffness, system, w, U = model._solve(conductivity, area_ratio)
    u = model.assembly.space.in_elements(w + system.lift @ U, stiffness.inner)
    level = U.mean(axis=0)
    gradients = model.assembly.cell_gradients(u)
    flux = -_times(setting.entries(model.assembly.points), gradients)
    weights = model.assembly.cell_weights
    mean = np.einsum("cq,cqae->cae", weights, flux) / weights.sum(axis=1)[:, None, None]
    return Fields(_at_points(model.assembly, model.mesh, u) - level, U - level, mean)


def _at_points(assembly: Assembly, mesh: Mesh, u: Numbers) -> Numbers:
    """Potentials (elements, functions, k) at the points of the mesh, (points, k)."""
    space = assembly.space
    elements = np.arange(len(mesh.cells)) // space.element.cells
    X = space.reference(elements, mesh.points[mesh.cells])
    values = np.einsum("ick,cie->cke", space.element.values(X), u[elements], optimize=True)
    at_points = np.empty((len(mesh.points), u.shape[-1]), dtype=u.dtype)
    at_points[mesh.cells] = values
    return at_points


def _times(entries: Array, vectors: Numbers) -> Numbers:
    """Tensors of entries xx, yy, zz, xy, xz, yz (..., 6) times vectors (..., 3, k)."""
    tensors = entries[..., [[0, 3, 4], [3, 1, 5], [4, 5, 2]]]
    product: Numbers = tensors @ vectors
    return product
