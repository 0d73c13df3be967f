"""Numbers at the ends of what a float holds: finite results, or one error of eitskin."""

import dataclasses

import numpy as np
import pytest

from eitskin.bounds import require_positive
from eitskin.errors import ConfigurationError, DataError
from eitskin.geometry import SensorDesign
from eitskin.hardware.diagnosis.reading_check import check_readings
from eitskin.hardware.diagnosis.sensor_check import check_sensor
from eitskin.simulator import Frame, Protocol
from eitskin.training.method.input_spec import usable_values
from eitskin.training.method.known_frames import FrameLabel

PROTOCOL = Protocol.pairwise(8)
FLAT = np.linspace(400.0, 820.0, 28)
EXTREMES = (1e300, -1e308, 1e-300, 5e-324, 0.0, float("nan"), float("inf"))


def frames(value):
    """Sixteen frames whose channels are in turn as they should be, and extreme."""
    odd = np.arange(28) % 2 == 1
    return [
        Frame(np.where(odd ^ bool(number % 2), value, FLAT + 0j), PROTOCOL, 0.1 * number)
        for number in range(16)
    ]


def test_conductivities_that_lose_all_digits_are_refused():
    for value in (5e-324, 1e-310, 1e308, -1.0, float("nan")):
        with pytest.raises(ConfigurationError, match="S/m"):
            dataclasses.replace(SensorDesign.reference(), conductivity=value)
    for value in (1e-15, 1e15):
        require_positive("conductivity", value, "S/m")


def test_readings_that_alternate_with_nonsense_are_checked_without_noise(recwarn):
    for value in EXTREMES:
        assert check_sensor(frames(value), FLAT).findings
        check_readings(np.array([frame.impedance for frame in frames(value)]), PROTOCOL)
    assert not recwarn.list


def test_expected_values_are_of_a_sensor():
    for factor in (1e300, 1e-300):
        with pytest.raises(ConfigurationError):
            check_sensor(frames(FLAT), FLAT * factor)


def test_readings_beyond_all_sensors_are_left_out():
    for value in EXTREMES:
        found, problems = usable_values(frames(value)[0])
        assert np.isnan(found).sum() == len(problems) == 14


def test_angles_are_those_of_a_bend():
    for angle in (1e300, 361.0, float("nan"), float("-inf")):
        with pytest.raises(DataError, match="360"):
            FrameLabel(angle)
