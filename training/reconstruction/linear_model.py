"""Linear model of a sensor: measurements, and their derivatives by the conductivity of pixels."""

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from eitskin.geometry.design.sensor import SensorDesign
from eitskin.protocol import Protocol

if TYPE_CHECKING:
    from eitskin.simulator.electrical.forward_model import ForwardModel
    from eitskin.simulator.electrical.resolution import Discretisation, Resolution

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class LinearModel:
    """Measurements of the flat, untouched sensor to first order in the conductivity of pixels.

    Attributes:
        impedance: impedance at the nominal conductivity (measurements,) [ohm].
        sensitivity: derivative by the logarithm of each pixel's conductivity, (measurements,
            pixels) [ohm]; all pixels of the bounding box, row by row.
    """

    impedance: NDArray[np.inexact]
    sensitivity: NDArray[np.inexact]

    @property
    def relative(self) -> Array:
        """Relative Jacobian (measurements, pixels), d log R / d log sigma, dimensionless."""
        R = np.real(self.impedance)
        J: Array = np.real(self.sensitivity).astype(float) / R[:, None]
        return J


@lru_cache(maxsize=4)  # several pipelines and pictures are made for one sensor
def linear_model(
    design: "SensorDesign | ForwardModel",
    protocol: Protocol,
    pixels: tuple[int, int],
    resolution: "Resolution | Discretisation" = "fast",
) -> LinearModel:
    """Linear model of the nominal sensor; all callers share the arrays.

    dR = - int grad u_drive . sigma grad u_sense d sigma / sigma (adjoint method, Geselowitz 1971).

    Args:
        design: the sensor, or a model of it, whose resolution then counts.
        protocol: the measurements.
        pixels: number of rows along y and of columns along x.
        resolution: resolution of the forward model.
    """
    # A trained pipeline runs without: this takes longer to import than all the rest of it.
    from eitskin.simulator.electrical.sensor_impedances import model_family

    def conductivity(x: Array) -> Array:
        own = design if isinstance(design, SensorDesign) else design.design
        return np.asarray(own.evaluate_conductivity(x))[..., None, None] * np.eye(3)

    if isinstance(design, SensorDesign):
        model, sigma = model_family(design, resolution).base, conductivity
    else:
        model, sigma = design, None
    cells = np.asarray(getattr(model.design, "conductivity", 0.0))
    along = cells if cells.ndim == 1 else conductivity
    sensitivity = model.sensitivity(protocol, sigma, pixels, along=along)
    impedance = protocol.measure(model.impedance(sigma))
    for values in (sensitivity, impedance):
        values.flags.writeable = False
    return LinearModel(impedance, sensitivity)
