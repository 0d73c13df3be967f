"""Checks of the supports in a recipe."""

import dataclasses
from collections.abc import Iterator

from eitskin.errors import ConfigurationError
from eitskin.geometry.deformation.fixtures import Fixture
from eitskin.geometry.design.sensor import SensorDesign, Support, require_fit
from eitskin.simulator.scene.scene import require_bendable


def support_problems(
    support: Support | None,
    sensor: SensorDesign,
    fixture: Fixture,
    bent: bool,
) -> Iterator[str]:
    """Reason why the support does not allow the bends of a recipe, in a sentence.

    Args:
        support: of the scenes; the sensor's when omitted.
        sensor: nominal design.
        fixture: that bends the sensor.
        bent: whether the scenes are bent.
    """
    try:
        supported = sensor if support is None else dataclasses.replace(sensor, support=support)
        if bent:
            require_bendable(supported.support, fixture)
        require_fit(supported.support, supported.outline)
    except ConfigurationError as error:
        yield str(error)
