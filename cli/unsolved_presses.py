"""Note of presses that have to be solved before anything else."""

from collections.abc import Iterable
from typing import TYPE_CHECKING

from eitskin.cli.options import Output

if TYPE_CHECKING:
    from eitskin.geometry.design.sensor import SensorDesign
    from eitskin.simulator.mechanics.layer_stack import Mechanics
    from eitskin.simulator.scene.indenters import Indenter


def announce_unsolved(
    design: "SensorDesign",
    mechanics: "Mechanics",
    indenters: "Iterable[Indenter]",
    output: Output,
) -> None:
    """Note how many indenters have no solved press on this sensor yet."""
    from eitskin.simulator.mechanics.press_store import folder, is_stored

    missing = sum(not is_stored(design, mechanics, each) for each in dict.fromkeys(indenters))
    if missing:
        several = missing > 1
        output.note(
            f"solving the presses of {missing} indenter{'s' * several} that "
            f"{'are' if several else 'is'} new to this sensor, once: from ten seconds to a few "
            f"minutes each; kept in {folder()}"
        )
