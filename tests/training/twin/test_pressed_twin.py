"""Presses on a twin from its files, against the simulator with the twin's instrument."""

import dataclasses

import numpy as np
import pytest

from eitskin.config import write_toml
from eitskin.errors import ConfigurationError
from eitskin.geometry import SensorDesign
from eitskin.geometry.deformation.fixtures import Bend, Clamp
from eitskin.protocol import Protocol
from eitskin.simulator import Scene, Simulator, Touch
from eitskin.simulator.instrument.instrument import Instrument
from eitskin.simulator.instrument.meter import FourTerminalMeter
from eitskin.simulator.mechanics.layer_stack import Mechanics
from eitskin.training import PressedTwin

PROTOCOL = Protocol.pairwise(8)
METER = FourTerminalMeter(sink=2e-4, common_mode=0.01, scale=3.0)


@pytest.fixture
def folder(tmp_path):
    reference = SensorDesign.reference()
    first = dataclasses.replace(reference.electrodes[0], contact_impedance=2e-3)
    dataclasses.replace(reference, electrodes=(first, *reference.electrodes[1:])).to_toml(
        tmp_path / "design.toml"
    )
    write_toml(Clamp(), tmp_path / "fixture.toml")
    write_toml(Mechanics(), tmp_path / "mechanics.toml")
    Instrument(snr_db=70.0, meter=METER).to_toml(tmp_path / "rig.toml")
    return tmp_path


@pytest.mark.slow
@pytest.mark.parametrize("angle_deg", [0.0, 20.0])
def test_changes_are_those_of_the_simulator_with_the_twins_instrument(folder, angle_deg):
    touches = np.array([[0.03, 0.02, 6.0], [0.10, 0.04, 9.0]])
    found = PressedTwin.read(folder, PROTOCOL).changes(touches, angle_deg, 0.0075000001)
    simulator = Simulator(SensorDesign.from_toml(folder / "design.toml"), "coarse")
    bend = Bend(angle_deg)
    scenes = [Scene(bend), *(Scene(bend, (Touch(x, y, force),)) for x, y, force in touches)]
    Z = np.real([simulator.impedance_matrix(scene) for scene in scenes])
    reading, _ = METER.reading(METER.transfer_impedance(Z, PROTOCOL))
    logs = np.log(np.abs(reading))
    np.testing.assert_allclose(found, logs[1:] - logs[0], atol=3e-4 * np.abs(found).max())


def test_what_is_no_twin_of_the_pipelines_sensor_is_refused(folder):
    twin = PressedTwin.read(folder, PROTOCOL)
    assert twin.inside(np.array([[0.03, 0.02], [0.03, 0.07]])).tolist() == [True, False]
    with pytest.raises(ConfigurationError, match="16"):
        PressedTwin.read(folder, Protocol.pairwise(16))
    (folder / "rig.toml").unlink()
    with pytest.raises(ConfigurationError, match=r"rig\.toml"):
        PressedTwin.read(folder, PROTOCOL)
