"""What commands say before presses are solved."""

from collections.abc import Iterable

from eitskin.cli.options import Output
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.simulator.mechanics import press_store
from eitskin.simulator.mechanics.layer_stack import Mechanics
from eitskin.simulator.scene.indenters import Indenter


def announce(
    design: SensorDesign, mechanics: Mechanics, indenters: Iterable[Indenter], output: Output
) -> None:
    """Say that the presses of indenters that are new to a sensor have to be solved."""
    missing = sum(
        not press_store.is_stored(design, mechanics, each) for each in dict.fromkeys(indenters)
    )
    if missing:
        several = missing > 1
        output.note(
            f"solving the presses of {missing} indenter{'s' * several} that "
            f"{'are' if several else 'is'} new to this sensor, once: from ten seconds to a few "
            f"minutes each; kept in {press_store.folder()}"
        )
