"""Published reference solutions, as cases with scenes."""

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eitskin.geometry.deformation.fixtures import Bend
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.simulator.mechanics.layer_stack import Mechanics
from eitskin.simulator.mechanics.materials import NeoHookean
from eitskin.simulator.scene.indenters import Cylinder, Sphere
from eitskin.simulator.scene.scene import Scene
from eitskin.simulator.scene.touch import Touch

PUBLISHED = Path(__file__).parents[1] / "published" / "world_reference.json"


@dataclass(frozen=True, slots=True, eq=False)
class ReferenceCase:
    """Case of the reference: a flat sensor on a rigid base that is pressed, or a clamped bend.

    Attributes:
        name: of the case.
        design: of the sensor.
        mechanics: materials of the sensor.
        scene: touches or bend.
        changes: relative changes of the 28 pair resistances, (28,).
        error: of the changes over their norm, by estimate.
        depth: of each indenter [m].
    """

    name: str
    design: SensorDesign
    mechanics: Mechanics
    scene: Scene
    changes: NDArray[np.float64]
    error: float
    depth: tuple[float, ...]

    @property
    def is_bend(self) -> bool:
        """Whether the sensor is bent rather than pressed."""
        return not self.scene.touches


def cases(path: Path = PUBLISHED) -> list[ReferenceCase]:
    """Cases that are solved: presses on a rigid base, and clamped bends without presses."""
    solutions = json.loads(path.read_text(encoding="utf-8"))["solutions"]
    return [_case(one) for one in solutions if one["changes"] is not None and _is_meant(one)]


def _is_meant(solution: dict[str, Any]) -> bool:
    """Whether a solution is of a press on a rigid base or of a bend between clamps."""
    pressed = bool(solution["touches"])
    bent = bool(solution["angle"])
    return (solution["support"] == "rigid" and pressed and not bent) or (
        solution["support"] == "clamp" and bent and not pressed
    )


def _case(solution: dict[str, Any]) -> ReferenceCase:
    design, materials = SensorDesign.reference(), Mechanics()
    if (factor := solution["thickness"]) != 1.0:
        design = replace(
            design,
            thickness=factor * design.thickness,
            encapsulated_thickness=factor * design.encapsulated_thickness,
        )
    modulus = solution["ratio"] * materials.gel.shear_modulus
    shape = Cylinder if solution["indenter"]["shape"] == "cylinder" else Sphere
    indenter = shape(1e-3 * solution["indenter"]["radius"])
    touches = [
        Touch(1e-3 * x, 1e-3 * y, solution["force"], indenter=indenter)
        for x, y in solution["touches"]
    ]
    return ReferenceCase(
        name=solution["name"],
        design=design,
        mechanics=replace(materials, encapsulation=NeoHookean(modulus)),
        scene=Scene(Bend(solution["angle"]), tuple(touches)),
        changes=np.array(solution["changes"]),
        error=solution["error"],
        depth=tuple(1e-3 * depth for depth in solution["depth"]),
    )
