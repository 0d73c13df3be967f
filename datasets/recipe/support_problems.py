"""Checks of the supports in a recipe."""

import dataclasses
from collections.abc import Iterable, Iterator

from eitskin.errors import ConfigurationError
from eitskin.geometry.deformation.fixtures import Fixture
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.geometry.design.support import Support
from eitskin.simulator.scene.support_check import require_base, require_bendable
from eitskin.simulator.scene.touch import Touch


def support_problems(
    support: Support | None,
    sensor: SensorDesign,
    fixture: Fixture,
    bent: bool,
    positions: Iterable[tuple[float, float]],
) -> Iterator[str]:
    """Reason why the support does not allow bends or presses of a recipe, in a sentence.

    Args:
        support: of the scenes; the sensor's when omitted.
        sensor: nominal design.
        fixture: that bends the sensor.
        bent: whether the scenes are bent.
        positions: pressed (x, y) [m].
    """
    try:
        supported = sensor if support is None else dataclasses.replace(sensor, support=support)
        if bent:
            require_bendable(supported.support, fixture)
        require_base((Touch(x, y) for x, y in positions), supported)
    except ConfigurationError as error:
        yield str(error)
