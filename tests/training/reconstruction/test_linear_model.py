"""What measurements of a bent sensor make of a change of its gel."""

import numpy as np
import pytest

from eitskin.errors import ConfigurationError
from eitskin.geometry import Bend, SensorDesign
from eitskin.geometry.meshing.hexahedra import Grading
from eitskin.simulator import Protocol, Scene, Simulator
from eitskin.training.method.input_spec import InputSpec
from eitskin.training.reconstruction.linear_model import linear_model

COARSE = ((2, 1), Grading(finest=4e-3, coarsest=8e-3, growth=1.0, layers=1))
PROTOCOL = Protocol(((0, 1, 0, 1), (2, 6, 2, 6), (0, 4, 1, 3)), 8)
LAYOUT = InputSpec(SensorDesign.reference(), PROTOCOL, 40e3, np.ones(3))


def nominal_jacobian(layout, angle_deg, resolution):
    spec = (layout.design, layout.protocol, layout.pixels, angle_deg)
    return linear_model(*spec, resolution=resolution).relative


@pytest.mark.slow
@pytest.mark.parametrize("angle_deg", [0.0, 40.0])
def test_agrees_with_central_differences_at_any_angle(angle_deg):
    """The relative change of every measurement, for a gel that conducts a little more somewhere."""
    simulator = Simulator(LAYOUT.design, COARSE, protocol=PROTOCOL)
    setting = simulator.deformed_layer(Scene(Bend(angle_deg)))

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
    J = nominal_jacobian(LAYOUT, angle_deg, resolution=COARSE)
    assert J.shape == (3, rows * columns)
    expected = (logarithms(1e-4) - logarithms(-1e-4)) / 2e-4
    # The difference that is left is that of pixels and a smooth change.
    assert J @ change(*np.meshgrid(x, y)).ravel() == pytest.approx(expected, rel=5e-3)


@pytest.mark.slow
def test_bending_changes_what_is_felt_and_where():
    flat, bent = (nominal_jacobian(LAYOUT, angle, resolution=COARSE) for angle in (0.0, 40.0))
    assert 0.02 < np.linalg.norm(bent - flat) / np.linalg.norm(flat) < 0.5
    middle = np.abs(np.linspace(0, 0.15, flat.shape[1] // 32) - 0.075) < 0.02
    moved = np.abs(bent - flat).sum(axis=0).reshape(32, -1).sum(axis=0)
    assert moved[middle].mean() > 2 * moved[~middle].mean()


def test_a_bend_that_is_beyond_the_hinge_is_refused():
    with pytest.raises(ConfigurationError):
        nominal_jacobian(LAYOUT, 400.0, resolution=COARSE)
