"""What measurements make of a change of the gel."""

import numpy as np
import pytest

from eitskin.geometry import SensorDesign
from eitskin.geometry.meshing.mesh_design import Grading
from eitskin.simulator import Protocol, Scene, Simulator
from eitskin.training.method.input_spec import InputSpec
from eitskin.training.reconstruction.linear_model import linear_model

COARSE = ((2, 1), Grading(finest=4e-3, coarsest=8e-3, growth=1.0, layers=1))
PROTOCOL = Protocol(((0, 1, 0, 1), (2, 6, 2, 6), (0, 4, 1, 3)), 8)
LAYOUT = InputSpec(SensorDesign.reference(), PROTOCOL, 40e3, np.ones(3))


@pytest.mark.slow
def test_agrees_with_central_differences():
    """The relative change of every measurement, for a gel that conducts a little more somewhere."""
    simulator = Simulator(LAYOUT.design, COARSE, protocol=PROTOCOL)
    setting = simulator.deformed_layer(Scene())

    def change(x, y):
        return np.sin(20.0 * x) + np.cos(40.0 * y)

    def logarithms(share):
        def conductivity(x):
            factor = 1.0 + share * change(x[..., 0], x[..., 1])
            return setting.conductivity(x) * factor[..., None, None]

        impedance = simulator.model.impedance(conductivity, setting.area_ratio)
        return np.log(PROTOCOL.measure(impedance).real)

    rows, columns = LAYOUT.pixels
    y, x = ((np.arange(n) + 0.5) / n * size for n, size in ((rows, 0.06), (columns, 0.15)))
    J = linear_model(LAYOUT.design, PROTOCOL, LAYOUT.pixels, COARSE).relative
    assert J.shape == (3, rows * columns)
    expected = (logarithms(1e-4) - logarithms(-1e-4)) / 2e-4
    # The difference that is left is that of pixels and a smooth change.
    assert J @ change(*np.meshgrid(x, y)).ravel() == pytest.approx(expected, rel=5e-3)
