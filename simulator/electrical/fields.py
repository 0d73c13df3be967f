"""Potentials and current densities of all electrodes in one scene, from one factorisation."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eitskin.simulator.electrical.forward_model import ForwardModel
from eitskin.simulator.layer.deformed_layer import DeformedLayer

Array = NDArray[np.float64]
Numbers = NDArray[np.inexact]


@dataclass(frozen=True, slots=True, eq=False)
class Fields:
    """Potentials and current densities per unit current into each electrode.

    The current leaves through all electrodes in equal parts, so that the difference of two
    electrodes' entries belongs to a drive pair. Potentials are relative to the mean of the
    electrode potentials.

    Attributes:
        potentials: at the points of the mesh, (points, electrodes) [V/A].
        electrode_potentials: impedance matrix, (electrodes, electrodes): potential of the first
            electrode per current into the second [V/A].
        current_densities: mean in each cell of the flat body, (cells, 3, electrodes) [1/m2].
    """

    potentials: Numbers
    electrode_potentials: Numbers
    current_densities: Numbers


def fields_in(model: ForwardModel, layer: DeformedLayer) -> Fields:
    """Fields of the model with a deformed layer, solved once for all electrodes."""
    conductivity = None if layer.deformation is None else layer.conductivity
    area_ratio = None if layer.deformation is None else layer.area_ratio
    u, U = model.element_potentials(conductivity, area_ratio)
    mean_potential = U.mean(axis=0)
    gradients = model.assembly.cell_gradients(u)
    flux = -_product(layer.entries(model.assembly.points), gradients)
    weights = model.assembly.cell_weights
    mean = np.einsum("cq,cqae->cae", weights, flux) / weights.sum(axis=1)[:, None, None]
    return Fields(model.at_points(u) - mean_potential, U - mean_potential, mean)


def _product(entries: Array, vectors: Numbers) -> Numbers:
    """Products of tensors, entries xx, yy, zz, xy, xz, yz (..., 6), with vectors (..., 3, k)."""
    tensors = entries[..., [[0, 3, 4], [3, 1, 5], [4, 5, 2]]]
    product: Numbers = tensors @ vectors
    return product
