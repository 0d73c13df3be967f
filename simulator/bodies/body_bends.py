"""Bends of a body by the fixtures of a scene."""

from eitskin.errors import ConfigurationError
from eitskin.geometry.deformation.fixtures import Bend, Clamp, Fixture
from eitskin.geometry.deformation.kinematics import Deformation
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.simulator.bodies.body_store import bent_body
from eitskin.simulator.mechanics.layer_stack import Mechanics


def bent_by(
    design: SensorDesign, fixture: Fixture, mechanics: Mechanics, bend: Bend
) -> Deformation:
    """Deformation of a body by a fixture; clamped bodies are solved in a minute or more.

    Raises:
        ConfigurationError: for a bend out of reach, or a clamp that bodies cannot have.
        SolidError: where the clamped body has no stable equilibrium at the angle.
    """
    if not isinstance(fixture, Clamp):
        return fixture.flexure(design, bend)
    if fixture.compliance or fixture.faces != "both":
        raise ConfigurationError(
            "the plates of a clamp hold a body from a surface rigidly and from both sides, got a "
            f"compliance of {fixture.compliance:g} m/Pa and faces = '{fixture.faces}'; leave both "
            "out"
        )
    return bent_body(design, fixture.span, fixture.offset, mechanics, bend.angle_deg).field
