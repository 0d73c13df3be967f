"""Deformed layer: pulled-back conductivity and electrode area ratio."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import reduce

import numpy as np
from numpy.typing import NDArray

from eitskin.compiled import compiled_kernels
from eitskin.geometry.deformation.electrode_shift import ElectrodeShift
from eitskin.geometry.deformation.kinematics import (
    WHOLE_TENSOR,
    Deformation,
    area_ratio,
    pulled_back_entries,
)
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.simulator.deformation.dents import KERNELS
from eitskin.simulator.mechanics.layer_stack import Piezoresistivity

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class DeformedLayer:
    """Deformed layer in flat coordinates.

    Attributes:
        design: design of the sensor.
        deformation: deformation of the flat layer; None where the layer stays flat.
        piezoresistivity: piezoresistivity of the gel.
        mean_stress: function of flat points, positive in tension [Pa]; zero when omitted.
        shift: map from a nominal sensor, on whose points all else is then given; none when omitted.
    """

    design: SensorDesign
    deformation: Deformation | None
    piezoresistivity: Piezoresistivity
    mean_stress: Callable[[Array], Array] | None = None
    shift: ElectrodeShift | None = None

    @property
    def is_flat(self) -> bool:
        """Whether neither the sensor is deformed nor its electrodes are shifted."""
        return self.deformation is None and self.shift is None

    @property
    def contact_impedance(self) -> NDArray[np.inexact]:
        """Contact impedances [ohm m2], (electrodes,); complex where any electrode's is."""
        return self.design.contact_impedance

    def entries(self, x: Array) -> NDArray[np.inexact]:
        """Entries xx, yy, zz, xy, xz, yz of J F^-1 sigma F^-T [S/m], (..., 6).

        At flat points x (..., 3) [m].
        """
        own = x if self.shift is None else self.shift.positions(x)
        return self._pull_back(own, self._gradients(x))

    def entries_and_ratio(
        self, points: Array, cells: tuple[int, int], normals: Array
    ) -> tuple[NDArray[np.inexact], Array]:
        """`entries` at points of cells (cells, q) and `area_ratio` at those of surfaces.

        Args:
            points: points of the cells, then of the surfaces, (n, 3) [m].
            cells: number of cells and of points in each.
            normals: unit normals of the surfaces, (surfaces, 1, 3).
        """
        own = points if self.shift is None else self.shift.positions(points)
        count, factors = cells[0] * cells[1], self._gradients(points)
        entries = self._pull_back(own[:count], [F[:count] for F in factors])
        faces = [F[count:].reshape(len(normals), -1, 3, 3) for F in factors]
        shape = len(normals), (len(points) - count) // len(normals)
        return entries.reshape(*cells, 6), _ratio(faces, normals, shape)

    def _pull_back(self, own: Array, factors: list[Array]) -> NDArray[np.inexact]:
        """Entries as of `entries` at points of this sensor, from `_gradients`."""
        sigma = self.design.evaluate_conductivity(own)
        if not factors:
            return np.asarray(sigma[..., None] * np.array([1.0, 1.0, 1.0, 0.0, 0.0, 0.0]))
        if self.deformation is not None and self.piezoresistivity != Piezoresistivity():
            stress = self.mean_stress(own) if self.mean_stress else 0.0
            sigma = sigma * self.piezoresistivity.factor(np.linalg.det(factors[0]), stress)
        kernels = compiled_kernels(KERNELS)
        entries = np.empty((*sigma.shape, 6), dtype=sigma.dtype)
        if kernels is not None and np.isrealobj(sigma):
            first, *shift = (np.ascontiguousarray(F).reshape(-1, 9) for F in factors)
            after = shift[0] if shift else np.empty((0, 9))
            if not kernels.pull_back(first, after, sigma.ravel(), entries.reshape(-1, 6)):
                return entries
        np.multiply(sigma[..., None], pulled_back_entries(reduce(np.matmul, factors)), out=entries)
        return entries

    def _gradients(self, x: Array) -> list[Array]:
        """Gradients (..., 3, 3) whose product is that of the map from nominal to deformed points.

        That of the deformation comes before that of the shift, where there are such.
        """
        factors = [] if self.shift is None else [self.shift.gradient(x)]
        if self.deformation is not None:
            own = x if self.shift is None else self.shift.positions(x)
            factors.insert(0, self.deformation.gradient(own))
        return factors

    def conductivity(self, x: Array) -> NDArray[np.inexact]:
        """Tensors J F^-1 sigma F^-T [S/m], (..., 3, 3), at flat points (..., 3) [m]."""
        return np.asarray(self.entries(x)[..., WHOLE_TENSOR])

    def area_ratio(self, x: Array, normal: Array) -> Array:
        """Deformed over flat area of surfaces at flat points with unit normals (..., 3), (...)."""
        return _ratio(self._gradients(x), normal, x.shape[:-1])


def _ratio(factors: list[Array], normal: Array, shape: tuple[int, ...]) -> Array:
    """Area ratio by the product of gradients."""
    return area_ratio(reduce(np.matmul, factors), normal) if factors else np.ones(shape)
