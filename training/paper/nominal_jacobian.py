"""Relative Jacobian of the nominal sensor, flat or bent, by the adjoint method."""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from eitskin.geometry.deformation.fixtures import Bend, Hinge
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.protocol import Protocol
from eitskin.simulator.electrical.resolution import Discretisation, Resolution
from eitskin.simulator.scene.scene import Scene
from eitskin.simulator.simulator import Simulator
from eitskin.training.method.input_spec import InputSpec
from eitskin.training.paper.reconstruction import relative_jacobian


def nominal_jacobian(
    layout: InputSpec,
    angle_deg: float = 0.0,
    hinge: Hinge | None = None,
    resolution: Resolution | Discretisation = "fast",
) -> NDArray[np.float64]:
    """Relative Jacobian of the nominal sensor at a bend (measurements, pixels), dimensionless.

    Derivative of each log resistance of the untouched, bent sensor by the log conductivity of the
    gel in each of the layout's pixels. Pixels lie on the flat sensor, row by row, and move with
    the gel. In these coordinates a bent gel has the pulled-back conductivity
    K = J F^-1 sigma F^-T, and dR = - int grad u_drive . K grad u_sense d sigma / sigma (adjoint
    method, Geselowitz 1971).

    Args:
        layout: sensor, measurements and pixels.
        angle_deg: bend angle [deg].
        hinge: the fixture; the default hinge when omitted.
        resolution: of the forward model.

    Raises:
        ConfigurationError: for a bend that the hinge or the sensor does not allow.
    """
    return _jacobian(layout.design, layout.protocol, layout.pixels, angle_deg, hinge, resolution)


@lru_cache(maxsize=4)  # several pipelines are trained for one sensor
def _jacobian(
    design: SensorDesign,
    protocol: Protocol,
    pixels: tuple[int, int],
    angle_deg: float,
    hinge: Hinge | None,
    resolution: Resolution | Discretisation,
) -> NDArray[np.float64]:
    """Relative Jacobian of a design."""
    simulator = Simulator(design, resolution, hinge, protocol)
    setting, model = simulator.deformed_layer(Scene(Bend(angle_deg))), simulator.model
    electrical = (setting.conductivity, setting.area_ratio)
    sensitivity = model.sensitivity(
        protocol, electrical[0], pixels, electrical[1], along=setting.conductivity
    )
    impedance = protocol.measure(model.impedance(*electrical))
    found = relative_jacobian(sensitivity, impedance, 1.0)
    found.flags.writeable = False  # all callers share the array
    return found
