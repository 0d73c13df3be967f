"""Linear model of a sensor: measurements, and their derivatives by the conductivity of pixels."""

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eitskin.geometry.deformation.fixtures import Bend, Hinge
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.protocol import Protocol

if TYPE_CHECKING:
    from eitskin.simulator.electrical.resolution import Discretisation, Resolution

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class LinearModel:
    """Measurements of the untouched sensor to first order in the conductivity of pixels.

    Attributes:
        impedance: at the nominal conductivity (measurements,) [ohm].
        sensitivity: derivative by the logarithm of each pixel's conductivity, (measurements,
            pixels) [ohm]; all pixels of the bounding box, row by row.
    """

    impedance: NDArray[np.inexact]
    sensitivity: NDArray[np.inexact]

    @property
    def relative(self) -> Array:
        """Relative Jacobian (measurements, pixels), d log R / d log sigma, dimensionless."""
        return relative_jacobian(self.sensitivity, self.impedance, 1.0)


def linear_model(
    design: SensorDesign,
    protocol: Protocol,
    pixels: tuple[int, int],
    angle_deg: float = 0.0,
    hinge: Hinge | None = None,
    resolution: "Resolution | Discretisation" = "fast",
) -> LinearModel:
    """Linear model of the untouched nominal sensor at a bend.

    Pixels lie on the flat sensor, row by row, and move with the gel. In these coordinates a bent
    gel has the pulled-back conductivity K = J F^-1 sigma F^-T, and
    dR = - int grad u_drive . K grad u_sense d sigma / sigma (adjoint method, Geselowitz 1971).

    Args:
        design: the sensor.
        protocol: the measurements.
        pixels: number of rows along y and of columns along x.
        angle_deg: bend angle [deg].
        hinge: the fixture; the default fixture when omitted.
        resolution: of the forward model.

    Raises:
        ConfigurationError: for a bend that the fixture or the sensor does not allow.
    """
    return _linear_model(design, protocol, pixels, angle_deg, hinge, resolution)


@lru_cache(maxsize=4)  # several pipelines and pictures are made for one sensor
def _linear_model(
    design: SensorDesign,
    protocol: Protocol,
    pixels: tuple[int, int],
    angle_deg: float,
    hinge: Hinge | None,
    resolution: "Resolution | Discretisation",
) -> LinearModel:
    """Linear model of a design; all callers share the arrays."""
    # A trained pipeline runs without: these take longer to import than all the rest of it.
    from eitskin.simulator.scene.scene import Scene
    from eitskin.simulator.simulator import Simulator

    simulator = Simulator(design, resolution, hinge, protocol)
    layer, model = simulator.deformed_layer(Scene(Bend(angle_deg))), simulator.model
    sensitivity = model.sensitivity(
        protocol, layer.conductivity, pixels, layer.area_ratio, along=layer.conductivity
    )
    impedance = protocol.measure(model.impedance(layer.conductivity, layer.area_ratio))
    for values in (sensitivity, impedance):
        values.flags.writeable = False
    return LinearModel(impedance, sensitivity)


def relative_jacobian(sensitivity: ArrayLike, impedance: ArrayLike, conductivity: float) -> Array:
    """Relative Jacobian (measurements, pixels), d log R / d log sigma, dimensionless.

    Args:
        sensitivity: dR/dsigma (measurements, pixels) [ohm per S/m].
        impedance: of the same sensor (measurements,) [ohm].
        conductivity: at which the sensitivity was taken [S/m].
    """
    R = np.real(np.asarray(impedance))
    J: Array = conductivity * np.real(np.asarray(sensitivity)).astype(float) / R[:, None]
    return J
