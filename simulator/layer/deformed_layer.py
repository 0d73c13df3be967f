"""Deformed layer: pulled-back conductivity and electrode area ratio."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eitskin.geometry.deformation.kinematics import Deformation, area_ratio, pulled_back_entries
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.simulator.mechanics.layer_stack import Piezoresistivity

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class DeformedLayer:
    """Deformed layer in flat coordinates.

    Attributes:
        design: of the sensor.
        deformation: of the flat layer; None where the layer stays flat.
        piezoresistivity: of the gel.
        mean_stress: function of flat points, positive in tension [Pa]; zero when omitted.
    """

    design: SensorDesign
    deformation: Deformation | None
    piezoresistivity: Piezoresistivity
    mean_stress: Callable[[Array], Array] | None = None

    def entries(self, x: Array) -> Array:
        """Entries xx, yy, zz, xy, xz, yz of J F^-1 sigma F^-T [S/m], (..., 6).

        At flat points x (..., 3) [m].
        """
        sigma = self.design.conductivity_at(x)
        if self.deformation is None:
            unit: Array = sigma[..., None] * np.array([1.0, 1.0, 1.0, 0.0, 0.0, 0.0])
            return unit
        F = self.deformation.gradient(x)
        if self.piezoresistivity != Piezoresistivity():
            stress = self.mean_stress(x) if self.mean_stress else 0.0
            sigma = sigma * self.piezoresistivity.factor(np.linalg.det(F), stress)
        found: Array = sigma[..., None] * pulled_back_entries(F)
        return found

    def conductivity(self, x: Array) -> Array:
        """Tensors J F^-1 sigma F^-T [S/m], (..., 3, 3), at flat points (..., 3) [m]."""
        return self.entries(x)[..., [[0, 3, 4], [3, 1, 5], [4, 5, 2]]]

    def area_ratio(self, x: Array, normal: Array) -> Array:
        """Deformed over flat area of surfaces at flat points with unit normals (..., 3), (...)."""
        if self.deformation is None:
            return np.ones(x.shape[:-1])
        return area_ratio(self.deformation.gradient(x), normal)
