"""Mirror symmetries: which exist, and that mirrored sensors measure the same."""

from dataclasses import replace

import numpy as np
import pytest

from eitskin.geometry import Bend, Polygon, SensorDesign
from eitskin.simulator import Protocol, Scene, Simulator, Touch
from eitskin.training.method.input_spec import mirrors

NONE, ACROSS_X, ACROSS_Y, TURNED = (False, False), (True, False), (False, True), (True, True)
PAIRWISE = Protocol.pairwise(8)


def flips(design, protocol=PAIRWISE):
    return [mirror.flips for mirror in mirrors(design, protocol)]


def with_electrode(number, **changes):
    design = SensorDesign.reference()
    electrodes = list(design.electrodes)
    electrodes[number] = replace(electrodes[number], **changes)
    return replace(design, electrodes=tuple(electrodes))


def test_touch_in_the_mirror_measures_what_the_mirror_says():
    """Agreement to rounding, because the mesh has the sensor's symmetries."""
    design, protocol = SensorDesign.reference(), Protocol.opposite(8)
    simulator = Simulator(design, "coarse", protocol=protocol)

    def magnitudes(x, y):
        scene = Scene(Bend(20.0), (Touch(float(x), float(y), 8.0),))
        return np.abs(simulator.measure(scene).impedance)

    here = magnitudes(0.045, 0.021)
    for mirror in mirrors(design, protocol)[1:]:
        there = magnitudes(*mirror.places(np.float64(0.045), np.float64(0.021)))
        assert not np.allclose(there, here, rtol=1e-4)
        np.testing.assert_allclose(there, here[mirror.order], rtol=1e-8)


CORNERS = ((0.0, 0.0), (0.15, 0.0), (0.15, 0.06), (0.0, 0.06))
CUT = ((0.0, 0.0), (0.15, 0.0), (0.15, 0.048), (0.14, 0.06), (0.0, 0.06))
REFERENCE = SensorDesign.reference()


@pytest.mark.parametrize(
    ("design", "kept"),
    [
        (with_electrode(0, x=0.025), [NONE]),
        (with_electrode(0, contact_impedance=2e-3), [NONE]),
        (with_electrode(0, width=0.006), [NONE]),
        (with_electrode(0, height=0.003), [NONE]),
        (with_electrode(1, contact_impedance=2e-3), [NONE, ACROSS_X]),
        (with_electrode(3, contact_impedance=2e-3), [NONE, ACROSS_Y]),
        (replace(REFERENCE, outline=Polygon(CORNERS)), [NONE, ACROSS_X, ACROSS_Y, TURNED]),
        (replace(REFERENCE, outline=Polygon(CUT)), [NONE]),
        (replace(REFERENCE, electrodes=REFERENCE.electrodes[:4]), [NONE]),
    ],
)
def test_outline_and_electrodes_must_have_images(design, kept):
    assert flips(design, Protocol.pairwise(len(design.electrodes))) == kept
