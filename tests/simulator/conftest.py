"""Set-up shared by the tests of the simulator."""

import pytest

from eitskin.geometry import SensorDesign
from eitskin.simulator import Simulator


@pytest.fixture(scope="session")
def sim() -> Simulator:
    """The reference sensor on a fast mesh."""
    return Simulator(SensorDesign.reference(), resolution="fast")
