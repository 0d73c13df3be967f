"""Published reference solutions, as cases with scenes."""

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eitskin.geometry.deformation.fixtures import Bend
from eitskin.geometry.design.sensor import Free, Plates, Rigid, SensorDesign, Substrate, Support
from eitskin.simulator.mechanics.layer_stack import Mechanics
from eitskin.simulator.mechanics.materials import NeoHookean
from eitskin.simulator.scene.indenters import Cylinder, Sphere
from eitskin.simulator.scene.scene import Scene, Touch

KINDS = ("press", "supported press", "bent press", "bend")
"""Kinds of cases: flat on a rigid base, flat on another support, pressed and bent, bent only."""
PUBLISHED = Path(__file__).parent / "published" / "world_reference.json"


@dataclass(frozen=True, slots=True, eq=False)
class ReferenceCase:
    """Case of the reference: presses on a support, flat or bent, or a clamped bend.

    Attributes:
        name: of the case.
        design: of the sensor, with its support.
        mechanics: materials of the sensor.
        scene: touches, bend, or both.
        changes: relative changes of the 28 pair resistances, (28,).
        by_bend: those by the bend alone where touches are compared on a bent sensor, else 0, (28,).
        error: of the changes over their norm, by estimate.
        depth: of each indenter [m].
    """

    name: str
    design: SensorDesign
    mechanics: Mechanics
    scene: Scene
    changes: NDArray[np.float64]
    by_bend: NDArray[np.float64]
    error: float
    depth: tuple[float, ...]

    @property
    def signal(self) -> NDArray[np.float64]:
        """Changes that the touches make, or the bend of an untouched sensor, (28,)."""
        return self.changes - self.by_bend

    @property
    def is_bend(self) -> bool:
        """Whether the sensor is bent rather than pressed."""
        return not self.scene.touches

    @property
    def kind(self) -> str:
        """One of `KINDS`."""
        if self.is_bend:
            return "bend"
        if self.scene.bend.angle_deg:
            return "bent press"
        return "press" if isinstance(self.design.support, Rigid) else "supported press"


def cases(path: Path = PUBLISHED) -> list[ReferenceCase]:
    """Cases that are solved."""
    solutions = json.loads(path.read_text(encoding="utf-8"))["solutions"]
    return [_case(one) for one in solutions if one["changes"] is not None]


def _support(solution: dict[str, Any]) -> Support:
    """Support of a case; that of a bend without presses is a clamp, which holds the sensor."""
    if solution["support"] == "substrate":
        thickness, modulus = solution["substrate"]
        return Substrate(1e-3 * thickness, 1e3 * modulus)
    known: dict[str, Support] = {"plates": Plates(), "free": Free()}
    return known.get(solution["support"], Rigid())


def _case(solution: dict[str, Any]) -> ReferenceCase:
    design = replace(SensorDesign.reference(), support=_support(solution))
    materials = Mechanics()
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
        by_bend=np.array(solution.get("bend_changes", [0.0] * len(solution["changes"]))),
        error=solution["error"],
        depth=tuple(1e-3 * depth for depth in solution["depth"]),
    )
