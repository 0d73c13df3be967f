"""Relative Jacobian of the nominal sensor, flat or bent, by the adjoint method."""

import numpy as np
from numpy.typing import NDArray

from eitskin.geometry.deformation.fixtures import Bend, Hinge
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
    simulator = Simulator(layout.design, resolution, hinge, layout.protocol)
    setting, model = simulator.deformed_layer(Scene(Bend(angle_deg))), simulator.model
    electrical = (setting.conductivity, setting.area_ratio)
    sensitivity = model.sensitivity(
        layout.protocol, electrical[0], layout.pixels, electrical[1], along=setting.conductivity
    )
    impedance = layout.protocol.measure(model.impedance(*electrical))
    return relative_jacobian(sensitivity, impedance, 1.0)
