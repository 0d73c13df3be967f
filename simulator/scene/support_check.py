"""Refusal of scenes that their support does not allow."""

from eitskin.errors import ConfigurationError
from eitskin.geometry.deformation.fixtures import Fixture, FreeArc
from eitskin.geometry.design.support import Free, Plates, Support

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
