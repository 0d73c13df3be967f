"""Cost of deformations alone, size of shipped tables, and tables that a scene looks up."""

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eitskin.geometry.deformation.fixtures import Bend, Clamp, Fixture, Hinge
from eitskin.geometry.deformation.kinematics import Displaced
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.simulator.bends import bend_table
from eitskin.simulator.deformation import corrections, press_table
from eitskin.simulator.deformation.dents import Dents
from eitskin.simulator.deformation.solution_store import LIBRARY
from eitskin.simulator.electrical.resolution import Resolution
from eitskin.simulator.scene.scene import Scene, Touch
from eitskin.simulator.simulator import Simulator

Array = NDArray[np.float64]

RESOLUTIONS: tuple[Resolution, ...] = ("fast", "standard")
_REPEATED = 5
_TOUCHES = (Touch(0.060, 0.030), Touch(0.090, 0.030))
_LOOKED_UP = {
    "press tables": press_table.press_table,
    "correction tables": corrections.corrections,
    "pair tables": corrections.pair_corrections,
    "bend tables": bend_table.bend_table,
}


@dataclass(frozen=True, slots=True)
class Cost:
    """Time of one deformation with its gradient at all points of a mesh.

    Attributes:
        resolution: of the mesh.
        points: at which the forward model evaluates the gradient.
        milliseconds: by scene and model.
    """

    resolution: str
    points: int
    milliseconds: dict[str, float]


def flat_and_points(simulator: Simulator) -> tuple[Array, list[Array]]:
    """Resistances of the flat sensor [ohm], and points that the forward model evaluates.

    Points (..., 3) [m] are those of the deformation gradient, in the batches of the model.
    """
    batches: list[Array] = []

    def derivative(points: Array) -> Array:
        batches.append(points)
        return np.zeros((*points.shape, 3))

    frame = simulator.deformed(Displaced(np.zeros_like, derivative))
    return frame.impedance.real, batches


def costs() -> tuple[Cost, ...]:
    """Costs of deformations of the reference sensor, the shortest of several repetitions."""
    design = SensorDesign.reference()
    return tuple(_cost(design, resolution) for resolution in RESOLUTIONS)


def _cost(design: SensorDesign, resolution: Resolution) -> Cost:
    simulator = Simulator(design, resolution, touch_model="tabulated")
    _, batches = flat_and_points(simulator)
    one, two = (Scene(touches=_TOUCHES[:count]) for count in (1, 2))
    dented = simulator.deformation(one)
    unbounded = Dents(dented.presses) if isinstance(dented, Dents) else None

    def evaluated(scene: Scene) -> None:
        found = simulator.deformation(scene)
        for part in batches:
            if found is not None:
                found.gradient(part)

    def alone() -> None:
        for part in batches:
            if unbounded is not None:
                unbounded.gradient(part)

    def bent(fixture: Fixture) -> None:
        found = bend_table.bend(design, fixture, simulator.mechanics, Bend(20.0))
        for part in batches:
            found.gradient(part)

    timed: dict[str, Callable[[], None]] = {
        "dent without corrections": alone,
        "one touch": lambda: evaluated(one),
        "two touches": lambda: evaluated(two),
        "bend": lambda: bent(Clamp()),
        "hinge": lambda: bent(Hinge()),
    }
    return Cost(
        resolution=resolution,
        points=sum(part[..., 0].size for part in batches),
        milliseconds={name: 1e3 * _shortest(call) for name, call in timed.items()},
    )


def _shortest(call: Callable[[], None]) -> float:
    """Shortest time of several calls after one that is not counted [s]."""
    call()
    found = []
    for _ in range(_REPEATED):
        start = time.process_time()
        call()
        found.append(time.process_time() - start)
    return min(found)


def bytes_stored() -> dict[str, int]:
    """Size of all tables in the package, by kind [bytes]."""
    sizes = {"presses": 0, "bends": 0}
    for path in LIBRARY.glob("*.npz"):
        sizes["bends" if path.name.startswith("bend-") else "presses"] += path.stat().st_size
    return sizes


def counted() -> dict[str, int]:
    """Tables that simple scenes look up, by scene and kind; 0 where a scene needs none."""
    design = SensorDesign.reference()
    scenes = {
        "flat and untouched": Scene(),
        "one touch": Scene(touches=_TOUCHES[:1]),
        "bend": Scene(Bend(20.0)),
    }
    simulator = Simulator(design, "fast", touch_model="tabulated")
    found = {}
    for scene_name, scene in scenes.items():
        before = {name: _lookups(table) for name, table in _LOOKED_UP.items()}
        simulator.measure(scene)
        for name, table in _LOOKED_UP.items():
            found[f"{scene_name}, {name}"] = _lookups(table) - before[name]
    return found


def _lookups(table: object) -> int:
    info = table.cache_info()  # type: ignore[attr-defined]
    return int(info.hits + info.misses)
