"""Simulator of a command's options, and the note of presses that it has to solve first."""

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, cast

from eitskin.cli.options import Output, one_of

if TYPE_CHECKING:
    from eitskin.geometry.deformation.fixtures import Fixture
    from eitskin.geometry.design.sensor import SensorDesign
    from eitskin.simulator.electrical.resolution import Discretisation, Resolution
    from eitskin.simulator.layer.pressed_touches import TouchModel
    from eitskin.simulator.scene.scene import Scene
    from eitskin.simulator.simulator import Simulator


def simulator(
    design: "SensorDesign",
    resolution: "Resolution | Discretisation",
    fixture: Path | None,
    protocol: str,
    mechanics: Path | None,
    touch_model: str,
) -> "Simulator":
    """Simulator configured by a command's options.

    Raises ConfigurationError for options or files that do not fit.
    """
    from eitskin.config import read_toml
    from eitskin.geometry.deformation.fixtures import Fixture
    from eitskin.protocol import Protocol
    from eitskin.simulator.layer.pressed_touches import TouchModel
    from eitskin.simulator.mechanics.layer_stack import Mechanics
    from eitskin.simulator.simulator import Simulator

    return Simulator(
        design,
        resolution,
        read_toml(cast("type[Fixture]", Fixture), fixture) if fixture else None,
        Protocol.named(protocol, len(design.electrodes)),
        read_toml(Mechanics, mechanics) if mechanics else None,
        cast("TouchModel", one_of("--touch-model", touch_model, TouchModel))
        if touch_model
        else None,
    )


def on_support(scene: "Scene", support: str | None) -> "Scene":
    """Scene on the support of the option --support, where one is given.

    Raises ConfigurationError where the option names no support.
    """
    from eitskin.config import from_dict
    from eitskin.simulator.scene.scene import Scene

    if support is None:
        return scene
    given = from_dict(Scene, {"support": support}, "--support")
    return dataclasses.replace(scene, support=given.support)


def announce_unsolved(simulator: "Simulator", scene: "Scene", output: Output) -> None:
    """Note what has to be solved for a scene's touches first: dents, or presses in 3D."""
    from eitskin.simulator.mechanics.solved_files import folder
    from eitskin.simulator.presses.press_store import is_stored

    design, mechanics = simulator.supported(scene), simulator.mechanics
    indenters = dict.fromkeys(touch.indenter for touch in scene.touches)
    missing = sum(not is_stored(design, mechanics, each) for each in indenters)
    if missing:
        several = missing > 1
        output.note(
            f"solving the presses of {missing} indenter{'s' * several} that "
            f"{'are' if several else 'is'} new to this sensor, once: from ten seconds to a few "
            f"minutes each; kept in {folder()}"
        )
    if simulator.solves_presses(scene):
        output.note(
            "solving the scene's touches in 3D, since no tables ship for them or the sensor is "
            "pressed in its bent state: half a minute to some minutes"
        )
