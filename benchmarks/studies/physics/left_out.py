"""Errors of reanalysis by truncation, and by the default tolerance.

Run by `python -m eitskin.benchmarks.studies.physics.left_out`.

Prints, as Markdown, how far signals of 10 N are off when all beyond some distance of the press is
taken as untouched, or to first order, and what the default tolerance leaves.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eitskin.benchmarks.speed.scenes import JUDGED, WORKLOADS, scenes
from eitskin.geometry.deformation.fixtures import Bend
from eitskin.provenance import Provenance
from eitskin.simulator.electrical.reanalysis import EXACT, Reanalysis, Tolerance
from eitskin.simulator.layer.deformed_layer import DeformedLayer
from eitskin.simulator.scene.scene import Scene
from eitskin.simulator.scene.touch import Touch
from eitskin.simulator.simulator import Simulator

Array = NDArray[np.float64]

DISTANCES = (0.030, 0.040, 0.050)
SEED = 3


@dataclass(frozen=True, slots=True)
class Near:
    """Touched layer, but untouched farther than `distance` [m] from the touch along x."""

    touched: DeformedLayer
    untouched: DeformedLayer
    x: float
    distance: float

    def entries(self, x: Array) -> Array:
        """Entries as of `DeformedLayer`; each cell (first axis) is near as a whole or not."""
        near = np.abs(x[..., 0].mean(axis=1) - self.x) < self.distance
        both = self.touched.entries(x), self.untouched.entries(x)
        return np.where(near[:, None, None], *both)

    def conductivity(self, x: Array) -> Array:
        """Conductivity tensors, (..., 3, 3)."""
        return self.entries(x)[..., [[0, 3, 4], [3, 1, 5], [4, 5, 2]]]

    def area_ratio(self, x: Array, normal: Array) -> Array:
        """Area ratio of the touched layer."""
        return self.touched.area_ratio(x, normal)


def main() -> None:
    """Print both tables."""
    sim = WORKLOADS[0].simulator("fast")
    print(Provenance.now(SEED))
    print("\n| beyond [mm] | left out, off by [%] | to first order, off by [%] |\n|---|---|---|")
    for distance in DISTANCES:
        errors = np.array([_left_out(sim, scene, distance) for scene in _few()])
        (least, first), (most, last) = 100.0 * errors.min(axis=0), 100.0 * errors.max(axis=0)
        print(f"| {1e3 * distance:.0f} | {least:.1f} to {most:.1f} | {first:.2f} to {last:.2f} |")
    errors = 100.0 * np.concatenate([_tolerated(sim, bend) for bend in (0.0, 30.0)])
    print(f"\n- default tolerance, median and largest [%]: {np.median(errors):.2f}, ", end="")
    print(f"{errors.max():.2f}")


def _tolerated(sim: Simulator, angle_deg: float) -> Array:
    """Errors of signals by the default tolerance, of as many scenes as are judged."""
    some = [Scene(Bend(angle_deg), scene.touches) for scene in scenes(WORKLOADS[0], JUDGED, SEED)]
    whole = sim.measure_all(some, EXACT)
    signal = whole - sim.measure(Scene(Bend(angle_deg))).impedance
    missed = np.linalg.norm(sim.measure_all(some) - whole, axis=1)
    return np.asarray(missed / np.linalg.norm(signal, axis=1))


def _few() -> list[Scene]:
    """Presses of 10 N, three of the flat and three of the bent sensor."""
    places = [scene.touches[0] for scene in scenes(WORKLOADS[0], 6, SEED)]
    return [Scene(Bend(30.0 * (k // 3)), (Touch(t.x, t.y),)) for k, t in enumerate(places)]


def _left_out(sim: Simulator, scene: Scene, distance: float) -> tuple[float, float]:
    touched, untouched = sim.deformed_layer(scene), sim.deformed_layer(Scene(scene.bend))
    near = Near(touched, untouched, scene.touches[0].x, distance)
    both = (touched.conductivity, touched.area_ratio), (near.conductivity, near.area_ratio)
    whole, truncated = (sim.protocol.measure(sim.model.impedance(*each)) for each in both)
    solved = Reanalysis(sim.model, near, Tolerance(0.99, 0.99))  # type: ignore[arg-type]
    linear = sim.protocol.measure(solved.impedance(touched))
    size = np.linalg.norm(whole - sim.measure(Scene(scene.bend)).impedance)
    return tuple(float(np.linalg.norm(each - whole) / size) for each in (truncated, linear))  # type: ignore[return-value]


if __name__ == "__main__":
    main()
