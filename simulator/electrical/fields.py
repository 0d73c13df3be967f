"""Potentials and currents of all electrodes in one scene, from one solution."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eitskin.simulator.electrical.forward_model import ForwardModel
from eitskin.simulator.layer.deformed_layer import DeformedLayer

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


def fields_in(model: ForwardModel, layer: DeformedLayer) -> Fields:
    """Solve the model in a layer, once for all electrodes."""
    conductivity = None if layer.deformation is None else layer.conductivity
    area_ratio = None if layer.deformation is None else layer.area_ratio
    u, U = model.element_potentials(conductivity, area_ratio)
    level = U.mean(axis=0)
    gradients = model.assembly.cell_gradients(u)
    flux = -_times(layer.entries(model.assembly.points), gradients)
    weights = model.assembly.cell_weights
    mean = np.einsum("cq,cqae->cae", weights, flux) / weights.sum(axis=1)[:, None, None]
    return Fields(model.at_points(u) - level, U - level, mean)


def _times(entries: Array, vectors: Numbers) -> Numbers:
    """Tensors of entries xx, yy, zz, xy, xz, yz (..., 6) times vectors (..., 3, k)."""
    tensors = entries[..., [[0, 3, 4], [3, 1, 5], [4, 5, 2]]]
    product: Numbers = tensors @ vectors
    return product
