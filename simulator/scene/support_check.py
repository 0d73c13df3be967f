"""Refusal of scenes that their support does not allow."""

from collections.abc import Iterable

from eitskin.errors import ConfigurationError
from eitskin.geometry.deformation.fixtures import Fixture, FreeArc
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.geometry.design.support import Free, Plates, Support, require_fit
from eitskin.simulator.scene.touch import Touch

_SAME = 1e-9  # difference of spans that count as equal [m]


def require_bendable(support: Support, fixture: Fixture) -> None:
    """Raise ConfigurationError unless the fixture can bend a sensor on the support."""
    if isinstance(support, Free):
        raise ConfigurationError(
            "a free membrane is held at its rim and can be neither bent, rolled nor twisted; leave "
            "these out, or say support = 'plates' for a sensor that plates bend"
        )
    if not isinstance(support, Plates):
        return
    if isinstance(fixture, FreeArc):
        raise ConfigurationError(
            "a bend of a sensor on plates needs the clamp of the plates as its fixture, got "
            f"{fixture}; use another fixture or support = 'rigid'"
        )
    if abs(fixture.span - support.span) > _SAME:
        raise ConfigurationError(
            f"the support's plates are {support.span:g} m apart, but those of the fixture "
            f"{fixture.span:g} m; give both the same span"
        )


def require_base(touches: Iterable[Touch], design: SensorDesign) -> None:
    """Raise ConfigurationError for a press where the support leaves the bottom face free.

    The dent of a press needs a base as far around the indenter as the sensor is thick.
    """
    support = design.support
    require_fit(support, design.outline)
    for touch in touches:
        where = f"a press at ({touch.x:g}, {touch.y:g}) m"
        if isinstance(support, Free):
            raise ConfigurationError(
                f"{where} on a free membrane is not solved yet: the sensor has no base; use "
                "support = 'rigid', 'plates' or a substrate"
            )
        if isinstance(support, Plates):
            low, high = support.gap(design.outline)
            around = touch.indenter.rims[1] + design.encapsulated_thickness
            if low - around < touch.x < high + around:
                raise ConfigurationError(
                    f"{where} is not solved yet on plates: the bottom face is free from x = "
                    f"{low:g} to {high:g} m, and the dent needs a base {around:g} m around; press "
                    f"at x up to {low - around:g} m or from {high + around:g} m, or use support = "
                    "'rigid'"
                )
