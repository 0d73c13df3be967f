"""What a sensor's measurements make of a small change of its gel, flat or bent."""

import numpy as np
from numpy.typing import NDArray

from eitskin.geometry.deformation.fixtures import Bend, Hinge
from eitskin.simulator.electrical.resolution import Discretisation, Resolution
from eitskin.simulator.scene.scene import Scene
from eitskin.simulator.simulator import Simulator
from eitskin.training.method.input_spec import InputSpec
from eitskin.training.paper.reconstruction import relative_jacobian


def sensitivity_at(
    layout: InputSpec,
    angle_deg: float = 0.0,
    hinge: Hinge | None = None,
    resolution: Resolution | Discretisation = "fast",
) -> NDArray[np.float64]:
    """Relative Jacobian of the nominal sensor at a bend (measurements, pixels), dimensionless.

    The change of each measurement, relative to the untouched sensor at that bend, per relative
    change of the gel's conductivity in each of the layout's pixels, by the adjoint method. Pixels
    lie on the flat sensor, row by row, and move with the gel. There a bent gel conducts like the
    tensor K = J F^-1 sigma F^-T, and dR = - int grad u_drive . K grad u_sense d sigma / sigma.

    Args:
        layout: names sensor, measurements and pixels.
        angle_deg: of the bend [deg].
        hinge: that bends it; the default one when omitted.
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
